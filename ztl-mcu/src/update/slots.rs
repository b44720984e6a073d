//! Updates with the bootloader of `embassy-boot`: an image that runs, and room for a second one. Requires the feature
//! `embassy-boot`.

use core::fmt;
use core::time::Duration;

use embassy_boot::{
    AlignedBuffer, BlockingFirmwareState, FirmwareUpdaterConfig, FirmwareUpdaterError, State,
};
use embedded_storage::nor_flash::NorFlash;
use salty::Sha512;
use ztl_core::manifest::{HEAD_LEN, IMAGE_UNIT, MANIFEST_LEN, Manifest, SIGNATURE_LEN, Version};

use super::signed::Check;
use super::{Firmware, Receiving, SelfTest, UpdateError, Updater, Verification};

#[cfg(test)]
mod tests;

/// What the firmware says of itself, and whose images it takes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Image {
    /// The board that images must be for, as in their manifest.
    pub board: &'static str,
    /// The version of this firmware, such as `1.2.3`.
    pub version: &'static str,
    /// The public key of those who sign images.
    pub key: &'static [u8; 32],
    /// How long new firmware may run before it is confirmed; then it restarts, and the bootloader goes back to the old one.
    pub trial: Duration,
    /// The task that tests new firmware.
    pub self_test: Option<SelfTest<'static>>,
}

/// Receives images into the partition `DFU` of `embassy-boot`, and marks them in its partition `STATE`.
///
/// `DFU` must be exactly one page longer than the active partition. While an image is received, this page holds its manifest
/// and how many pages are complete, so that an update goes on after a power cut. An image has at most the length of the active
/// partition less 64 bytes: its manifest stands behind it.
///
/// A call of [`verify`](Updater::verify) hashes 128 bytes, or checks one of the 256 bits of the signature. How far it is stays in
/// RAM: after a reset, the verification begins from its beginning. `docs/update.md` says how long each call takes; choose a
/// [link timeout](crate::Identity::link_timeout) that is longer.
pub struct Slots<DFU, STATE> {
    dfu: DFU,
    state: STATE,
    image: Image,
    version: Version,
    is_confirmed: bool,
    restart: fn(),
    incoming: Option<Incoming>,
}

/// The image that is received.
struct Incoming {
    head: [u8; HEAD_LEN],
    signature: [u8; SIGNATURE_LEN],
    length: u32,
    /// The bytes before it are stored.
    offset: u32,
    stage: Stage,
}

/// What the verification does.
#[expect(clippy::large_enum_variant, reason = "there is no heap")]
enum Stage {
    /// Hashes the image and the head of its manifest. The bytes before `at` are hashed.
    Hash {
        at: u32,
        hash: Sha512,
    },
    Signature(Check),
}

/// Bytes that are hashed at a time: a block of SHA-512.
const BLOCK: usize = 128;

/// Bytes behind the image: the head of its manifest, in whole words of the flash.
const TAIL: usize = HEAD_LEN.next_multiple_of(IMAGE_UNIT);

/// Bytes of the last page for the manifest, in whole words of the flash; behind them there is a word for each page.
const RECORD: usize = MANIFEST_LEN.next_multiple_of(IMAGE_UNIT);

impl<DFU: NorFlash, STATE: NorFlash> Slots<DFU, STATE> {
    /// With the two partitions, which [`FirmwareUpdaterConfig`] can take from the linker's script. `restart` resets the
    /// processor. `None` if the version is not one, if the flash's words are longer than 32 bytes, if the partition has less than
    /// two pages, or if the state cannot be read.
    pub fn new(
        partitions: FirmwareUpdaterConfig<DFU, STATE>,
        image: Image,
        restart: fn(),
    ) -> Option<Self> {
        let FirmwareUpdaterConfig { dfu, state } = partitions;
        let pages = dfu.capacity().checked_div(DFU::ERASE_SIZE)?;
        let divides = |unit: usize| IMAGE_UNIT.checked_rem(unit) == Some(0);
        let fits = divides(DFU::WRITE_SIZE) && divides(STATE::WRITE_SIZE);
        if !fits || pages < 2 || DFU::ERASE_SIZE < RECORD {
            return None;
        }
        let mut slots = Self {
            dfu,
            state,
            version: Version::parse(image.version).ok()?,
            image,
            is_confirmed: true,
            restart,
            incoming: None,
        };
        slots.is_confirmed = slots.with_state(|state| state.get_state()).ok()? != State::Swap;
        Some(slots)
    }

