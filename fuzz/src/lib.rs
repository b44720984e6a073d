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

/// The gateway's end of the link. Compiled here from its source, which needs nothing else of `ztl-std`, and
/// therefore no ZeroMQ.
#[path = "../../ztl-std/src/gateway"]
mod gateway {
    #[expect(dead_code, reason = "only part of it is used here")]
    pub(crate) mod session;
}
