//! `ztl gateway` as a process that runs for months: its configuration file, what it does when asked
//! to stop, and that no device harms another.

#![cfg(unix)]

mod file;
mod firmware;
mod lines;
mod neighbours;
mod readings;
mod service;