    /// The bootloader's state.
    fn with_state<T>(
        &mut self,
        work: impl FnOnce(&mut BlockingFirmwareState<'_, &mut STATE>) -> Result<T, FirmwareUpdaterError>,
    ) -> Result<T, UpdateError> {
        let mut word = AlignedBuffer([0; IMAGE_UNIT]);
        let word = word.0.get_mut(..STATE::WRITE_SIZE).unwrap_or_default();
        work(&mut BlockingFirmwareState::new(&mut self.state, word))
            .map_err(|_| UpdateError::Storage)
    }

    /// Where the last page begins, which is as long as all others.
    fn last_page(&self) -> u32 {
        (self.dfu.capacity().saturating_sub(DFU::ERASE_SIZE)) as u32
    }

    /// How many pages an image takes, with its tail.
    fn pages(length: u32) -> u32 {
        (length + TAIL as u32).div_ceil(DFU::ERASE_SIZE as u32)
    }

    /// Where the word is that says that a page is complete, if there is room for it.
    fn mark(&self, page: u32) -> Option<u32> {
        let at = RECORD as u32 + page * DFU::WRITE_SIZE as u32;
        (at < DFU::ERASE_SIZE as u32).then(|| self.last_page() + at)
    }

    fn erase(&mut self, page: u32) -> Result<(), UpdateError> {
        let end = page + DFU::ERASE_SIZE as u32;
        self.dfu.erase(page, end).map_err(|_| UpdateError::Storage)
    }

    fn put(&mut self, offset: u32, bytes: &[u8]) -> Result<(), UpdateError> {
        self.dfu
            .write(offset, bytes)
            .map_err(|_| UpdateError::Storage)
    }

    /// How many pages were stored before of the image with this manifest.
    fn stored(&mut self, manifest: &[u8; MANIFEST_LEN], pages: u32) -> Result<u32, UpdateError> {
        let mut record = AlignedBuffer([0; RECORD]);
        let last = self.last_page();
        self.dfu
            .read(last, &mut record.0)
            .map_err(|_| UpdateError::Storage)?;
        if !record.0.starts_with(manifest) {
            return Ok(0);
        }
        let mut stored = 0;
        while let Some(at) = self.mark(stored).filter(|_| stored < pages) {
            let mut word = AlignedBuffer([0; IMAGE_UNIT]);
            let word = word.0.get_mut(..DFU::WRITE_SIZE).unwrap_or_default();
            self.dfu.read(at, word).map_err(|_| UpdateError::Storage)?;
            if word.iter().any(|byte| *byte != 0) {
                break;
            }
            stored += 1;
        }
        Ok(stored)
    }

    fn write_piece(&mut self, offset: u32, bytes: &[u8]) -> Result<(), UpdateError> {
        let Some(incoming) = &self.incoming else {
            return Err(UpdateError::Storage);
        };
        let (head, length) = (incoming.head, incoming.length);
        let count = u32::try_from(bytes.len()).map_err(|_| UpdateError::Storage)?;
        let fits = |end: &u32| *end <= length && count.is_multiple_of(IMAGE_UNIT as u32);
        let end = offset.checked_add(count).filter(fits);
        let end = end.ok_or(UpdateError::Storage)?;
        if offset != incoming.offset {
            return Err(UpdateError::Storage);
        }
        if count > 0 {
            self.store(offset, bytes, false)?;
            if end == length {
                self.store(end, &head, true)?;
            }
        }
        if let Some(incoming) = &mut self.incoming {
            incoming.offset = end;
        }
        Ok(())
    }

    /// Writes whole words, and erases each page before its first one; marks a page that they complete.
    fn store(&mut self, offset: u32, bytes: &[u8], is_last: bool) -> Result<(), UpdateError> {
        let size = DFU::ERASE_SIZE as u32;
        let mut at = offset;
        for words in bytes.chunks(IMAGE_UNIT) {
            if at.is_multiple_of(size) {
                self.erase(at)?;
            }
            let mut aligned = AlignedBuffer([0xFF; IMAGE_UNIT]);
            for (to, from) in aligned.0.iter_mut().zip(words) {
                *to = *from;
            }
            self.put(at, &aligned.0)?;
            at += IMAGE_UNIT as u32;
            if at.is_multiple_of(size) {
                self.complete(at / size - 1)?;
            }
        }
        if is_last && !at.is_multiple_of(size) {
            self.complete(at / size)?;
        }
        Ok(())
    }

    /// Verifies the next part.
    fn verify_part(&mut self) -> Result<Verification, UpdateError> {
        let Some(incoming) = &mut self.incoming else {
            return Err(UpdateError::Storage);
        };
        if incoming.offset != incoming.length {
            return Err(UpdateError::Storage);
        }
        match &mut incoming.stage {
            Stage::Hash { at, hash } => {
                let left = incoming.length + HEAD_LEN as u32 - *at;
                let count = left.min(BLOCK as u32) as usize;
                let mut block = AlignedBuffer([0; BLOCK]);
                let words = block.0.get_mut(..count.next_multiple_of(IMAGE_UNIT));
                let read = self.dfu.read(*at, words.unwrap_or_default());
                read.map_err(|_| UpdateError::Storage)?;
                hash.update(block.0.get(..count).unwrap_or_default());
                *at += count as u32;
                if count as u32 == left {
                    let digest = core::mem::take(hash).finalize();
                    let check = Check::new(self.image.key, &incoming.signature, &digest);
                    incoming.stage = Stage::Signature(check.ok_or(UpdateError::Signature)?);
                }
                Ok(Verification::Continues)
            }
            Stage::Signature(check) => match check.step() {
                None => Ok(Verification::Continues),
                Some(true) => Ok(Verification::Done),
                Some(false) => Err(UpdateError::Signature),
            },
        }
    }

    fn complete(&mut self, page: u32) -> Result<(), UpdateError> {
        let zeros = AlignedBuffer([0; IMAGE_UNIT]);
        match self.mark(page) {
            Some(at) => self.put(at, zeros.0.get(..DFU::WRITE_SIZE).unwrap_or_default()),
            None => Ok(()),
        }
    }
}

impl<DFU: NorFlash, STATE: NorFlash> Updater for Slots<DFU, STATE> {
    fn firmware(&self) -> Firmware<'_> {
        Firmware {
            board: self.image.board,
            version: self.image.version,
            confirmed: self.is_confirmed,
            trial_ms: u32::try_from(self.image.trial.as_millis()).unwrap_or(u32::MAX),
            self_test: self.image.self_test,
        }
    }

