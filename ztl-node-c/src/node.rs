//! A node in the firmware's RAM.

use core::ffi::{c_char, c_int, c_uchar, c_uint, c_void};
use core::mem::{align_of, size_of};
use core::ptr;
use core::time::Duration;

use ztl_mcu::{Component as _, Identity, Instant};

use crate::component::{Component, Part};
use crate::text::{is_text, text};
use crate::{
    ZTL_NODE_E_COUNT, ZTL_NODE_E_NULL, ZTL_NODE_E_RAM, ZTL_NODE_E_TEXT, ZTL_NODE_FRAME,
    ZTL_NODE_NAME, ZTL_NODE_OK, ZTL_NODE_TASKS,
};

/// Bytes of RAM of a node without its components and pointers: see ZTL_NODE_RAM.
pub const ZTL_NODE_RAM_BYTES: usize = 863;
/// Its pointers: see ZTL_NODE_RAM.
pub const ZTL_NODE_RAM_POINTERS: usize = 20;

/// Identity of a node. The firmware keeps its texts unchanged while the node exists.
#[repr(C)]
pub struct NodeIdentity {
    /// What the device is called, ZTL_NODE_NAME bytes at most. Not NULL.
    pub name: *const c_char,
    /// Version of its firmware, ZTL_NODE_NAME bytes at most. Not NULL.
    pub firmware: *const c_char,
    /// Changes with each boot: random, or a counter that a reset does not clear.
    pub boot: c_uint,
    /// The link is lost after this many milliseconds without a new command, 50 to 60000; 0 means 1000.
    pub link_timeout_ms: c_uint,
}

/// Statistics of a node's line since boot; the counters wrap around.
#[repr(C)]
pub struct NodeCounters {
    /// Frames with a correct checksum.
    pub frames: c_uint,
    /// Frames dropped: damaged, of another session, or too long.
    pub errors: c_uint,
    /// Commands that were repeated: answered again, not executed again.
    pub repeats: c_uint,
    /// Commands dropped because they were out of sequence.
    pub out_of_sequence: c_uint,
}

/// The node end of the link. Call its functions from one context, preferably the main loop, and not from an
/// interrupt: pass received bytes through a queue. Callbacks must not call them.
pub struct Node {
    inner: Inner,
    /// The latest time in milliseconds, with more bits than the firmware's counter. `None` before the first
    /// call.
    time: Option<u64>,
}

type Inner = ztl_mcu::Node<'static, &'static mut [Part], ZTL_NODE_TASKS, ZTL_NODE_FRAME>;

const _: () = assert!(Inner::LONGEST_NAME == ZTL_NODE_NAME);

/// Bytes that may be lost in finding the right address.
const SLACK: usize = align_of::<Node>() - 1;

/// The value of ZTL_NODE_RAM(0).
const RAM: usize = ZTL_NODE_RAM_BYTES + ZTL_NODE_RAM_POINTERS * size_of::<*const ()>();

const _: () = assert!(
    size_of::<Node>() + SLACK <= RAM,
    "ZTL_NODE_RAM is less than a node needs"
);
// Not much is wasted. Checked in debug builds only, because another compiler may need less.
#[cfg(all(
    debug_assertions,
    any(
        target_arch = "arm",
        target_arch = "riscv32",
        target_pointer_width = "64"
    )
))]
const _: () = assert!(
    RAM - (size_of::<Node>() + SLACK) <= 32,
    "ZTL_NODE_RAM is more than a node needs"
);
// The parts follow the node directly.
const _: () = assert!(align_of::<Node>() >= align_of::<Part>());
const _: () = assert!(size_of::<Node>().is_multiple_of(align_of::<Part>()));

impl Node {
    /// Converts the firmware's counter, which may wrap around. If it seems to go back, time stands still.
    fn now(&mut self, now_ms: c_uint) -> Instant {
        let mut time = self.time.unwrap_or(now_ms.into());
        let passed = now_ms.wrapping_sub(time as c_uint);
        if passed <= c_uint::MAX / 2 {
            time = time.saturating_add(passed.into());
        }
        self.time = Some(time);
        Instant::from_millis(time)
    }
}

