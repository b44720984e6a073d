//! What the fuzz targets check: whatever bytes come, `ztl-core` keeps what it promises.
//!
//! Each function takes one input and panics when a promise is broken; the programs in
//! `fuzz_targets/` only hand them what libFuzzer makes up. `README.md` says what each is for.

#![forbid(unsafe_code)]

pub mod client;
pub mod conversation;
pub mod dispatcher;
pub mod goal;
pub mod link;
pub mod message;
mod script;
pub mod spec;
