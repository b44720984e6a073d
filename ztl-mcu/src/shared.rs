//! Statics that interrupts share with the main loop: received bytes, an emergency stop, the report of a limit switch, the
//! log. Requires the feature `critical-section`.
//!
//! Every access is a critical section, so it is safe from interrupts of any priority, cores and threads, also on chips
//! without atomic read-modify-write. The chip's crate or its runtime implements `critical-section` (`cortex-m` with
//! `critical-section-single-core`, a HAL). Bytes are copied a few at a time, readings of any length too, in at most 400
//! cycles of a Cortex-M0: 25 µs at 16 MHz. The text of an async driver, 48 bytes at once, takes 610; its goal is copied
//! without a critical section. A motor that an interrupt drives takes 828 and what its pins take, when it computes the
//! next tick of its ramp, also if the interrupt comes late. `cargo xtask bench firmware` measures all of that, with late
//! interrupts and at the greatest lengths that a frame allows, and fails beyond 1000.
//! Only a record of `defmt_logger!` can take longer, because defmt needs one critical section for the whole record.
//!
//! ```
//! use ztl_mcu::shared::{ReceiveQueue, StopFlag};
//!
//! static RECEIVED: ReceiveQueue<128> = ReceiveQueue::new();
//! static STOP: StopFlag = StopFlag::new();
//!
//! /// The interrupt of the serial port.
//! fn on_uart(byte: u8) {
//!     RECEIVED.push(byte);
//! }
//!
//! /// The interrupt of the emergency button.
//! fn on_button() {
//!     STOP.raise();
//! }
//! # on_uart(7);
//! # on_button();
//! # let mut buffer = [0; 8];
//! # assert_eq!(RECEIVED.take(&mut buffer), 1);
//! # assert!(STOP.take());
//! ```
//!
//! The main loop passes both to a [`Pump`](crate::pump::Pump).

mod latest;

use core::cell::Cell;
use core::convert::Infallible;
#[cfg(feature = "async")]
use core::future::poll_fn;
use core::sync::atomic::{AtomicU8, Ordering};
#[cfg(feature = "async")]
use core::task::{Context, Poll, Waker};

use critical_section::{CriticalSection, Mutex};
use embedded_io::{ErrorType, Read, ReadReady};

pub use crate::log::LogQueue;
use crate::pieces::in_pieces;
pub use latest::LatestReading;

/// Bytes copied in one critical section.
const COPIED: usize = 16;
/// Bytes pushed one by one in one critical section.
const PUSHED: usize = 8;

/// A queue of bytes from a receive interrupt to the main loop. The capacity `N` is a power of two.
///
/// When it overflows, it drops and counts everything up to the next delimiter (`00`), so that the node sees one damaged
/// frame and never two halves as one.
///
/// With the feature `async` it is also an `embedded_io_async::Read`, which waits without a poll of its own.
pub struct ReceiveQueue<const N: usize> {
    state: Mutex<Received<N>>,
    #[cfg(feature = "async")]
    reader: WakerCell,
}

/// Uses cells, because an interrupt accesses them for each byte, in few instructions. The order of fields and the inline
/// attributes are for speed: see the cycles in `examples/firmware/README.md`.
#[repr(C)]
struct Received<const N: usize> {
    /// Number of bytes taken and stored; both wrap around.
    taken: Cell<usize>,
    kept: Cell<usize>,
    /// Capacity that is blocked: all of it from a dropped byte to the next delimiter, otherwise 0. The initial state is all
    /// zeros and takes no flash.
    closed: Cell<usize>,
    lost: Cell<u32>,
    bytes: [Cell<u8>; N],
}

impl<const N: usize> Received<N> {
    fn len(&self) -> usize {
        self.kept.get().wrapping_sub(self.taken.get())
    }

    #[inline(always)]
    fn push(&self, byte: u8) {
        let kept = self.kept.get();
        if self.len().wrapping_add(self.closed.get()) >= N && !self.reopen(byte) {
            return;
        }
        if let Some(place) = self.bytes.get(kept & (N - 1)) {
            place.set(byte);
        }
        self.kept.set(kept.wrapping_add(1));
    }

    /// Handles a byte while the queue is full or blocked. Returns whether it is stored.
    // Not inlined: it costs 36 bytes, but `push`, which the interrupt inlines, stays short.
    #[inline(never)]
    fn reopen(&self, byte: u8) -> bool {
        let kept = byte == 0 && self.len() < N;
        self.closed.set(if kept { 0 } else { N });
        if !kept {
            self.lost.set(self.lost.get().wrapping_add(1));
        }
        kept
    }

