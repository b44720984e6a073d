//! The FE310's first UART: an interrupt receives, the main loop sends.

use core::convert::Infallible;

use board_support::Register;
use embedded_io::{ErrorType, Write};
use riscv::interrupt::Interrupt;
use riscv::register::mie;

const fn register(offset: usize) -> Register {
    // SAFETY: the FE310's UART0, which has no access to memory; the offsets are those below.
    unsafe { Register::at(0x1001_3000 + offset) }
}

const fn plic(offset: usize) -> Register {
    // SAFETY: the interrupt controller, which has no access to memory; the offsets are those below.
    unsafe { Register::at(0x0C00_0000 + offset) }
}

const SEND: Register = register(0x00);
const RECEIVE: Register = register(0x04);
const SENDING: Register = register(0x08);
const RECEIVING: Register = register(0x0C);
const INTERRUPTS: Register = register(0x10);
const DIVIDER: Register = register(0x18);

/// In `SEND`: no room; in `RECEIVE`: nothing there.
const NONE: u32 = 1 << 31;
/// In `INTERRUPTS`.
const ON_RECEIVED: u32 = 1 << 1;

/// Its number at the interrupt controller.
const SOURCE: u32 = 3;
const PRIORITY: Register = plic(4 * SOURCE as usize);
const ENABLE: Register = plic(0x2000);
const CLAIM: Register = plic(0x20_0004);

/// The sending half. Received bytes go to [`app::RECEIVED`].
pub(crate) struct Uart;

impl Uart {
    /// Starts both halves, 115200 baud at 16 MHz.
    pub(crate) fn start() -> Self {
        DIVIDER.write(138);
        SENDING.write(1);
        RECEIVING.write(1);
        INTERRUPTS.write(ON_RECEIVED);
        PRIORITY.write(1);
        ENABLE.write(1 << SOURCE);
        // SAFETY: no critical section is under way that could rely on the mask.
        unsafe { mie::set_mext() };
        Self
    }
}

/// Receive interrupt: takes all bytes.
#[riscv_rt::core_interrupt(Interrupt::MachineExternal)]
fn on_uart() {
    let source = CLAIM.read();
    loop {
        let byte = RECEIVE.read();
        if byte & NONE != 0 {
            break;
        }
        app::RECEIVED.push(byte as u8);
    }
    CLAIM.write(source);
}

impl ErrorType for Uart {
    type Error = Infallible;
}

/// Takes as many bytes as fit, possibly none.
impl Write for Uart {
    fn write(&mut self, bytes: &[u8]) -> Result<usize, Infallible> {
        let mut count = 0;
        for &byte in bytes {
            if SEND.read() & NONE != 0 {
                break;
            }
            SEND.write(byte.into());
            count += 1;
        }
        Ok(count)
    }

    fn flush(&mut self) -> Result<(), Infallible> {
        Ok(())
    }
}
