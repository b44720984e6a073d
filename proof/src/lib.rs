//! The machine that the images are linked for: start-up code, a line and a clock.
//!
//! The images are never run, only linked. But they start like any firmware, and their input comes from
//! registers, so the compiler cannot know it. Their size is therefore that of real firmware.
#![no_std]

use core::arch::global_asm;
use core::cell::UnsafeCell;
use core::mem::MaybeUninit;

use embedded_hal::{digital, pwm};
use ztl_core::{Instant, TaskId};

/// An id for use where any will do.
pub const FIRST: TaskId = TaskId::new(1).unwrap();

/// Received bytes; reading the register consumes one.
const LINE_IN: *const u8 = 0x4000_4000 as *const u8;
/// Bytes to send.
const LINE_OUT: *mut u8 = 0x4000_4004 as *mut u8;
/// Milliseconds since the reset.
const CLOCK: *const u32 = 0x4000_8000 as *const u32;

/// The next byte from the line.
pub fn receive() -> u8 {
    // SAFETY: a device register: always present, may hold any value, not a Rust object.
    unsafe { LINE_IN.read_volatile() }
}

/// Sends bytes over the line.
pub fn send(bytes: &[u8]) {
    for &byte in bytes {
        // SAFETY: a device register: always present, not a Rust object.
        unsafe { LINE_OUT.write_volatile(byte) }
    }
}

/// The current time.
pub fn now() -> Instant {
    // SAFETY: a device register: always present, may hold any value, not a Rust object.
    Instant::from_millis(u64::from(unsafe { CLOCK.read_volatile() }))
}

/// A pin with unpredictable values and errors.
pub struct AnyPin;

/// The error of a pin.
#[derive(Debug)]
pub struct AnyPinError;

impl AnyPin {
    fn tell(&self, value: u16) -> Result<(), AnyPinError> {
        send(&value.to_le_bytes());
        self.ask().map(drop)
    }

    fn ask(&self) -> Result<bool, AnyPinError> {
        match receive() {
            0 => Err(AnyPinError),
            level => Ok(level > 1),
        }
    }
}

impl digital::Error for AnyPinError {
    fn kind(&self) -> digital::ErrorKind {
        digital::ErrorKind::Other
    }
}

impl digital::ErrorType for AnyPin {
    type Error = AnyPinError;
}

impl digital::OutputPin for AnyPin {
    fn set_low(&mut self) -> Result<(), AnyPinError> {
        self.tell(0)
    }

    fn set_high(&mut self) -> Result<(), AnyPinError> {
        self.tell(1)
    }
}

impl digital::InputPin for AnyPin {
    fn is_high(&mut self) -> Result<bool, AnyPinError> {
        self.ask()
    }

    fn is_low(&mut self) -> Result<bool, AnyPinError> {
        self.ask()
    }
}

impl pwm::Error for AnyPinError {
    fn kind(&self) -> pwm::ErrorKind {
        pwm::ErrorKind::Other
    }
}

impl pwm::ErrorType for AnyPin {
    type Error = AnyPinError;
}

impl pwm::SetDutyCycle for AnyPin {
    fn max_duty_cycle(&self) -> u16 {
        u16::from_le_bytes([receive(), receive()])
    }

    fn set_duty_cycle(&mut self, duty: u16) -> Result<(), AnyPinError> {
        self.tell(duty)
    }
}

struct Alone;
critical_section::set_impl!(Alone);

// SAFETY: there is one thread and no interrupt.
unsafe impl critical_section::Impl for Alone {
    unsafe fn acquire() {}

    unsafe fn release((): ()) {}
}

/// Static memory for a value that is created once and never dropped.
pub struct Room<T>(UnsafeCell<MaybeUninit<T>>);

// SAFETY: there is one thread and no interrupt.
unsafe impl<T> Sync for Room<T> {}

impl<T> Room<T> {
    /// Creates an empty one.
    #[must_use]
    pub const fn new() -> Self {
        Self(UnsafeCell::new(MaybeUninit::uninit()))
    }

    /// Stores `value`.
    ///
    /// # Safety
    /// Call this at most once per room.
    #[expect(clippy::mut_from_ref, reason = "only one call is allowed")]
    pub unsafe fn fill(&'static self, value: T) -> &'static mut T {
        // SAFETY: no other reference to the content exists, by the condition of this function.
        unsafe { (*self.0.get()).write(value) }
    }
}

impl<T> Default for Room<T> {
    fn default() -> Self {
        Self::new()
    }
}

#[cfg(target_arch = "arm")]
unsafe extern "C" {
    /// Defined below.
    fn reset();
    /// An address, not a function; defined in `image.x`.
    fn stack_top();
}

/// The initial stack pointer, the 15 exceptions of a Cortex-M and the 32 interrupts of a Cortex-M0.
#[cfg(target_arch = "arm")]
#[used]
#[unsafe(link_section = ".vectors")]
static VECTORS: [unsafe extern "C" fn(); 48] = {
    let mut vectors = [unexpected as unsafe extern "C" fn(); 48];
    let [stack, first, ..] = &mut vectors;
    *stack = stack_top;
    *first = reset;
    vectors
};

/// No exception or interrupt is used.
#[cfg(target_arch = "arm")]
extern "C" fn unexpected() {
    loop {
        core::hint::spin_loop();
    }
}

// Copies the initial values into RAM, zeroes the rest, and calls the image's `main`.
#[cfg(target_arch = "arm")]
global_asm!(
    ".section .text.reset, \"ax\"",
    ".global reset",
    ".thumb_func",
    "reset:",
    "ldr r0, =data_start",
    "ldr r1, =data_end",
    "ldr r2, =data_load",
    "1: cmp r0, r1",
    "bhs 2f",
    "ldr r3, [r2]",
    "str r3, [r0]",
    "adds r0, #4",
    "adds r2, #4",
    "b 1b",
    "2: ldr r0, =bss_start",
    "ldr r1, =bss_end",
    "movs r2, #0",
    "3: cmp r0, r1",
    "bhs 4f",
    "str r2, [r0]",
    "adds r0, #4",
    "b 3b",
    "4: bl main",
    "b .",
    ".pool",
);

#[cfg(target_arch = "riscv32")]
global_asm!(
    ".section .text.reset, \"ax\"",
    ".global reset",
    "reset:",
    "la sp, stack_top",
    "la a0, data_start",
    "la a1, data_end",
    "la a2, data_load",
    "1: bgeu a0, a1, 2f",
    "lw a3, 0(a2)",
    "sw a3, 0(a0)",
    "addi a0, a0, 4",
    "addi a2, a2, 4",
    "j 1b",
    "2: la a0, bss_start",
    "la a1, bss_end",
    "3: bgeu a0, a1, 4f",
    "sw zero, 0(a0)",
    "addi a0, a0, 4",
    "j 3b",
    "4: call main",
    "5: j 5b",
);
