//! The nRF51's UART, on the micro:bit's USB: an interrupt receives, the main loop sends.

use core::convert::Infallible;

use board_support::{Register, vectors};
use cortex_m::interrupt::InterruptNumber;
use cortex_m::peripheral::NVIC;
use critical_section::CriticalSection;
use embedded_io::{ErrorType, Write};

const fn register(offset: usize) -> Register {
    // SAFETY: the nRF51's UART0, which has no access to memory; the offsets are those below.
    unsafe { Register::at(0x4000_2000 + offset) }
}

const START_RECEIVING: Register = register(0x000);
const START_SENDING: Register = register(0x008);
const RECEIVED: Register = register(0x108);
const SENT: Register = register(0x11C);
const INTERRUPTS: Register = register(0x304);
const ENABLE: Register = register(0x500);
const TX_PIN: Register = register(0x50C);
const RX_PIN: Register = register(0x514);
const RX: Register = register(0x518);
const TX: Register = register(0x51C);
const BAUD: Register = register(0x524);

/// In `INTERRUPTS`.
const ON_RECEIVED: u32 = 1 << 2;
/// For `BAUD`.
const BAUD_115200: u32 = 0x01D7_E000;
/// This UART's number in the interrupt table, as in a chip's crate.
#[derive(Clone, Copy)]
struct Uart0;

// SAFETY: its number by the nRF51's manual.
unsafe impl InterruptNumber for Uart0 {
    fn number(self) -> u16 {
        2
    }
}

vectors! { 3: 2 => on_uart }

/// The sending half. Received bytes go to [`app::RECEIVED`].
#[derive(Debug)]
pub struct Uart {
    busy: bool,
}

impl Uart {
    /// Starts both halves, 115200 baud.
    #[must_use]
    pub fn start() -> Self {
        TX_PIN.write(24);
        RX_PIN.write(25);
        BAUD.write(BAUD_115200);
        ENABLE.write(4);
        START_SENDING.write(1);
        START_RECEIVING.write(1);
        INTERRUPTS.write(ON_RECEIVED);
        // SAFETY: no critical section is under way that could rely on the mask.
        unsafe { NVIC::unmask(Uart0) };
        Self { busy: false }
    }

    /// Waits until the last byte has left, with its stop bit.
    pub fn wait_sent(&self) {
        while self.busy && SENT.read() == 0 {}
    }
}

/// A byte was received. The UART announces the bytes in its buffer one by one.
extern "C" fn on_uart() {
    // First, since reading the byte announces the next one.
    RECEIVED.write(0);
    // SAFETY: all interrupts have the priority that they have after a reset, so none interrupts this one.
    let alone = unsafe { CriticalSection::new() };
    app::RECEIVED.push_in(alone, RX.read() as u8);
}

impl ErrorType for Uart {
    type Error = Infallible;
}

/// Takes at most one byte, or none if there is no room.
impl Write for Uart {
    fn write(&mut self, bytes: &[u8]) -> Result<usize, Infallible> {
        let Some(&byte) = bytes.first() else {
            return Ok(0);
        };
        if self.busy && SENT.read() == 0 {
            return Ok(0);
        }
        SENT.write(0);
        TX.write(byte.into());
        self.busy = true;
        Ok(1)
    }

    fn flush(&mut self) -> Result<(), Infallible> {
        Ok(())
    }
}
