//! What a device's firmware logs: the latest of it as it came, and, with its ELF file, in the
//! gateway's own log.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use serde::{Deserialize, Serialize};
use ztl_core::base64::{Encoder, decode};
use ztl_core::sink::Sink;

#[cfg(feature = "defmt")]
use super::ring::RingIn;

/// Bytes that are kept of each device's log.
const KEPT: usize = 64 * 1024;

/// The latest that a device's firmware has logged, as defmt has encoded it: the message at its
/// beginning may be cut.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct RawLog {
    /// How many bytes have come before these, since the gateway was started.
    pub from: u64,
    /// At most 64 KiB.
    pub bytes: Vec<u8>,
    /// The device's boot in which the last of them came.
    pub boot: u32,
    /// How many bytes the device had no room for, since its boot; wraps.
    pub lost: u32,
}

/// What the gateway answers when `$ztl` is asked for `log NAME FROM`: the log's bytes from the FROMth on,
/// as far as they are kept.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct LogPiece {
    /// How many bytes have come before these; more than was asked for where those are no longer
    /// kept.
    pub from: u64,
    /// The bytes, in base64.
    pub base64: String,
    /// The device's boot in which the last of them came.
    pub boot: u32,
    /// How many bytes the device had no room for, since its boot.
    pub lost: u32,
}

impl LogPiece {
    pub(super) fn of(log: &RawLog, from: u64) -> Self {
        let end = log.from + log.bytes.len() as u64;
        let from = from.clamp(log.from, end);
        let skipped = usize::try_from(from - log.from).unwrap_or(usize::MAX);
        let mut base64 = Vec::new();
        let mut out = |bytes: &[u8]| base64.extend_from_slice(bytes);
        let mut encoder = Encoder::new(&mut out);
        encoder.put(log.bytes.get(skipped..).unwrap_or_default());
        encoder.finish();
        Self {
            from,
            base64: String::from_utf8_lossy(&base64).into_owned(),
            boot: log.boot,
            lost: log.lost,
        }
    }

    /// The bytes; `None` when they are no base64.
    #[must_use]
    pub fn bytes(&self) -> Option<Vec<u8>> {
        let mut buffer = vec![0; self.base64.len()];
        let bytes = decode(self.base64.as_bytes(), &mut buffer).ok()?;
        Some(bytes.to_vec())
    }
}

/// Bytes for whoever reads them.
#[cfg(feature = "defmt")]
#[derive(Debug)]
pub(super) struct Piece {
    /// How many bytes the device has dropped since the last piece.
    pub(super) lost: u32,
    /// It was reset since then.
    pub(super) reset: bool,
    pub(super) bytes: Vec<u8>,
}

#[derive(Debug, Default)]
struct Inner {
    kept: VecDeque<u8>,
    /// How many bytes are no longer kept.
    passed: u64,
    /// Of the boot of this number.
    boot: u32,
    lost: u32,
    #[cfg(feature = "defmt")]
    reader: Option<RingIn<Piece>>,
}

impl Inner {
    #[cfg(feature = "defmt")]
    fn pass_on(&self, lost: u32, reset: bool, bytes: Vec<u8>) {
        if let Some(reader) = &self.reader {
            reader.put(Piece { lost, reset, bytes });
        }
    }

    /// Nobody here can read it.
    #[cfg(not(feature = "defmt"))]
    fn pass_on(&self, _lost: u32, _reset: bool, _bytes: Vec<u8>) {}
}

/// A device's log; never held for long.
#[derive(Debug, Clone, Default)]
pub(super) struct DeviceLog(Arc<Mutex<Inner>>);

impl DeviceLog {
    fn inner(&self) -> MutexGuard<'_, Inner> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes what has come from the boot of this number, which has lost so much since.
    pub(super) fn put(&self, boot: u32, lost: u32, bytes: Vec<u8>) {
        let mut inner = self.inner();
        let reset = inner.boot != boot;
        let before = if reset { 0 } else { inner.lost };
        inner.boot = boot;
        inner.lost = lost;
        let lost = lost.wrapping_sub(before);
        let dropped = (inner.kept.len() + bytes.len()).saturating_sub(KEPT);
        let dropped = dropped.min(inner.kept.len());
        inner.kept.drain(..dropped);
        let too_many = bytes.len().saturating_sub(KEPT);
        inner.passed += (dropped + too_many) as u64;
        inner.kept.extend(bytes.iter().skip(too_many));
        inner.pass_on(lost, reset, bytes);
    }

    pub(super) fn raw(&self) -> RawLog {
        let inner = self.inner();
        RawLog {
            from: inner.passed,
            bytes: inner.kept.iter().copied().collect(),
            boot: inner.boot,
            lost: inner.lost,
        }
    }

    #[cfg(feature = "defmt")]
    pub(super) fn set_reader(&self, reader: RingIn<Piece>) {
        let mut inner = self.inner();
        // What has come already.
        reader.put(Piece {
            lost: inner.lost,
            reset: false,
            bytes: inner.kept.iter().copied().collect(),
        });
        inner.reader = Some(reader);
    }

    /// There will be no more.
    pub(super) fn close(&self) {
        #[cfg(feature = "defmt")]
        drop(self.inner().reader.take());
    }
}

#[cfg(feature = "defmt")]
mod readable {
    use std::time::{Duration, Instant};

    use tracing::{debug, error, info, trace, warn};

    use super::super::ring::{Empty, RingOut, ring};
    use super::super::voice::LOG;
    use super::{DeviceLog, Piece};
    use crate::defmt::{Decoder, Level, Malformed, Message};

