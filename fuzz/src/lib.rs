//! What the fuzz targets check: whatever bytes come, the project keeps what it promises.
//!
//! Each function takes one input and panics when a promise is broken; the programs in
//! `fuzz_targets/` only hand them what libFuzzer makes up. `README.md` says what each is for.

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

/// The gateway's end of the link. Compiled here from its source, which needs nothing else of
/// `ztl-std`, and so no ZeroMQ.
#[path = "../../ztl-std/src/gateway"]
mod gateway {
    #[expect(dead_code, reason = "not all of it is needed here")]
    pub(crate) mod session;
}
