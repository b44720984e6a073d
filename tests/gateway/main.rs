//! `ztl gateway` as a process that runs for months: its configuration file, what it does when asked
//! to stop, and that no device harms another.

mod device;
mod file;
mod firmware;
mod lines;
#[cfg(all(target_os = "linux", target_env = "gnu", target_arch = "x86_64"))]
mod logs;
mod neighbours;
mod readings;
mod reload;
mod restart;
mod service;
