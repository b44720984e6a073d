//! The checks of the fuzz targets: the project keeps its guarantees for any received bytes.
//!
//! Each function takes one input and panics if a promise is broken. The programs in `fuzz_targets/` only pass
//! on libFuzzer's input. `README.md` lists the promises.

#![forbid(unsafe_code)]

pub mod bus;
pub mod client_and_server;
pub mod client_rules;
pub mod dispatcher;
pub mod goal;
pub mod link;
pub mod link_ends;
pub mod manifest;
pub mod message;
pub mod naoqi;
pub mod pickle;
pub mod recording;
pub mod ros1;
mod script;
pub mod seal;
pub mod spec;
pub mod sse;
pub mod stream_head;
pub mod zmtp;
pub mod zmtp_session;
