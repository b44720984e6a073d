//! `ztl serve`: programs as handlers, with real processes and real clients.
#![cfg(target_os = "linux")]

mod abort;
mod decisions;
mod examples;
mod file;
mod forward;
mod killed;
mod memory;
mod processes;
mod results;
mod rig;
mod several;
mod stop;
mod watchdog;
