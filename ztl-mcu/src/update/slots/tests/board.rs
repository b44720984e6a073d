//! A board in RAM: the three partitions of `embassy-boot`, and its own bootloader.

use super::*;
use embassy_boot::{BootLoader, BootLoaderConfig};
use embedded_storage::nor_flash::{ErrorType, NorFlashError, NorFlashErrorKind, ReadNorFlash};
use salty::Keypair;
use std::boxed::Box;
use std::cell::RefCell;
use std::iter::successors;
use std::ops::Range;
use std::vec::Vec;

pub(super) const WORD: usize = 4;
pub(super) const PAGE: usize = 256;
pub(super) const STATE: Range<usize> = 0..PAGE;
pub(super) const ACTIVE: Range<usize> = PAGE..4 * PAGE;
pub(super) const DFU: Range<usize> = 4 * PAGE..8 * PAGE;

/// The longest image.
pub(super) const LONGEST: usize = 3 * PAGE - TAIL;
pub(super) const OLD: &str = "1.0.0";
pub(super) const NEW: &str = "1.1.0";

/// What happens to an operation of the flash.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Fault {
    /// The power is cut before it.
    Cut,
    /// The power is cut while it is carried out.
    CutWithin,
    /// It fails and changes nothing; those after it do not.
    Fails,
}

#[derive(Debug, Clone)]
pub(super) struct Chip {
    pub(super) bytes: Vec<u8>,
    /// Operations so far: words written, pages erased, and calls that read.
    pub(super) changes: usize,
    pub(super) reads: usize,
    /// At which of these operations what happens.
    pub(super) at_change: Option<(usize, Fault)>,
    pub(super) at_read: Option<(usize, Fault)>,
    is_off: bool,
}

#[derive(Debug)]
pub(super) struct Failed;

impl NorFlashError for Failed {
    fn kind(&self) -> NorFlashErrorKind {
        NorFlashErrorKind::Other
    }
}

impl Chip {
    /// What happens to the next change.
    fn change(&mut self) -> Result<Option<Fault>, Failed> {
        let (now, at) = (self.changes, self.at_change);
        self.changes += 1;
        self.operation(now, at)
    }

    fn operation(
        &mut self,
        now: usize,
        at: Option<(usize, Fault)>,
    ) -> Result<Option<Fault>, Failed> {
        let fault = at.filter(|(at, _)| *at == now).map(|(_, fault)| fault);
        let works = !self.is_off && matches!(fault, None | Some(Fault::CutWithin));
        self.is_off |= matches!(fault, Some(Fault::Cut | Fault::CutWithin));
        if works { Ok(fault) } else { Err(Failed) }
    }
}

/// A partition.
#[derive(Debug, Clone)]
pub(super) struct Part<'c> {
    chip: &'c RefCell<Chip>,
    at: Range<usize>,
}

impl ErrorType for Part<'_> {
    type Error = Failed;
}

impl ReadNorFlash for Part<'_> {
    const READ_SIZE: usize = WORD;

    fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), Failed> {
        let mut chip = self.chip.borrow_mut();
        let (now, at) = (chip.reads, chip.at_read);
        chip.reads += 1;
        chip.operation(now, at)?;
        bytes.copy_from_slice(&chip.bytes[self.at.clone()][offset as usize..][..bytes.len()]);
        Ok(())
    }

    fn capacity(&self) -> usize {
        self.at.len()
    }
}

impl NorFlash for Part<'_> {
    const WRITE_SIZE: usize = WORD;
    const ERASE_SIZE: usize = PAGE;

    fn erase(&mut self, from: u32, to: u32) -> Result<(), Failed> {
        let mut chip = self.chip.borrow_mut();
        for page in (from as usize..to as usize).step_by(PAGE) {
            let within = chip.change()?.is_some();
            let end = if within { PAGE / 3 } else { PAGE };
            chip.bytes[self.at.clone()][page..][..end].fill(0xFF);
            if within {
                return Err(Failed);
            }
        }
        Ok(())
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), Failed> {
        assert_eq!((offset as usize % WORD, bytes.len() % WORD), (0, 0));
        let mut chip = self.chip.borrow_mut();
        for (at, word) in (offset as usize..).step_by(WORD).zip(bytes.chunks(WORD)) {
            let within = chip.change()?.is_some();
            for (to, from) in chip.bytes[self.at.clone()][at..].iter_mut().zip(word) {
                assert_eq!(*to & from, *from, "a word that is not erased is written");
                // In part: some of the bits are cleared.
                *to &= from | if within { 0x5A } else { 0 };
            }
            if within {
                return Err(Failed);
            }
        }
        Ok(())
    }
}

