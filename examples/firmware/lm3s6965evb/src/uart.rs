//! The LM3S6965's first UART, a PL011: an interrupt receives, the main loop sends.

use core::convert::Infallible;

use board_support::{Register, vectors};
use cortex_m::interrupt::InterruptNumber;
use cortex_m::peripheral::NVIC;
use embedded_io::{ErrorType, Write};

const fn register(offset: usize) -> Register {
    // SAFETY: the LM3S6965's UART0, which has no access to memory; the offsets are those below.
    unsafe { Register::at(0x4000_C000 + offset) }
}

const DATA: Register = register(0x00);
const FLAGS: Register = register(0x18);
const BAUD_WHOLE: Register = register(0x24);
const BAUD_PART: Register = register(0x28);
const LINE: Register = register(0x2C);
const CONTROL: Register = register(0x30);
const INTERRUPTS: Register = register(0x38);
const CLEAR: Register = register(0x44);

/// In `FLAGS`.
const NOTHING_RECEIVED: u32 = 1 << 4;
/// In `FLAGS`.
const NO_ROOM: u32 = 1 << 5;
/// In `LINE`: 8 bits, and both FIFOs.
const EIGHT_BITS: u32 = 3 << 5;
const FIFOS: u32 = 1 << 4;
/// In `CONTROL`: on, sends, receives.
const ON: u32 = 1 | 1 << 8 | 1 << 9;
/// In `INTERRUPTS`: the FIFO is filling, or nothing more comes.
const ON_RECEIVED: u32 = 1 << 4 | 1 << 6;

/// This UART's number in the interrupt table, as in a chip's crate.
#[derive(Clone, Copy)]
struct Uart0;

// SAFETY: its number by the LM3S6965's manual.
unsafe impl InterruptNumber for Uart0 {
    fn number(self) -> u16 {
        5
    }
}

vectors! { 6: 5 => on_uart }

/// The sending half. Received bytes go to [`app::RECEIVED`].
pub(crate) struct Uart;

impl Uart {
    /// Starts both halves, 115200 baud at 12.5 MHz.
    pub(crate) fn start() -> Self {
        BAUD_WHOLE.write(6);
        BAUD_PART.write(50);
        LINE.write(EIGHT_BITS | FIFOS);
        CONTROL.write(ON);
        INTERRUPTS.write(ON_RECEIVED);
        // SAFETY: no critical section is under way that could rely on the mask.
        unsafe { NVIC::unmask(Uart0) };
        Self
    }
}

/// Receive interrupt: takes all bytes.
extern "C" fn on_uart() {
    CLEAR.write(ON_RECEIVED);
    while FLAGS.read() & NOTHING_RECEIVED == 0 {
        app::RECEIVED.push(DATA.read() as u8);
    }
}

impl ErrorType for Uart {
    type Error = Infallible;
}

/// Takes as many bytes as fit, possibly none.
impl Write for Uart {
    fn write(&mut self, bytes: &[u8]) -> Result<usize, Infallible> {
        let mut count = 0;
        for &byte in bytes {
            if FLAGS.read() & NO_ROOM != 0 {
                break;
            }
            DATA.write(byte.into());
            count += 1;
        }
        Ok(count)
    }

    fn flush(&mut self) -> Result<(), Infallible> {
        Ok(())
    }
}
