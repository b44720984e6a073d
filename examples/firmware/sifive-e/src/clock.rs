//! The core's timer, which counts from the reset.

use board_support::{Register, board};
use riscv::interrupt::Interrupt;
use riscv::register::{mie, mstatus};
use ztl_mcu::Instant;

const fn register(offset: usize) -> Register {
    // SAFETY: the CLINT, which has no access to memory; the offsets are those below.
    unsafe { Register::at(0x0200_0000 + offset) }
}

const WAKE_LOW: Register = register(0x4000);
const WAKE_HIGH: Register = register(0x4004);
const TIME_LOW: Register = register(0xBFF8);
const TIME_HIGH: Register = register(0xBFFC);

/// Counts a microsecond in QEMU; on the chip itself the timer is slower, 32,768 Hz.
const PER_US: u64 = 10;

/// The timer, with a tick each millisecond.
pub(crate) struct Clock(());

impl Clock {
    pub(crate) fn start() -> Self {
        wake_in_a_millisecond();
        // SAFETY: no critical section is under way that could rely on the masks.
        unsafe {
            mie::set_mtimer();
            mstatus::set_mie();
        }
        Self(())
    }
}

impl board::Clock for Clock {
    fn now(&mut self) -> Instant {
        Instant::from_micros(micros())
    }

    fn sleep(&mut self) {
        riscv::asm::wfi();
    }
}

/// The time since the reset.
pub(crate) fn micros() -> u64 {
    counts() / PER_US
}

fn counts() -> u64 {
    loop {
        let (high, low) = (TIME_HIGH.read(), TIME_LOW.read());
        // Otherwise the lower half has wrapped around in between.
        if high == TIME_HIGH.read() {
            return u64::from(high) << 32 | u64::from(low);
        }
    }
}

fn wake_in_a_millisecond() {
    let wake = counts() + 1000 * PER_US;
    // Never a moment that has passed, in between.
    WAKE_HIGH.write(u32::MAX);
    WAKE_LOW.write(wake as u32);
    WAKE_HIGH.write((wake >> 32) as u32);
}

#[riscv_rt::core_interrupt(Interrupt::MachineTimer)]
fn on_tick() {
    wake_in_a_millisecond();
    board::poll_buttons();
}
