//! The firmware slots of a simulated device, which takes updates into memory.

use std::cell::RefCell;
use std::fmt;
use std::sync::Arc;
use std::time::Duration;

use ztl_core::Instant;
use ztl_core::manifest::{MANIFEST_LEN, Manifest, Parsed, Version};
use ztl_mcu::update::{Firmware, Receiving, SelfTest, UpdateError, Updater, Verification};
use ztl_std::time::now;

/// The board that images of a simulated device must be for.
pub const BOARD: &str = "simulated";
/// Longest image that it takes, in bytes.
const ROOM: usize = 1 << 20;
/// Bytes that one step verifies.
const STEP: usize = 16 << 10;
/// How long firmware is on trial unless its image says otherwise.
const TRIAL_MS: u32 = 60_000;

/// Whether the signature of an image is valid.
#[derive(Clone)]
pub(super) struct Verify(pub(super) Arc<dyn Fn(&Parsed<'_>) -> bool + Send + Sync>);

impl fmt::Debug for Verify {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Verify")
    }
}

/// Firmware in a slot. The image of a simulated device is a text; each of its lines may be `self-test: GOAL`, with which the
/// firmware tests its component, `trial: MILLISECONDS`, how long it waits for a confirmation, `version: X.Y.Z`, the version
/// that it says it has, instead of the one for which it was signed, or `verify: MILLISECONDS`, how long the firmware before takes
/// to verify the image.
#[derive(Debug, Clone)]
struct Slot {
    version: Version,
    /// The same as text.
    name: String,
    self_test: Option<String>,
    trial_ms: u32,
}

impl Slot {
    fn new(version: Version, image: &[u8]) -> Self {
        let image = String::from_utf8_lossy(image);
        let value = |key| value(&image, key);
        let own = value("version: ").and_then(|text| text.trim().parse().ok());
        let version = own.unwrap_or(version);
        Self {
            version,
            name: version.to_string(),
            self_test: value("self-test: ").map(str::to_owned),
            trial_ms: value("trial: ")
                .and_then(|text| text.trim().parse().ok())
                .unwrap_or(TRIAL_MS),
        }
    }
}

/// A setting of an image.
fn value<'t>(image: &'t str, key: &str) -> Option<&'t str> {
    image.lines().find_map(|line| line.strip_prefix(key))
}

/// An image that is being received.
#[derive(Debug)]
struct Incoming {
    /// The manifest, and as much of the image as has arrived.
    file: Vec<u8>,
    verified: usize,
    /// When its verification ends.
    until: Option<Instant>,
    /// Whether the next restart runs it.
    marked: bool,
}

/// Both slots, and what a flash keeps over restarts.
#[derive(Debug)]
pub(super) struct Slots {
    verify: Verify,
    active: Slot,
    /// What ran before the firmware that is on trial.
    before: Option<Slot>,
    incoming: Option<Incoming>,
    /// Whether the device restarts.
    restarts: bool,
}

impl Slots {
    /// The slots of a device that runs this version and takes images with a signature that this function accepts.
    pub(super) fn new(version: Version, verify: Verify) -> Self {
        Self {
            verify,
            active: Slot::new(version, &[]),
            before: None,
            incoming: None,
            restarts: false,
        }
    }

    /// What the bootloader does: runs a marked image on trial, and goes back from one that was not confirmed.
    pub(super) fn boot(&mut self) {
        self.restarts = false;
        if let Some(before) = self.before.take() {
            self.active = before;
        }
        if let Some(incoming) = self.incoming.take_if(|incoming| incoming.marked)
            && let Ok(parsed) = Manifest::parse(&incoming.file)
        {
            let new = Slot::new(parsed.manifest.version, parsed.image);
            self.before = Some(std::mem::replace(&mut self.active, new));
        }
    }

    pub(super) fn version(&self) -> String {
        self.active.name.clone()
    }

