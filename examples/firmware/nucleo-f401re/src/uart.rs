//! USART2, which the ST-Link carries to the host: an interrupt receives, the main loop sends.

use core::convert::Infallible;

use board_support::{Register, vectors};
use cortex_m::interrupt::InterruptNumber;
use cortex_m::peripheral::NVIC;
use embedded_io::{ErrorType, Write};

const fn register(offset: usize) -> Register {
    // SAFETY: the STM32F401's USART2, which has no access to memory; the offsets are those below.
    unsafe { Register::at(0x4000_4400 + offset) }
}

const STATUS: Register = register(0x00);
const DATA: Register = register(0x04);
const BAUD: Register = register(0x08);
const CONTROL: Register = register(0x0C);

/// In `STATUS`: a byte was received; one was lost before. Reading `DATA` clears both.
const RECEIVED: u32 = 1 << 5 | 1 << 3;
/// In `STATUS`.
const ROOM: u32 = 1 << 7;
/// In `CONTROL`: on, interrupts when it has received, sends, receives.
const ON: u32 = 1 << 13 | 1 << 5 | 1 << 3 | 1 << 2;

/// This UART's number in the interrupt table, as in a chip's crate.
#[derive(Clone, Copy)]
struct Usart2;

// SAFETY: its number by the STM32F401's manual.
unsafe impl InterruptNumber for Usart2 {
    fn number(self) -> u16 {
        38
    }
}

vectors! { 39: 38 => on_uart }

/// The sending half. Received bytes go to [`app::RECEIVED`].
pub(crate) struct Uart;

impl Uart {
    /// Starts both halves, 115200 baud at 16 MHz.
    pub(crate) fn start() -> Self {
        BAUD.write(139);
        CONTROL.write(ON);
        // SAFETY: no critical section is under way that could rely on the mask.
        unsafe { NVIC::unmask(Usart2) };
        Self
    }
}

/// Receive interrupt: takes a byte.
extern "C" fn on_uart() {
    while STATUS.read() & RECEIVED != 0 {
        app::RECEIVED.push(DATA.read() as u8);
    }
}

impl ErrorType for Uart {
    type Error = Infallible;
}

/// Takes at most one byte, or none if there is no room.
impl Write for Uart {
    fn write(&mut self, bytes: &[u8]) -> Result<usize, Infallible> {
        let Some(&byte) = bytes.first().filter(|_| STATUS.read() & ROOM != 0) else {
            return Ok(0);
        };
        DATA.write(byte.into());
        Ok(1)
    }

    fn flush(&mut self) -> Result<(), Infallible> {
        Ok(())
    }
}