    fn take(&self, buffer: &mut [u8]) -> usize {
        let count = self.len().min(buffer.len());
        let mut taken = self.taken.get();
        for to in buffer.get_mut(..count).unwrap_or_default() {
            let from = self.bytes.get(taken & (N - 1));
            *to = from.map_or(0, Cell::get);
            taken = taken.wrapping_add(1);
        }
        self.taken.set(taken);
        count
    }
}

impl<const N: usize> ReceiveQueue<N> {
    /// An empty queue.
    #[must_use]
    pub const fn new() -> Self {
        const { assert!(N.is_power_of_two()) }
        Self {
            state: Mutex::new(Received {
                taken: Cell::new(0),
                kept: Cell::new(0),
                closed: Cell::new(0),
                lost: Cell::new(0),
                bytes: [const { Cell::new(0) }; N],
            }),
            #[cfg(feature = "async")]
            reader: WakerCell::new(),
        }
    }

    /// Adds a received byte.
    pub fn push(&self, byte: u8) {
        critical_section::with(|cs| self.push_in(cs, byte));
    }

    /// Like [`push`](Self::push), within an existing critical section: for several bytes at once, or for an interrupt that
    /// no other can preempt.
    #[inline(always)]
    pub fn push_in(&self, cs: CriticalSection<'_>, byte: u8) {
        self.state.borrow(cs).push(byte);
        #[cfg(feature = "async")]
        self.reader.wake_in(cs);
    }

    /// Adds what a circular DMA has written into `ring` since the last call: up to `at`, where it writes next (the length
    /// of the ring less what it has left). `taken` begins with 0. Call it at the half and the end of the ring, and when the
    /// line falls idle, from interrupts that do not preempt each other.
    pub fn push_ring(&self, ring: &[AtomicU8], taken: &mut usize, at: usize) {
        let push = |bytes: &[AtomicU8]| {
            for piece in bytes.chunks(PUSHED) {
                let load = |byte: &AtomicU8| byte.load(Ordering::Relaxed);
                critical_section::with(|cs| {
                    piece.iter().for_each(|byte| self.push_in(cs, load(byte)))
                });
            }
        };
        let from = core::mem::replace(taken, at);
        if at < from {
            push(ring.get(from..).unwrap_or_default());
            push(ring.get(..at).unwrap_or_default());
        } else {
            push(ring.get(from..at).unwrap_or_default());
        }
    }

    /// Adds received bytes, in short critical sections: a packet, or one of two buffers of a DMA.
    pub fn push_slice(&self, bytes: &[u8]) {
        for piece in bytes.chunks(PUSHED) {
            critical_section::with(|cs| piece.iter().for_each(|byte| self.push_in(cs, *byte)));
        }
    }

    /// Moves the first bytes into `buffer` and returns how many.
    pub fn take(&self, buffer: &mut [u8]) -> usize {
        in_pieces(buffer, COPIED, |piece| {
            critical_section::with(|cs| self.state.borrow(cs).take(piece))
        })
    }

    /// Whether the queue is empty.
    pub fn is_empty(&self) -> bool {
        critical_section::with(|cs| self.state.borrow(cs).len() == 0)
    }

    /// Number of dropped bytes; wraps around.
    pub fn lost(&self) -> u32 {
        critical_section::with(|cs| self.state.borrow(cs).lost.get())
    }
}

impl<const N: usize> core::fmt::Debug for ReceiveQueue<N> {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str("ReceiveQueue")
    }
}

impl<const N: usize> Default for ReceiveQueue<N> {
    fn default() -> Self {
        Self::new()
    }
}

impl<const N: usize> ErrorType for &ReceiveQueue<N> {
    type Error = Infallible;
}

impl<const N: usize> ReadReady for &ReceiveQueue<N> {
    fn read_ready(&mut self) -> Result<bool, Infallible> {
        Ok(!self.is_empty())
    }
}

/// Waits for the interrupt while the queue is empty.
impl<const N: usize> Read for &ReceiveQueue<N> {
    fn read(&mut self, buffer: &mut [u8]) -> Result<usize, Infallible> {
        loop {
            match self.take(buffer) {
                0 if !buffer.is_empty() => core::hint::spin_loop(),
                count => return Ok(count),
            }
        }
    }
}