    /// Pieces that may wait to be read; each is what one frame of the link carries.
    const WAITING: usize = 1024;
    /// Messages that may come at once, and in a second: a firmware that logs in a loop for a month
    /// must not fill a disk.
    const BURST: u32 = 200;
    const PER_SECOND: u32 = 20;
    /// After so many that make no sense, and none that does, the file is the wrong one.
    const SENSELESS: u32 = 3;
    /// Name under which firmware logs.
    const FIRMWARE: &str = "firmware";

    impl DeviceLog {
        /// Logs what comes, on a thread that ends with the device.
        pub(in super::super) fn read_by(
            &self,
            device: &str,
            decoder: Decoder,
            elf: String,
        ) -> std::io::Result<()> {
            let (put, take) = ring(WAITING);
            let mut reader = Reader {
                device: device.to_owned(),
                elf,
                decoder,
                allowed: BURST,
                since: Instant::now(),
                left_out: 0,
                senseless: 0,
                warned: false,
            };
            std::thread::Builder::new()
                .name(format!("ztl-log-{device}"))
                .spawn(move || reader.run(&take))?;
            self.set_reader(put);
            Ok(())
        }
    }

    struct Reader {
        device: String,
        elf: String,
        decoder: Decoder,
        /// Messages that may still come at once.
        allowed: u32,
        since: Instant,
        left_out: u64,
        /// Messages in a row that make no sense.
        senseless: u32,
        warned: bool,
    }

    impl Reader {
        fn run(&mut self, take: &RingOut<Piece>) {
            loop {
                let wait = match self.left_out {
                    0 => Duration::MAX,
                    _ => Duration::from_secs(1),
                };
                match take.take(wait) {
                    Ok(piece) => self.read(&piece, take.take_lost()),
                    Err(Empty::Now) => self.refill(),
                    Err(Empty::ForEver) => return self.say_left_out(),
                }
            }
        }

        fn read(&mut self, piece: &Piece, pieces_lost: u64) {
            let device = &self.device;
            if piece.lost > 0 {
                let lost = piece.lost;
                warn!(target: FIRMWARE, device, lost, "{device}: {lost} bytes of its log were lost, since it had no room for them");
            }
            if pieces_lost > 0 || piece.reset {
                self.decoder.skip();
            }
            let mut messages = Vec::new();
            self.decoder
                .push(&piece.bytes, &mut |message| messages.push(message));
            for message in messages {
                self.on_message(message);
            }
        }

        fn on_message(&mut self, message: Result<Message, Malformed>) {
            match message {
                Ok(message) => {
                    self.senseless = 0;
                    self.refill();
                    if self.allowed == 0 {
                        self.left_out += 1;
                        return;
                    }
                    self.say_left_out();
                    self.allowed -= 1;
                    self.say(&message);
                }
                Err(Malformed) => {
                    self.senseless = self.senseless.saturating_add(1);
                    if self.senseless >= SENSELESS && !self.warned {
                        self.warned = true;
                        let (device, elf) = (&self.device, &self.elf);
                        warn!(target: LOG, device, "Device '{device}' logs what makes no sense by {elf}: probably it is not the ELF file of its firmware.");
                    }
                }
            }
        }

        fn refill(&mut self) {
            let seconds = self.since.elapsed().as_secs();
            if seconds == 0 {
                return;
            }
            self.since = Instant::now();
            let more = u32::try_from(seconds)
                .unwrap_or(BURST)
                .saturating_mul(PER_SECOND);
            self.allowed = self.allowed.saturating_add(more).min(BURST);
            self.say_left_out();
        }

        fn say_left_out(&mut self) {
            let count = std::mem::take(&mut self.left_out);
            if count > 0 {
                let device = &self.device;
                warn!(target: FIRMWARE, device, "{device}: {count} messages are left out, since there are more than {PER_SECOND} a second");
            }
        }

        fn say(&self, message: &Message) {
            let device = &self.device;
            let mut text = device.clone();
            text.push_str(": ");
            if let Some(timestamp) = &message.timestamp {
                text.push_str(&format!("[{timestamp}] "));
            }
            text.push_str(&message.text);
            let place = message.place.as_deref().unwrap_or_default();
            if !place.is_empty() {
                text.push_str(&format!(" ({place})"));
            }
            // One message is one line, and moves no terminal's cursor.
            let text = text.replace(|c: char| c.is_control() && c != '\t', "\u{fffd}");
            match message.level {
                Some(Level::Error) => error!(target: FIRMWARE, device, place, "{text}"),
                Some(Level::Warn) => warn!(target: FIRMWARE, device, place, "{text}"),
                Some(Level::Info) | None => info!(target: FIRMWARE, device, place, "{text}"),
                Some(Level::Debug) => debug!(target: FIRMWARE, device, place, "{text}"),
                Some(Level::Trace) => trace!(target: FIRMWARE, device, place, "{text}"),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_latest_is_kept_and_what_was_lost_is_counted() {
        let log = DeviceLog::default();
        assert_eq!(log.raw(), RawLog::default());
        for number in 0..=255u8 {
            log.put(7, u32::from(number), vec![number; 1000]);
        }
        let raw = log.raw();
        assert_eq!((raw.bytes.len(), raw.lost), (KEPT, 255));
        assert_eq!(raw.from, 256_000 - KEPT as u64);
        assert_eq!(raw.bytes.last(), Some(&255));
        assert_eq!(raw.bytes.first(), Some(&190));
        log.put(8, 0, vec![1; 2 * KEPT]);
        assert_eq!(log.raw().bytes, vec![1; KEPT]);
    }
}
