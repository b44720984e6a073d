//! ZTL for programs in C: what `include/ztl.h` declares.
//!
//! Each function turns what C gives into Rust's terms, does its work behind a barrier that no panic
//! passes, and says what went wrong as a number and a text. The header is made from these files, so
//! their comments speak to programmers in C.

mod border;
mod signals;
mod tasks;

// In the order in which the header tells of them.
pub mod error;

pub mod server;

pub mod task;

pub mod client;

pub mod log;

use std::ffi::{c_char, c_int, c_uint};

/// The interface that this header describes. It changes when a program would have to be compiled anew;
/// new functions and new numbers do not change it.
pub const ZTL_ABI: c_uint = 1;

/// No task has this id.
pub const ZTL_NO_TASK: c_uint = 0;
/// Client: the task's id does not fit in an unsigned int, as some servers of the Python original give them.
/// ztl_client_task_id tells it, and the functions named ..._by_id take it.
pub const ZTL_LONG_TASK: c_uint = 4_294_967_295;

/// Where a task is: it is not known. Only a client is told so, with an error.
pub const ZTL_UNKNOWN: c_int = -1;
/// Where a task is: asked for, and not decided upon.
pub const ZTL_INITIATED: c_int = 0;
/// Where a task is: taken, and under way.
pub const ZTL_ACCEPTED: c_int = 1;
/// Where a task is: refused, and nothing was done. Final.
pub const ZTL_REJECTED: c_int = 2;
/// Where a task is: ended without reaching its goal. Final.
pub const ZTL_FAILED: c_int = 3;
/// Where a task is: stopped because somebody asked for it. Final.
pub const ZTL_ABORTED: c_int = 4;
/// Where a task is: its goal is reached. Final.
pub const ZTL_COMPLETED: c_int = 5;

/// The library's version, as "0.1.0". Any thread. The text is the library's, and stays.
#[unsafe(no_mangle)]
pub extern "C" fn ztl_version() -> *const c_char {
    const VERSION: &str = concat!(env!("CARGO_PKG_VERSION"), "\0");
    VERSION.as_ptr().cast()
}

/// The interface of the library that the program runs with, to be compared with ZTL_ABI. Any thread.
#[unsafe(no_mangle)]
pub extern "C" fn ztl_abi() -> c_uint {
    ZTL_ABI
}

/// 1 when this library can encrypt, so that keys can be used, else 0. Any thread.
#[unsafe(no_mangle)]
pub extern "C" fn ztl_can_encrypt() -> c_int {
    border::guard(0, || c_int::from(ztl_std::keys::can_encrypt()))
}

/// The name of a state, as "COMPLETED"; "UNKNOWN" for any other number. Any thread. The text is the
/// library's, and stays.
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