/// The board's flash, and the images that it may hold.
#[derive(Debug, Clone)]
pub(super) struct Board {
    pub(super) chip: RefCell<Chip>,
    pub(super) old: Vec<u8>,
    pub(super) new: Vec<u8>,
    /// The file of the new image.
    pub(super) file: Vec<u8>,
}

/// Bytes that differ from place to place.
pub(super) fn noise(seed: u8, len: usize) -> Vec<u8> {
    let first = Sha512::new().updated(&[seed]).finalize();
    let digests = successors(Some(first), |digest| {
        Some(Sha512::new().updated(digest).finalize())
    });
    digests.flatten().take(len).collect()
}

pub(super) fn keys() -> Keypair {
    Keypair::from(&[7; 32])
}

pub(super) fn key() -> &'static [u8; 32] {
    Box::leak(Box::new(keys().public.to_bytes()))
}

/// A signed image.
pub(super) fn signed(image: &[u8], board: &str, version: &str) -> Vec<u8> {
    let manifest = Manifest {
        board,
        version: Version::parse(version).unwrap(),
        length: image.len() as u32,
    };
    let head = manifest.head().unwrap();
    let digest = Sha512::new().updated(image).updated(&head).finalize();
    let signature = keys().sign(&digest).to_bytes();
    [&head[..], &signature, image].concat()
}

pub(super) fn nothing() {}

impl Board {
    /// Runs the old image; the new one has this length. The rest of the flash is noise.
    pub(super) fn new(length: usize) -> Self {
        let mut bytes = noise(1, DFU.end);
        bytes[STATE].fill(0xFF);
        let (old, new) = (bytes[ACTIVE].to_vec(), noise(2, length));
        Self {
            file: signed(&new, "board", NEW),
            chip: RefCell::new(Chip {
                bytes,
                changes: 0,
                reads: 0,
                at_change: None,
                at_read: None,
                is_off: false,
            }),
            old,
            new,
        }
    }

    fn part(&self, at: Range<usize>) -> Part<'_> {
        let chip = &self.chip;
        Part { chip, at }
    }

    /// What the bootloader does; `None` if it cannot.
    pub(super) fn boot(&self) -> Option<()> {
        let config = BootLoaderConfig {
            active: self.part(ACTIVE),
            dfu: self.part(DFU),
            state: self.part(STATE),
        };
        let mut buffer = AlignedBuffer([0; PAGE]);
        BootLoader::new(config)
            .prepare_boot(&mut buffer.0)
            .ok()
            .map(drop)
    }

    /// The version of the image that runs, of which every byte is there.
    #[track_caller]
    pub(super) fn active(&self) -> &'static str {
        let chip = self.chip.borrow();
        let active = &chip.bytes[ACTIVE];
        match (active.starts_with(&self.old), active.starts_with(&self.new)) {
            (true, false) => OLD,
            (false, true) => NEW,
            _ => panic!("a mixture of images"),
        }
    }

    pub(super) fn partitions(&self) -> FirmwareUpdaterConfig<Part<'_>, Part<'_>> {
        FirmwareUpdaterConfig {
            dfu: self.part(DFU),
            state: self.part(STATE),
        }
    }

    /// The firmware that runs.
    pub(super) fn slots(&self) -> Option<Slots<Part<'_>, Part<'_>>> {
        let image = Image {
            board: "board",
            version: self.active(),
            key: key(),
            trial: Duration::from_secs(60),
            self_test: None,
        };
        Slots::new(self.partitions(), image, nothing)
    }

    /// Whether the next boot runs what was received.
    pub(super) fn is_marked(&self) -> bool {
        self.chip.borrow().bytes[STATE].starts_with(&[0xF0; WORD])
    }

    /// The whole update, but for the restart.
    pub(super) fn update(&self) -> Result<(), UpdateError> {
        let mut slots = self.slots().ok_or(UpdateError::Storage)?;
        receive(&mut slots, &self.file)?;
        verify(&mut slots).map(drop)
    }

    pub(super) fn confirm(&self) -> Result<(), UpdateError> {
        self.slots().ok_or(UpdateError::Storage)?.confirm()
    }

    /// A reset, after which no more faults come.
    #[track_caller]
    pub(super) fn restart(&self) -> &'static str {
        let mut chip = self.chip.borrow_mut();
        (chip.at_change, chip.at_read, chip.is_off) = (None, None, false);
        drop(chip);
        self.boot().expect("it boots");
        self.active()
    }

    pub(super) fn changes(&self) -> usize {
        self.chip.borrow().changes
    }

    /// This board with a fault at the change that follows so many others.
    pub(super) fn with_fault(&self, after: usize, fault: Fault) -> Self {
        let board = self.clone();
        board.chip.borrow_mut().at_change = Some((self.changes() + after, fault));
        board
    }
}