/// Bytes of RAM that a node with this many components needs. ZTL_NODE_RAM is the same at compile time.
#[unsafe(no_mangle)]
pub extern "C" fn ztl_node_size(components: usize) -> usize {
    let parts = components.saturating_mul(size_of::<Part>());
    parts.saturating_add(size_of::<Node>() + SLACK)
}

/// Creates a node in RAM that the firmware provides, with any alignment. The library owns this RAM while the
/// node is in use; there is nothing to free. All other arguments stay the firmware's and must stay unchanged.
/// Writes the node's address, or NULL on error: ZTL_NODE_E_NULL, _RAM, _TEXT, _COUNT, _POLICY.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn ztl_node_init(
    node: *mut *mut Node,
    ram: *mut c_void,
    size: usize,
    identity: *const NodeIdentity,
    components: *const Component,
    count: usize,
) -> c_int {
    if node.is_null() {
        return ZTL_NODE_E_NULL;
    }
    // SAFETY: promised by the firmware.
    let made = unsafe { make(ram, size, identity, components, count) };
    let (made, code) = match made {
        Ok(made) => (made, ZTL_NODE_OK),
        Err(code) => (ptr::null_mut(), code),
    };
    // SAFETY: not NULL, and owned by the caller.
    unsafe { node.write(made) };
    code
}

/// # Safety
/// See `ztl_node_init` in the header.
unsafe fn make(
    ram: *mut c_void,
    size: usize,
    identity: *const NodeIdentity,
    components: *const Component,
    count: usize,
) -> Result<*mut Node, c_int> {
    // SAFETY: NULL or valid, as the firmware promises.
    let identity = unsafe { identity.as_ref() }.ok_or(ZTL_NODE_E_NULL)?;
    if ram.is_null()
        || components.is_null()
        || identity.name.is_null()
        || identity.firmware.is_null()
    {
        return Err(ZTL_NODE_E_NULL);
    }
    if count == 0 || count > 255 {
        return Err(ZTL_NODE_E_COUNT);
    }
    if size < ztl_node_size(count) {
        return Err(ZTL_NODE_E_RAM);
    }
    // SAFETY: texts, as the firmware promises.
    let (name, firmware) = unsafe {
        if !is_text(identity.name, false) || !is_text(identity.firmware, false) {
            return Err(ZTL_NODE_E_TEXT);
        }
        (text(identity.name), text(identity.firmware))
    };
    let too_long = |text: Option<&str>| text.is_some_and(|text| text.len() > ZTL_NODE_NAME);
    if too_long(name) || too_long(firmware) {
        return Err(ZTL_NODE_E_TEXT);
    }
    let past = ram.addr() % align_of::<Node>();
    let skip = if past == 0 {
        0
    } else {
        align_of::<Node>() - past
    };
    // SAFETY: within the RAM, whose size includes the slack.
    let place = unsafe { ram.cast::<u8>().add(skip) };
    // SAFETY: after the node, and within the RAM, which has room for the parts.
    let first = unsafe { place.add(size_of::<Node>()) }.cast::<Part>();
    for index in 0..count {
        // SAFETY: one of the firmware's array, which promises that it keeps what the part points to.
        let part = unsafe { Part::new(components.add(index)) }?;
        if !Inner::fits(&part.offer()) {
            return Err(ZTL_NODE_E_TEXT);
        }
        // SAFETY: within the RAM's room for as many parts, aligned as the constants above have shown.
        unsafe { first.add(index).write(part) };
    }
    // SAFETY: all of them were just written; from now on the library owns the RAM.
    let parts = unsafe { core::slice::from_raw_parts_mut(first, count) };
    let mut who = Identity::new(
        name.unwrap_or_default(),
        firmware.unwrap_or_default(),
        identity.boot,
    );
    if identity.link_timeout_ms != 0 {
        let timeout = identity.link_timeout_ms.clamp(50, 60_000);
        who.link_timeout = Duration::from_millis(timeout.into());
    }
    let node = place.cast::<Node>();
    // SAFETY: aligned, large enough, and not overlapping the parts.
    unsafe {
        node.write(Node {
            inner: Inner::new(who, parts),
            time: None,
        });
    }
    Ok(node)
}

