//! The checks of the fuzz targets: whatever bytes arrive, the project keeps its promises.
//!
//! Each function takes one input and panics if a promise is broken. The programs in `fuzz_targets/` only pass
//! on libFuzzer's input. `README.md` lists the promises.

#![forbid(unsafe_code)]

pub mod client;
pub mod conversation;
pub mod dispatcher;
pub mod ends;
pub mod goal;
pub mod link;
pub mod message;
mod script;
pub mod spec;
pub mod zmtp;
