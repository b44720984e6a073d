//! The CMSDK's first UART: an interrupt receives, the main loop sends.

use core::convert::Infallible;

use board_support::{Register, vectors};
use cortex_m::interrupt::InterruptNumber;
use cortex_m::peripheral::NVIC;
use embedded_io::{ErrorType, Write};

const fn register(offset: usize) -> Register {
    // SAFETY: the CMSDK's UART0, which has no access to memory; the offsets are those below.
    unsafe { Register::at(0x4000_4000 + offset) }
}

const DATA: Register = register(0x00);
const STATE: Register = register(0x04);
const CONTROL: Register = register(0x08);
const CLEAR: Register = register(0x0C);
const DIVIDER: Register = register(0x10);

/// In `STATE`.
const NO_ROOM: u32 = 1;
/// In `STATE`, and to be written to `CLEAR`.
const RECEIVED: u32 = 1 << 1;
/// In `CONTROL`: sends, receives, and interrupts when it has received.
const ON: u32 = 1 | 1 << 1 | 1 << 3;

/// The number of this UART's receiver in the interrupt table, as in a chip's crate.
#[derive(Clone, Copy)]
struct Uart0Rx;

// SAFETY: its number by the application note AN386.
unsafe impl InterruptNumber for Uart0Rx {
    fn number(self) -> u16 {
        0
    }
}

vectors! { 1: 0 => on_uart }

/// The sending half. Received bytes go to [`app::RECEIVED`].
pub(crate) struct Uart;

impl Uart {
    /// Starts both halves, 115200 baud at 25 MHz.
    pub(crate) fn start() -> Self {
        DIVIDER.write(217);
        CONTROL.write(ON);
        // SAFETY: no critical section is under way that could rely on the mask.
        unsafe { NVIC::unmask(Uart0Rx) };
        Self
    }
}

/// Receive interrupt: takes a byte.
extern "C" fn on_uart() {
    while STATE.read() & RECEIVED != 0 {
        // First, since reading the byte lets the next one come.
        CLEAR.write(RECEIVED);
        app::RECEIVED.push(DATA.read() as u8);
    }
}

impl ErrorType for Uart {
    type Error = Infallible;
}

/// Takes at most one byte, or none if there is no room.
impl Write for Uart {
    fn write(&mut self, bytes: &[u8]) -> Result<usize, Infallible> {
        let Some(&byte) = bytes.first().filter(|_| STATE.read() & NO_ROOM == 0) else {
            return Ok(0);
        };
        DATA.write(byte.into());
        Ok(1)
    }

    fn flush(&mut self) -> Result<(), Infallible> {
        Ok(())
    }
}