/// Handles received bytes, in pieces of any length. The time is in milliseconds on any clock that may start
/// anywhere and wrap around, such as HAL_GetTick(). The bytes are not kept. Does nothing if the node or the
/// bytes are NULL; the same holds for all functions below.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn ztl_node_receive(
    node: *mut Node,
    now_ms: c_uint,
    bytes: *const c_uchar,
    count: usize,
) {
    // SAFETY: NULL or a node that nobody else uses now, as the firmware promises.
    let node = unsafe { node.as_mut() };
    if let Some(node) = node.filter(|_| !bytes.is_null()) {
        let now = node.now(now_ms);
        // SAFETY: not NULL, and of this length, as the firmware promises.
        let bytes = unsafe { core::slice::from_raw_parts(bytes, count) };
        node.inner.handle_bytes(now, bytes);
    }
}

/// Advances the components, and acts when the link is lost. Call it in every turn of the main loop.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn ztl_node_run(node: *mut Node, now_ms: c_uint) {
    // SAFETY: as in `ztl_node_receive`.
    if let Some(node) = unsafe { node.as_mut() } {
        let now = node.now(now_ms);
        node.inner.handle_timeout(now);
    }
}

/// Writes the next bytes to send into a buffer and returns their number. Call it after each ztl_node_receive
/// and ztl_node_run. It fills the buffer as long as there is data. If components always have readings, there
/// is always more; a main loop must not wait for the end.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn ztl_node_send(
    node: *mut Node,
    now_ms: c_uint,
    buffer: *mut c_uchar,
    size: usize,
) -> usize {
    // SAFETY: as in `ztl_node_receive`.
    let node = unsafe { node.as_mut() };
    let Some(node) = node.filter(|_| !buffer.is_null()) else {
        return 0;
    };
    let now = node.now(now_ms);
    // SAFETY: not NULL, of this length, and used by nobody else now, as the firmware promises.
    let buffer = unsafe { core::slice::from_raw_parts_mut(buffer, size) };
    node.inner.poll_transmit(now, buffer)
}

/// Milliseconds until ztl_node_run, and then ztl_node_send, must be called if no byte arrives; 0 means now,
/// 1000 is the maximum (also for NULL).
#[unsafe(no_mangle)]
pub unsafe extern "C" fn ztl_node_wait(node: *mut Node, now_ms: c_uint) -> c_uint {
    // SAFETY: as in `ztl_node_receive`.
    let Some(node) = (unsafe { node.as_mut() }) else {
        return 1000;
    };
    let now = node.now(now_ms);
    let due = node.inner.poll_timeout(now).as_millis();
    let wait = due.saturating_sub(now.as_millis());
    c_uint::try_from(wait).unwrap_or(1000).min(1000)
}

/// Emergency stop: makes every component safe and aborts every task. No task starts until
/// ztl_node_clear_stop.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn ztl_node_stop(node: *mut Node, now_ms: c_uint) {
    // SAFETY: as in `ztl_node_receive`.
    if let Some(node) = unsafe { node.as_mut() } {
        let now = node.now(now_ms);
        node.inner.stop_everything(now);
    }
}

/// Ends the emergency stop. Only the firmware can do this; the link has no command for it.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn ztl_node_clear_stop(node: *mut Node) {
    // SAFETY: as in `ztl_node_receive`.
    if let Some(node) = unsafe { node.as_mut() } {
        node.inner.clear_stop();
    }
}

/// 1 if an emergency stop is in effect, else 0.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn ztl_node_is_stopped(node: *const Node) -> c_int {
    // SAFETY: as in `ztl_node_receive`.
    let node = unsafe { node.as_ref() };
    c_int::from(node.is_some_and(|node| node.inner.is_stopped()))
}

/// Copies the statistics of the line.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn ztl_node_counters(node: *const Node, counters: *mut NodeCounters) {
    // SAFETY: as in `ztl_node_receive`.
    let node = unsafe { node.as_ref() };
    if let Some(node) = node.filter(|_| !counters.is_null()) {
        let seen = node.inner.counters();
        let seen = NodeCounters {
            frames: seen.frames,
            errors: seen.errors,
            repeats: seen.repeats,
            out_of_sequence: seen.out_of_sequence,
        };
        // SAFETY: not NULL, and owned by the caller.
        unsafe { counters.write(seen) };
    }
}