    pub(super) fn take_restart(&mut self) -> bool {
        std::mem::take(&mut self.restarts)
    }
}

/// The slots as running firmware uses them.
#[derive(Debug)]
pub(super) struct SlotUpdater<'s> {
    slots: &'s RefCell<Slots>,
    /// What runs.
    running: Slot,
}

impl<'s> SlotUpdater<'s> {
    pub(super) fn new(slots: &'s RefCell<Slots>) -> Self {
        let running = slots.borrow().active.clone();
        Self { slots, running }
    }
}

impl Updater for SlotUpdater<'_> {
    fn firmware(&self) -> Firmware<'_> {
        let running = &self.running;
        Firmware {
            board: BOARD,
            version: &running.name,
            confirmed: self.slots.borrow().before.is_none(),
            trial_ms: running.trial_ms,
            self_test: running
                .self_test
                .as_deref()
                .map(|goal| SelfTest { component: 0, goal }),
        }
    }

    fn begin(&mut self, manifest: &[u8], downgrade: bool) -> Result<Receiving, UpdateError> {
        let parsed = Manifest::parse(manifest).map_err(|_| UpdateError::Manifest)?;
        let known = parsed.manifest;
        if known.board != BOARD {
            return Err(UpdateError::Board);
        }
        if !downgrade && known.version < self.running.version {
            return Err(UpdateError::Older);
        }
        let length = usize::try_from(known.length).unwrap_or(usize::MAX);
        if length > ROOM {
            return Err(UpdateError::TooLong);
        }
        let mut slots = self.slots.borrow_mut();
        let incoming = slots.incoming.take();
        let same = incoming.filter(|incoming| incoming.file.starts_with(manifest));
        let incoming = Incoming {
            file: same.map_or_else(|| manifest.to_vec(), |same| same.file),
            verified: 0,
            until: None,
            marked: false,
        };
        let offset = incoming.file.len().saturating_sub(MANIFEST_LEN);
        slots.incoming = Some(incoming);
        Ok(Receiving {
            length: known.length,
            offset: u32::try_from(offset).unwrap_or(known.length),
        })
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), UpdateError> {
        let mut slots = self.slots.borrow_mut();
        let incoming = slots.incoming.as_mut().ok_or(UpdateError::Storage)?;
        let at = incoming.file.len().saturating_sub(MANIFEST_LEN);
        if usize::try_from(offset) != Ok(at) {
            return Err(UpdateError::Storage);
        }
        incoming.file.extend_from_slice(bytes);
        Ok(())
    }

    fn verify(&mut self) -> Result<Verification, UpdateError> {
        let mut slots = self.slots.borrow_mut();
        let Slots {
            incoming, verify, ..
        } = &mut *slots;
        let incoming = incoming.as_mut().ok_or(UpdateError::Storage)?;
        incoming.verified += STEP;
        if incoming.verified < incoming.file.len() {
            return Ok(Verification::Continues);
        }
        let image = incoming.file.get(MANIFEST_LEN..).unwrap_or_default();
        let takes = || {
            let image = String::from_utf8_lossy(image);
            let millis = value(&image, "verify: ").and_then(|text| text.trim().parse().ok());
            now() + Duration::from_millis(millis.unwrap_or_default())
        };
        if now() < *incoming.until.get_or_insert_with(takes) {
            std::thread::sleep(Duration::from_millis(1));
            return Ok(Verification::Continues);
        }
        let parsed = Manifest::parse(&incoming.file);
        incoming.marked = parsed.is_ok_and(|parsed| verify.0(&parsed));
        if incoming.marked {
            return Ok(Verification::Done);
        }
        // Another attempt begins from the beginning.
        slots.incoming = None;
        Err(UpdateError::Signature)
    }

    fn restart(&mut self) {
        self.slots.borrow_mut().restarts = true;
    }

    fn confirm(&mut self) -> Result<(), UpdateError> {
        self.slots.borrow_mut().before = None;
        Ok(())
    }
}
