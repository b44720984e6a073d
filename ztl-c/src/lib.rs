//! ZTL for programs in C, as declared in `include/ztl.h`.
//!
//! Each function converts its arguments, does its work where no panic can reach C, and returns an error as a number and
//! a text. The header is generated from these files, so comments on public items address programmers in C.

mod border;
mod signals;
mod tasks;

// In the order of the header.
pub mod error;

pub mod server;

pub mod task;

pub mod client;

pub mod log;

use std::ffi::{c_char, c_int, c_uint};

/// The version of this interface. It changes when programs must be recompiled; new functions and new numbers do
/// not change it.
pub const ZTL_ABI: c_uint = 1;

/// No task has this id.
pub const ZTL_NO_TASK: c_uint = 0;
/// Client: the task's id does not fit in an unsigned int; some servers of the Python original assign such ids.
/// ztl_client_task_id returns it, and the functions named ..._by_id take it.
pub const ZTL_LONG_TASK: c_uint = 4_294_967_295;

/// State: unknown. Only a client gets it, with an error.
pub const ZTL_UNKNOWN: c_int = -1;
/// State: asked for, not decided yet.
pub const ZTL_INITIATED: c_int = 0;
/// State: accepted and running.
pub const ZTL_ACCEPTED: c_int = 1;
/// State: rejected; nothing was done. Final.
pub const ZTL_REJECTED: c_int = 2;
/// State: ended without reaching its goal. Final.
pub const ZTL_FAILED: c_int = 3;
/// State: stopped on request. Final.
pub const ZTL_ABORTED: c_int = 4;
/// State: ended with its goal reached. Final.
pub const ZTL_COMPLETED: c_int = 5;

/// The library's version, such as "0.1.0". Any thread. The text belongs to the library and stays valid.
#[unsafe(no_mangle)]
pub extern "C" fn ztl_version() -> *const c_char {
    const VERSION: &str = concat!(env!("CARGO_PKG_VERSION"), "\0");
    VERSION.as_ptr().cast()
}

/// The version of the interface in the loaded library, to be compared with ZTL_ABI. Any thread.
#[unsafe(no_mangle)]
pub extern "C" fn ztl_abi() -> c_uint {
    ZTL_ABI
}

/// The name of a state, such as "COMPLETED"; "UNKNOWN" for any other number. Any thread. The text belongs to the
/// library and stays valid.
#[unsafe(no_mangle)]
pub extern "C" fn ztl_state_name(state: c_int) -> *const c_char {
    let name = match state {
        ZTL_INITIATED => c"INITIATED",
        ZTL_ACCEPTED => c"ACCEPTED",
        ZTL_REJECTED => c"REJECTED",
        ZTL_FAILED => c"FAILED",
        ZTL_ABORTED => c"ABORTED",
        ZTL_COMPLETED => c"COMPLETED",
        _ => c"UNKNOWN",
    };
    name.as_ptr()
}
