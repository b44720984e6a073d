//! Decodes the log of a device's firmware and writes it to the gateway's own log.

use std::time::Duration;

use tracing::{debug, error, info, trace, warn};

use super::logs::{DeviceLog, Piece};
use super::ring::{Empty, RingOut, ring};
use crate::defmt::{Decoder, Level, Malformed, Message};
use crate::log_targets::{FIRMWARE, GATEWAY};
use crate::rate_limit::RateLimit;
use crate::time::now;

/// Pieces that may wait to be decoded; each is what one frame of the link carries.
const WAITING: usize = 1024;
/// Messages that may come at once.
const BURST: u32 = 200;
/// Messages that may come in a second: firmware that logs in a loop for a month must not fill a disk.
const PER_SECOND: u32 = 20;
/// After so many malformed messages in a row, the ELF file is probably the wrong one.
const MALFORMED: u32 = 3;

impl DeviceLog {
    /// Decodes the log on a thread that ends with the device.
    pub(super) fn read_by(
        &self,
        device: &str,
        decoder: Decoder,
        elf: String,
    ) -> std::io::Result<()> {
        let (put, take) = ring(WAITING);
        let mut log = FirmwareLog {
            device: device.to_owned(),
            elf,
            decoder,
            limit: RateLimit::new(BURST, Duration::from_secs(1) / PER_SECOND, now()),
            left_out: 0,
            malformed: 0,
            warned: false,
        };
        std::thread::Builder::new()
            .name(format!("ztl-log-{device}"))
            .spawn(move || log.run(&take))?;
        self.set_decoder(put);
        Ok(())
    }
}

struct FirmwareLog {
    device: String,
    elf: String,
    decoder: Decoder,
    limit: RateLimit,
    /// Messages left out since the last that was logged.
    left_out: u64,
    /// Malformed messages in a row.
    malformed: u32,
    /// Whether the ELF file was reported as the wrong one.
    warned: bool,
}

impl FirmwareLog {
    fn run(&mut self, pieces: &RingOut<Piece>) {
        loop {
            let wait = match self.left_out {
                0 => Duration::MAX,
                _ => Duration::from_secs(1),
            };
            match pieces.take(wait) {
                Ok(piece) => self.read(&piece, pieces.take_lost()),
                Err(Empty::Now) => self.log_left_out(),
                Err(Empty::Forever) => return self.log_left_out(),
            }
        }
    }

    fn read(&mut self, piece: &Piece, pieces_lost: u64) {
        let device = &self.device;
        if piece.lost > 0 {
            let lost = piece.lost;
            warn!(target: FIRMWARE, device, lost, "{device}: {lost} bytes of its log were lost, because its buffer was full");
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
                self.malformed = 0;
                if self.limit.take(now()) {
                    self.log_left_out();
                    self.log(&message);
                } else {
                    self.left_out += 1;
                }
            }
            Err(Malformed) => {
                self.malformed = self.malformed.saturating_add(1);
                if self.malformed >= MALFORMED && !self.warned {
                    self.warned = true;
                    let (device, elf) = (&self.device, &self.elf);
                    warn!(target: GATEWAY, device, "Device '{device}' sends a log that does not match {elf}: it is probably not the ELF file of its firmware.");
                }
            }
        }
    }

    fn log_left_out(&mut self) {
        let count = std::mem::take(&mut self.left_out);
        if count > 0 {
            let device = &self.device;
            warn!(target: FIRMWARE, device, "{device}: {count} messages were dropped: more than {PER_SECOND} a second");
        }
    }

    fn log(&self, message: &Message) {
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
