//! The latest log of a device's firmware, as defmt encoded it.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use serde::{Deserialize, Serialize};
use ztl_core::base64::{Encoder, decode};
use ztl_core::sink::Sink;

#[cfg(feature = "defmt")]
use super::ring::RingIn;

/// Bytes kept of each device's log.
const KEPT: usize = 64 * 1024;

/// The latest log of a device's firmware, as defmt encoded it. Its first message may be incomplete.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct RawLog {
    /// Number of bytes before these since the gateway was started.
    pub from: u64,
    /// At most 64 KiB.
    pub bytes: Vec<u8>,
    /// The device's boot id when the last of them arrived.
    pub boot: u32,
    /// Bytes that the device has dropped since its boot; wraps.
    pub lost: u32,
}

/// The answer to `log NAME FROM`: the log's bytes from the FROMth on, as far as they are kept.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct LogPiece {
    /// Number of bytes before these; more than FROM if those are no longer kept.
    pub from: u64,
    /// The bytes, in base64.
    pub base64: String,
    /// The device's boot id when the last of them arrived.
    pub boot: u32,
    /// Bytes that the device has dropped since its boot.
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

    /// The bytes; `None` if they are not base64.
    #[must_use]
    pub fn bytes(&self) -> Option<Vec<u8>> {
        let mut buffer = vec![0; self.base64.len()];
        let bytes = decode(self.base64.as_bytes(), &mut buffer).ok()?;
        Some(bytes.to_vec())
    }
}

/// New bytes of a log, for its decoder.
#[cfg(feature = "defmt")]
#[derive(Debug)]
pub(super) struct Piece {
    /// Bytes that the device dropped since the last piece.
    pub(super) lost: u32,
    /// Whether the device was reset since the last piece.
    pub(super) reset: bool,
    pub(super) bytes: Vec<u8>,
}

#[derive(Debug, Default)]
struct Inner {
    kept: VecDeque<u8>,
    /// Bytes that are no longer kept.
    passed: u64,
    /// The device's boot id.
    boot: u32,
    lost: u32,
    #[cfg(feature = "defmt")]
    decoder: Option<RingIn<Piece>>,
}

impl Inner {
    #[cfg(feature = "defmt")]
    fn pass_on(&self, lost: u32, reset: bool, bytes: Vec<u8>) {
        if let Some(decoder) = &self.decoder {
            decoder.put(Piece { lost, reset, bytes });
        }
    }

    /// This build has no decoder.
    #[cfg(not(feature = "defmt"))]
    fn pass_on(&self, _lost: u32, _reset: bool, _bytes: Vec<u8>) {}
}

/// A device's log, shared between threads. Locked only briefly.
#[derive(Debug, Clone, Default)]
pub(super) struct DeviceLog(Arc<Mutex<Inner>>);

impl DeviceLog {
    fn inner(&self) -> MutexGuard<'_, Inner> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Adds bytes from the boot `boot`, in which the device has dropped `lost` bytes so far.
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
    pub(super) fn set_decoder(&self, decoder: RingIn<Piece>) {
        let mut inner = self.inner();
        // The bytes so far.
        decoder.put(Piece {
            lost: inner.lost,
            reset: false,
            bytes: inner.kept.iter().copied().collect(),
        });
        inner.decoder = Some(decoder);
    }

    /// Ends the decoder.
    pub(super) fn close(&self) {
        #[cfg(feature = "defmt")]
        drop(self.inner().decoder.take());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_latest_bytes_are_kept_and_older_ones_are_counted() {
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