    fn begin(&mut self, manifest: &[u8], downgrade: bool) -> Result<Receiving, UpdateError> {
        self.incoming = None;
        let parsed = Manifest::parse(manifest).map_err(|_| UpdateError::Manifest)?;
        let whole = <&[u8; MANIFEST_LEN]>::try_from(manifest).map_err(|_| UpdateError::Manifest)?;
        let Manifest {
            board,
            version,
            length,
        } = parsed.manifest;
        if board != self.image.board {
            return Err(UpdateError::Board);
        }
        if version < self.version && !downgrade {
            return Err(UpdateError::Older);
        }
        if self
            .last_page()
            .checked_sub(TAIL as u32)
            .is_none_or(|most| length > most)
        {
            return Err(UpdateError::TooLong);
        }
        if !self.is_confirmed {
            return Err(UpdateError::OnTrial);
        }
        // An image that was verified, but has not run yet.
        if self.with_state(|state| state.get_state())? == State::Swap {
            self.with_state(|state| state.mark_booted())?;
        }
        let pages = Self::pages(length);
        let stored = self.stored(whole, pages)?;
        let offset = match stored {
            0 => {
                let last = self.last_page();
                self.erase(last)?;
                let mut record = AlignedBuffer([0xFF; RECORD]);
                for (to, from) in record.0.iter_mut().zip(whole) {
                    *to = *from;
                }
                self.put(last, &record.0)?;
                0
            }
            _ if stored == pages => length,
            // The tail is written with the image's last bytes.
            _ => {
                let size = DFU::ERASE_SIZE as u32;
                (stored * size).min((length - 1) / size * size)
            }
        };
        self.incoming = Some(Incoming {
            head: *parsed.head,
            signature: *parsed.signature,
            length,
            offset,
            stage: Stage::Hash {
                at: 0,
                hash: Sha512::new(),
            },
        });
        Ok(Receiving { length, offset })
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), UpdateError> {
        let written = self.write_piece(offset, bytes);
        if written.is_err() {
            // The update goes on with the first page that is not complete.
            self.incoming = None;
        }
        written
    }

    fn verify(&mut self) -> Result<Verification, UpdateError> {
        let verified = self.verify_part();
        match verified {
            Ok(Verification::Continues) => return verified,
            Ok(Verification::Done) => {
                self.incoming = None;
                // The bootloader must not be in the middle of a swap.
                if self.with_state(|state| state.get_state())? == State::Swap {
                    return Err(UpdateError::Storage);
                }
                self.with_state(|state| state.mark_updated())?;
            }
            Err(UpdateError::Signature) => {
                self.incoming = None;
                // The next update with this manifest begins from the beginning.
                let last = self.last_page();
                self.erase(last)?;
            }
            Err(_) => self.incoming = None,
        }
        verified
    }

    fn restart(&mut self) {
        (self.restart)();
    }

    fn confirm(&mut self) -> Result<(), UpdateError> {
        self.with_state(|state| state.mark_booted())?;
        self.is_confirmed = true;
        Ok(())
    }
}

impl<DFU, STATE> fmt::Debug for Slots<DFU, STATE> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Slots")
            .field("image", &self.image)
            .finish_non_exhaustive()
    }
}