/// Waits for the interrupt while the queue is empty. One reader at a time.
#[cfg(feature = "async")]
impl<const N: usize> embedded_io_async::Read for &ReceiveQueue<N> {
    async fn read(&mut self, buffer: &mut [u8]) -> Result<usize, Infallible> {
        poll_fn(|context| {
            // Before the bytes are taken, so that no wake-up is missed.
            self.reader.register(context);
            match self.take(buffer) {
                0 if !buffer.is_empty() => Poll::Pending,
                count => Poll::Ready(Ok(count)),
            }
        })
        .await
    }
}

/// The waker of a future that waits for an interrupt.
#[cfg(feature = "async")]
struct WakerCell(Mutex<Cell<Option<Waker>>>);

#[cfg(feature = "async")]
impl WakerCell {
    const fn new() -> Self {
        Self(Mutex::new(Cell::new(None)))
    }

    /// Keeps the waker. Call it before looking at what the interrupt changes.
    fn register(&self, context: &Context<'_>) {
        let waker = context.waker().clone();
        // The old waker is dropped outside.
        drop(critical_section::with(|cs| {
            self.0.borrow(cs).replace(Some(waker))
        }));
    }

    fn wake(&self) {
        if let Some(waker) = critical_section::with(|cs| self.0.borrow(cs).take()) {
            waker.wake();
        }
    }

    /// Like [`wake`](Self::wake), within an existing critical section.
    fn wake_in(&self, cs: CriticalSection<'_>) {
        if let Some(waker) = self.0.borrow(cs).take() {
            waker.wake();
        }
    }
}

/// An emergency stop that any interrupt can raise. It stays raised until the main loop takes it.
///
/// A [`Pump`](crate::pump::Pump) takes it and stops its node, until the firmware calls
/// [`Node::clear_stop`](crate::Node::clear_stop).
pub struct StopFlag {
    raised: Mutex<Cell<bool>>,
    /// Waker of the main loop, if that is a future.
    #[cfg(feature = "async")]
    waker: WakerCell,
}

impl StopFlag {
    /// A flag that is not raised.
    #[must_use]
    pub const fn new() -> Self {
        Self {
            raised: Mutex::new(Cell::new(false)),
            #[cfg(feature = "async")]
            waker: WakerCell::new(),
        }
    }

    /// Raises the flag: the main loop stops everything in its next turn. Wakes [`Pump::run`](crate::pump::Pump).
    pub fn raise(&self) {
        critical_section::with(|cs| self.raised.borrow(cs).set(true));
        #[cfg(feature = "async")]
        self.waker.wake();
    }

    /// Whether it is raised.
    pub fn is_raised(&self) -> bool {
        critical_section::with(|cs| self.raised.borrow(cs).get())
    }

    /// Lowers it and returns whether it was raised.
    pub fn take(&self) -> bool {
        critical_section::with(|cs| self.raised.borrow(cs).take())
    }

    /// Ready if it is raised.
    #[cfg(feature = "async")]
    pub(crate) fn poll_raised(&self, context: &Context<'_>) -> Poll<()> {
        self.waker.register(context);
        if self.is_raised() {
            Poll::Ready(())
        } else {
            Poll::Pending
        }
    }
}

impl core::fmt::Debug for StopFlag {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str("StopFlag")
    }
}

impl Default for StopFlag {
    fn default() -> Self {
        Self::new()
    }
}

/// The report of a limit switch: an interrupt sets it, a component polls it.
#[derive(Debug)]
pub struct EndFlag(Mutex<Cell<bool>>);

impl EndFlag {
    /// A flag that is not set.
    #[must_use]
    pub const fn new() -> Self {
        Self(Mutex::new(Cell::new(false)))
    }

    /// Sets the flag; called by the switch's interrupt.
    pub fn report(&self) {
        critical_section::with(|cs| self.0.borrow(cs).set(true));
    }

    /// Whether the end was reached since the flag was last taken.
    pub fn is_reached(&self) -> bool {
        critical_section::with(|cs| self.0.borrow(cs).get())
    }

    /// Clears the flag and returns whether it was set: before moving away from the end, or after handling it.
    pub fn take(&self) -> bool {
        critical_section::with(|cs| self.0.borrow(cs).take())
    }
}

impl Default for EndFlag {
    fn default() -> Self {
        Self::new()
    }
}

#[cfg(test)]
mod tests;
