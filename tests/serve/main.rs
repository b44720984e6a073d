//! Task servers and their handlers: programs of `ztl serve`, and handlers in Rust.

mod abort;
mod access;
mod client_handles;
mod decisions;
mod descriptions;
mod encrypted;
mod examples;
mod file;
mod floods;
mod forward;
mod gate;
mod handlers;
mod http;
mod killed;
mod lost_clients;
mod many_tasks;
mod memory;
mod processes;
mod results;
mod rig;
mod several;
mod stop;
mod streams;
mod watchdog;
