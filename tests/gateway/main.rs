//! `ztl gateway`: its configuration, its journal, the devices behind it, and how it stops and restarts.

mod all_mistakes;
mod bus;
mod descriptions;
mod device;
mod file;
mod firmware;
mod handover;
mod interrupted_updates;
mod lines;
#[cfg(all(target_os = "linux", target_env = "gnu", target_arch = "x86_64"))]
mod logs;
mod neighbours;
mod own;
mod parameters;
mod readings;
mod reload;
mod restart;
mod service;
mod updates;
