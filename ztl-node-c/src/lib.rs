//! The node end of ZTL's link for firmware in C, as declared in `include/ztl_node.h`.
//!
//! The header is generated from these files, so their comments address C programmers. Nothing here panics:
//! the library only links if every panic is unreachable.
#![no_std]

mod text;

pub mod component;

pub mod node;

pub mod report;

use core::ffi::c_int;

/// Version of the interface that this header describes. It changes when firmware must be recompiled.
pub const ZTL_NODE_ABI: c_int = 1;

/// How many tasks a node holds, including ended tasks whose outcome is not acknowledged yet.
pub const ZTL_NODE_TASKS: usize = 4;
/// Longest frame on the line, in bytes.
pub const ZTL_NODE_FRAME: usize = 128;
/// Longest name of the device, and longest version of its firmware, in bytes.
pub const ZTL_NODE_NAME: usize = 28;
/// Longest text that a component reports, in bytes; a reason to refuse may have twice as many. Longer texts are cut
/// and marked.
pub const ZTL_NODE_TEXT: usize = 48;

/// Success.
pub const ZTL_NODE_OK: c_int = 0;
/// A required pointer is NULL, or a callback is missing.
pub const ZTL_NODE_E_NULL: c_int = -1;
/// There is less RAM than ztl_node_size returns.
pub const ZTL_NODE_E_RAM: c_int = -2;
/// A text is not UTF-8, or too long. ZTL_NODE_NAME limits the device's name and version. Each text of a component has at
/// most 64 bytes, and all of them together must fit into a frame; 101 bytes always do.
pub const ZTL_NODE_E_TEXT: c_int = -3;
/// There are no components, or more than 255.
pub const ZTL_NODE_E_COUNT: c_int = -4;
/// A component's `busy` or `loss` is not one of the values below.
pub const ZTL_NODE_E_POLICY: c_int = -5;

/// From `check` or `start`: the goal is accepted.
pub const ZTL_NODE_TAKEN: c_int = 0;
/// From `check` or `start`: the goal is refused. The report says what is wrong and what would be right;
/// nothing has moved.
pub const ZTL_NODE_REFUSED: c_int = 1;

/// From `poll`: the task is running; the report is its progress.
pub const ZTL_NODE_RUNNING: c_int = 0;
/// From `poll`: the goal is reached; the report is the result.
pub const ZTL_NODE_COMPLETED: c_int = 1;
/// From `poll`: the goal will not be reached; the report says why.
pub const ZTL_NODE_FAILED: c_int = 2;
/// From `poll`: the task has stopped after `abort`; the report says where.
pub const ZTL_NODE_ABORTED: c_int = 3;

/// A component's `busy`: refuse a second task. A number from 1 to 255 instead: queue it, with at most that
/// many tasks waiting.
pub const ZTL_NODE_REFUSE: c_int = 0;
/// A component's `busy`: a second task replaces the running one, which is aborted.
pub const ZTL_NODE_REPLACE: c_int = -1;

/// A component's `loss`, what it does without its link, with or without a task: it is made safe, and a task fails.
pub const ZTL_NODE_LOSS_ABORT: c_int = 0;
/// A component's `loss`: the same, but `make_safe` holds the position under power.
pub const ZTL_NODE_LOSS_HOLD: c_int = 1;
/// A component's `loss`: it carries on: it finishes its task, or stays as it is.
pub const ZTL_NODE_LOSS_CARRY_ON: c_int = 2;

unsafe extern "C" {
    /// Never defined: the library only links without panics.
    safe fn ztl_a_panic_is_reachable() -> !;
}

#[panic_handler]
fn panic(_: &core::panic::PanicInfo<'_>) -> ! {
    ztl_a_panic_is_reachable()
}
