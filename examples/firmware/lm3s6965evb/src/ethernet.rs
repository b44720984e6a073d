//! The LM3S6965's Ethernet controller, for smoltcp: a FIFO for frames each way, polled by the main loop.

use board_support::Register;
use smoltcp::phy::{Device, DeviceCapabilities, Medium, RxToken, TxToken};
use smoltcp::time::Instant;

const fn register(offset: usize) -> Register {
    // SAFETY: the LM3S6965's Ethernet controller, which has no access to memory; the offsets are those below.
    unsafe { Register::at(0x4004_8000 + offset) }
}

const RECEIVE_CONTROL: Register = register(0x08);
const TRANSMIT_CONTROL: Register = register(0x0C);
const DATA: Register = register(0x10);
const ADDRESS_LOW: Register = register(0x14);
const ADDRESS_HIGH: Register = register(0x18);
const FRAMES_RECEIVED: Register = register(0x34);
const TRANSMIT: Register = register(0x38);

/// In `RECEIVE_CONTROL`: enabled, with an empty FIFO.
const RECEIVE_ON: u32 = 1;
const RECEIVE_RESET: u32 = 1 << 4;
/// In `TRANSMIT_CONTROL`: enabled, pads short frames, adds checksums, full duplex.
const TRANSMIT_ON: u32 = 1 | 1 << 1 | 1 << 2 | 1 << 4;
/// In `TRANSMIT`: sends the FIFO; reads as 1 until that is done.
const NEW: u32 = 1;

/// The longest frame without its checksum: header and 1500 bytes.
const LONGEST: usize = 1514;
/// Length of the header, which the length in the transmit FIFO does not include.
const HEADER: usize = 14;
/// Length of the length field and of the checksum, which the length in the receive FIFO includes.
const AROUND: usize = 6;

/// The controller.
pub(crate) struct Ethernet {
    received: [u8; LONGEST],
}

impl Ethernet {
    /// Starts it with this MAC address.
    pub(crate) fn start(mac: [u8; 6]) -> Self {
        let [a, b, c, d, e, f] = mac;
        ADDRESS_LOW.write(u32::from_le_bytes([a, b, c, d]));
        ADDRESS_HIGH.write(u32::from_le_bytes([e, f, 0, 0]));
        TRANSMIT_CONTROL.write(TRANSMIT_ON);
        RECEIVE_CONTROL.write(RECEIVE_RESET);
        RECEIVE_CONTROL.write(RECEIVE_ON);
        Self {
            received: [0; LONGEST],
        }
    }

    /// Takes the next frame out of the FIFO, if there is one. Drops the part beyond the longest frame.
    fn receive_frame(&mut self) -> Option<usize> {
        if FRAMES_RECEIVED.read() == 0 {
            return None;
        }
        // The length, and the first two bytes.
        let [low, high, first, second] = DATA.read().to_le_bytes();
        let all = usize::from(u16::from_le_bytes([low, high]));
        let words = all.div_ceil(4).saturating_sub(1);
        let rest = (0..words).flat_map(|_| DATA.read().to_le_bytes());
        let bytes = [first, second].into_iter().chain(rest);
        // To the end, so that the next frame is at the FIFO's head.
        for (place, byte) in bytes.enumerate() {
            if let Some(to) = self.received.get_mut(place) {
                *to = byte;
            }
        }
        Some(all.saturating_sub(AROUND).min(LONGEST))
    }
}

/// A frame that was received.
pub(crate) struct Received<'d>(&'d [u8]);

impl RxToken for Received<'_> {
    fn consume<R, F: FnOnce(&[u8]) -> R>(self, read: F) -> R {
        read(self.0)
    }
}

/// A frame that may be sent.
pub(crate) struct Sent(());

impl TxToken for Sent {
    fn consume<R, F: FnOnce(&mut [u8]) -> R>(self, length: usize, write: F) -> R {
        let mut buffer = [0; LONGEST];
        // The stack keeps to the capabilities below.
        let frame = buffer.get_mut(..length).unwrap_or_default();
        let result = write(frame);
        let data = frame.len().saturating_sub(HEADER) as u16;
        let mut bytes = data.to_le_bytes().into_iter().chain(frame.iter().copied());
        while let Some(first) = bytes.next() {
            let mut next = || bytes.next().unwrap_or_default();
            DATA.write(u32::from_le_bytes([first, next(), next(), next()]));
        }
        TRANSMIT.write(NEW);
        result
    }
}

impl Device for Ethernet {
    type RxToken<'d> = Received<'d>;
    type TxToken<'d> = Sent;

    fn receive(&mut self, _now: Instant) -> Option<(Received<'_>, Sent)> {
        let length = self.receive_frame()?;
        let frame = self.received.get(..length).unwrap_or_default();
        Some((Received(frame), Sent(())))
    }

    fn transmit(&mut self, _now: Instant) -> Option<Sent> {
        (TRANSMIT.read() & NEW == 0).then_some(Sent(()))
    }

    fn capabilities(&self) -> DeviceCapabilities {
        let mut capabilities = DeviceCapabilities::default();
        capabilities.medium = Medium::Ethernet;
        capabilities.max_transmission_unit = LONGEST;
        capabilities
    }
}
