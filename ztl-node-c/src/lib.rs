//! The node end of ZTL's link for firmware in C: what `include/ztl_node.h` declares.
//!
//! The header is made from these files, so their comments speak to programmers in C. Nothing here panics,
//! whatever arrives: the library is only made when the linker has found every panic unreachable.
#![no_std]

mod part;

pub mod node;

pub mod report;

use core::ffi::c_int;

/// The interface that this header describes. It changes when firmware would have to be compiled anew.
pub const ZTL_NODE_ABI: c_int = 1;

/// How many tasks a node holds, those included that have ended and whose end is not acknowledged.
pub const ZTL_NODE_TASKS: usize = 4;
/// Longest frame on the line, in bytes.
pub const ZTL_NODE_FRAME: usize = 128;
/// Longest name of the device, and longest version of its firmware, in bytes.
pub const ZTL_NODE_NAME: usize = 28;
/// Longest text that a component reports, in bytes; a reason to refuse may have twice as many. What is longer is cut,
/// and marked.
pub const ZTL_NODE_TEXT: usize = 48;

/// It is done.
pub const ZTL_NODE_OK: c_int = 0;
/// A pointer is NULL that must not be, or a callback is lacking.
pub const ZTL_NODE_E_NULL: c_int = -1;
/// There is less RAM than ztl_node_size says.
pub const ZTL_NODE_E_RAM: c_int = -2;
/// A text is no UTF-8, or too long: ZTL_NODE_NAME says how long name and version of the device may be; of a component each text
/// has at most 64 bytes, and all of them together fit into a frame, which they do with 101.
pub const ZTL_NODE_E_TEXT: c_int = -3;
/// There is no component, or there are more than 255.
pub const ZTL_NODE_E_COUNT: c_int = -4;
/// A component's `busy` or `loss` is none of the numbers below.
pub const ZTL_NODE_E_POLICY: c_int = -5;

/// From `check` or `start`: the goal is taken.
pub const ZTL_NODE_TAKEN: c_int = 0;
/// From `check` or `start`: it is not, and the report says why, and what would be right. Nothing has moved.
pub const ZTL_NODE_REFUSED: c_int = 1;

/// From `poll`: under way; the report is where it is now.
pub const ZTL_NODE_RUNNING: c_int = 0;
/// From `poll`: the goal is reached; the report is the result.
pub const ZTL_NODE_COMPLETED: c_int = 1;
/// From `poll`: the goal will not be reached; the report says why.
pub const ZTL_NODE_FAILED: c_int = 2;
/// From `poll`: stopped after `abort`; the report is where.
pub const ZTL_NODE_ABORTED: c_int = 3;

/// A component's `busy`: a second task is refused. A number from 1 to 255 instead: it waits for its turn,
/// behind at most so many.
pub const ZTL_NODE_REFUSE: c_int = 0;
/// A component's `busy`: a second task takes the place of the one that runs, which is aborted.
pub const ZTL_NODE_REPLACE: c_int = -1;

/// A component's `loss`, what it does without its link, with or without a task: it is made safe, and a task fails.
pub const ZTL_NODE_LOSS_ABORT: c_int = 0;
/// The same, but `make_safe` keeps its position under power.
pub const ZTL_NODE_LOSS_HOLD: c_int = 1;
/// It goes on: it finishes its task, or stays as it is.
pub const ZTL_NODE_LOSS_CARRY_ON: c_int = 2;

unsafe extern "C" {
    /// Nobody defines it: what is linked has no panic.
    safe fn ztl_a_panic_is_reachable() -> !;
}

#[panic_handler]
fn panic(_: &core::panic::PanicInfo<'_>) -> ! {
    ztl_a_panic_is_reachable()
}
