//! The gateway's end of the link to a microcontroller, without I/O.
//!
//! `docs/link.md` is the link's specification. What a node needs of it is in `ztl-core`; what is here
//! needs an allocator.

mod session;

pub use session::*;
