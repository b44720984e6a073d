//! USART2 by DMA1: stream 5 receives, stream 6 sends.

use core::convert::Infallible;
use core::sync::atomic::{AtomicU8, Ordering, fence};

use board_support::Register;
use embedded_io::{ErrorType, Write};

const fn register(address: usize) -> Register {
    // SAFETY: RCC, USART2 and DMA1 of the STM32F401; the addresses are those below. Only `start` and `Sender::write` give
    // DMA1 memory.
    unsafe { Register::at(address) }
}

const CLOCKS: Register = register(0x4002_3830);

const STATUS: Register = register(0x4000_4400);
const DATA: Register = register(0x4000_4404);
const BAUD: Register = register(0x4000_4408);
const CONTROL: Register = register(0x4000_440C);
const CONTROL_DMA: Register = register(0x4000_4414);

const DONE: Register = register(0x4002_6004);
const CLEAR: Register = register(0x4002_600C);

/// Of `DONE` and `CLEAR`: all flags of stream 5; of stream 6; its end, also by an error.
const RECEIVED: u32 = 0b11_1101 << 6;
const SENT: u32 = 0b11_1101 << 16;
const SENT_ALL: u32 = 1 << 21 | 1 << 19;

/// The registers of a stream.
struct Stream(usize);

const RX: Stream = Stream(0x4002_6088);
const TX: Stream = Stream(0x4002_60A0);

impl Stream {
    const fn control(&self) -> Register {
        register(self.0)
    }

    const fn left(&self) -> Register {
        register(self.0 + 0x4)
    }

    fn start(&self, memory: usize, len: usize, control: u32) {
        register(self.0 + 0x8).write(0x4000_4404);
        register(self.0 + 0xC).write(memory as u32);
        self.left().write(len as u32);
        // Channel 4, counts up in memory, on.
        self.control().write(4 << 25 | 1 << 10 | control | 1);
    }
}

/// What the DMA writes round and round.
static RING: [AtomicU8; 64] = [const { AtomicU8::new(0) }; 64];

/// Starts both halves, 115200 baud at 16 MHz.
pub(crate) fn start() -> (Receiver, Sender) {
    CLOCKS.write(CLOCKS.read() | 1 << 21);
    BAUD.write(139);
    // By DMA in both directions.
    CONTROL_DMA.write(1 << 7 | 1 << 6);
    // Circular, with interrupts at the half and the end.
    RX.start(RING.as_ptr().addr(), RING.len(), 1 << 8 | 1 << 4 | 1 << 3);
    // On, an interrupt when the line falls idle, sends, receives.
    CONTROL.write(1 << 13 | 1 << 4 | 1 << 3 | 1 << 2);
    (Receiver { taken: 0 }, Sender { sending: None })
}

/// Passes on what the DMA has received.
pub(crate) struct Receiver {
    /// Up to where it has.
    taken: usize,
}

impl Receiver {
    /// The DMA is at the half or at the end.
    pub(crate) fn on_dma(&mut self) {
        CLEAR.write(RECEIVED);
        self.pass_on();
    }

    /// The line is idle.
    pub(crate) fn on_idle(&mut self) {
        // Both together clear the flag.
        let _ = (STATUS.read(), DATA.read());
        self.pass_on();
    }

    fn pass_on(&mut self) {
        let at = RING.len().saturating_sub(RX.left().read() as usize);
        app::RECEIVED.push_ring(&RING, &mut self.taken, at);
    }
}

/// Sends from the caller's memory.
pub(crate) struct Sender {
    /// Address and length of what the DMA sends.
    sending: Option<(usize, usize)>,
}

impl ErrorType for Sender {
    type Error = Infallible;
}

/// Takes all bytes, but only when the DMA has sent them: until then it takes none and is to be called again with the same
/// bytes. A `Pump` does that: the bytes of `Node::transmit_buf` stay what and where they are until they are consumed.
impl Write for Sender {
    fn write(&mut self, bytes: &[u8]) -> Result<usize, Infallible> {
        let these = (bytes.as_ptr().addr(), bytes.len());
        match self.sending {
            None if bytes.is_empty() => Ok(0),
            None => {
                self.sending = Some(these);
                // The bytes are in memory before the DMA reads them.
                fence(Ordering::Release);
                TX.start(these.0, these.1, 1 << 6);
                Ok(0)
            }
            Some(_) if DONE.read() & SENT_ALL == 0 => Ok(0),
            Some(sent) => {
                CLEAR.write(SENT);
                self.sending = None;
                // Otherwise they are other bytes, which are sent by the next call.
                Ok(if sent == these { bytes.len() } else { 0 })
            }
        }
    }

    fn flush(&mut self) -> Result<(), Infallible> {
        Ok(())
    }
}
