//! The machine that the images run on: a start, a line and a clock.
//!
//! Nobody runs them; they are linked. But what they read comes from registers, so the compiler
//! cannot know it, and they begin as any firmware does, so what they weigh is what firmware weighs.
#![no_std]

use core::arch::global_asm;
use core::cell::UnsafeCell;
use core::mem::MaybeUninit;

use embedded_hal::{digital, pwm};
use ztl_core::{Instant, TaskId};

/// An id for where there is no better one.
pub const FIRST: TaskId = TaskId::new(1).unwrap();

/// Received bytes; reading one takes it.
const LINE_IN: *const u8 = 0x4000_4000 as *const u8;
/// Bytes to be sent.
const LINE_OUT: *mut u8 = 0x4000_4004 as *mut u8;
/// Milliseconds since the reset.
const CLOCK: *const u32 = 0x4000_8000 as *const u32;

/// The next byte from the line.
pub fn receive() -> u8 {
    // SAFETY: a device's register: always there, of any value, and no Rust object.
    unsafe { LINE_IN.read_volatile() }
}

/// Sends bytes over the line.
pub fn send(bytes: &[u8]) {
    for &byte in bytes {
        // SAFETY: a device's register: always there, and no Rust object.
        unsafe { LINE_OUT.write_volatile(byte) }
    }
}

/// What the clock says.
pub fn now() -> Instant {
    // SAFETY: a device's register: always there, of any value, and no Rust object.
    Instant::from_millis(u64::from(unsafe { CLOCK.read_volatile() }))
}

/// A pin that does whatever, and fails now and then.
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

/// Static memory for something that is made once and lives for ever.
pub struct Room<T>(UnsafeCell<MaybeUninit<T>>);

// SAFETY: there is one thread and no interrupt.
unsafe impl<T> Sync for Room<T> {}

impl<T> Room<T> {
    /// Empty.
    #[must_use]
    pub const fn new() -> Self {
        Self(UnsafeCell::new(MaybeUninit::uninit()))
    }

    /// Puts `value` into it.
    ///
    /// # Safety
    /// To be called once for each room.
    #[expect(
        clippy::mut_from_ref,
        reason = "of the only call, as the condition says"
    )]
    pub unsafe fn fill(&'static self, value: T) -> &'static mut T {
        // SAFETY: by this function's condition, no other reference to the content exists.
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
    /// Below.
    fn reset();
    /// An address, not a function; from `image.x`.
    fn stack_top();
}

/// The 15 exceptions of a Cortex-M and the 32 interrupts that a Cortex-M0 may have, in place of
/// the first one the stack's start.
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
