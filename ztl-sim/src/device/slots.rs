//! The firmware slots of a simulated device, which takes updates into memory.

use std::cell::RefCell;

use ztl_core::link::update::Manifest;
use ztl_mcu::update::{Firmware, Receiving, SelfTest, UpdateError, Updater, Verification};

/// The board that images of a simulated device must be for.
pub const BOARD: &str = "simulated";
/// Longest image that it takes, in bytes.
const ROOM: usize = 1 << 20;
/// Bytes that one step verifies.
const STEP: usize = 16 << 10;
/// How long firmware is on trial unless its image says otherwise.
const TRIAL_MS: u32 = 60_000;

/// Firmware in a slot. The image of a simulated device is a text; each of its lines may be `self-test: GOAL`, with which the
/// firmware tests its component, or `trial: MILLISECONDS`, how long it waits for a confirmation.
#[derive(Debug, Clone)]
struct Slot {
    version: String,
    self_test: Option<String>,
    trial_ms: u32,
}

impl Slot {
    fn new(version: &str, image: &[u8]) -> Self {
        let image = String::from_utf8_lossy(image);
        let value = |key| image.lines().find_map(|line| line.strip_prefix(key));
        Self {
            version: version.to_owned(),
            self_test: value("self-test: ").map(str::to_owned),
            trial_ms: value("trial: ")
                .and_then(|text| text.trim().parse().ok())
                .unwrap_or(TRIAL_MS),
        }
    }
}

/// An image that is being received.
#[derive(Debug)]
struct Incoming {
    manifest: Vec<u8>,
    image: Vec<u8>,
    verified: usize,
    /// Whether the next restart runs it.
    marked: bool,
}

/// Both slots, and what a flash keeps over restarts.
#[derive(Debug)]
pub(super) struct Slots {
    key: Vec<u8>,
    active: Slot,
    /// What ran before the firmware that is on trial.
    before: Option<Slot>,
    incoming: Option<Incoming>,
    /// Whether the device restarts.
    restarts: bool,
}

impl Slots {
    /// The slots of a device that runs this version and takes images signed for this key.
    pub(super) fn new(version: &str, key: &[u8]) -> Self {
        Self {
            key: key.to_vec(),
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
            && let Some((manifest, ..)) = Manifest::split(&incoming.manifest)
        {
            let new = Slot::new(manifest.version, &incoming.image);
            self.before = Some(std::mem::replace(&mut self.active, new));
        }
    }

    pub(super) fn version(&self) -> String {
        self.active.version.clone()
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
            version: &running.version,
            confirmed: self.slots.borrow().before.is_none(),
            trial_ms: running.trial_ms,
            self_test: running
                .self_test
                .as_deref()
                .map(|goal| SelfTest { component: 0, goal }),
        }
    }

    fn begin(&mut self, manifest: &[u8], downgrade: bool) -> Result<Receiving, UpdateError> {
        let Some((known, own, [])) = Manifest::split(manifest) else {
            return Err(UpdateError::Manifest);
        };
        if known.board != BOARD {
            return Err(UpdateError::Board);
        }
        if !downgrade && is_older(known.version, &self.running.version) {
            return Err(UpdateError::Older);
        }
        let mut slots = self.slots.borrow_mut();
        let length = usize::try_from(known.length).unwrap_or(usize::MAX);
        if length > ROOM {
            return Err(UpdateError::TooLong);
        }
        let incoming = slots.incoming.take();
        let incoming = incoming.filter(|incoming| incoming.manifest == own);
        let mut incoming = incoming.unwrap_or_else(|| Incoming {
            manifest: own.to_vec(),
            image: Vec::new(),
            verified: 0,
            marked: false,
        });
        incoming.verified = 0;
        incoming.marked = false;
        let offset = u32::try_from(incoming.image.len()).unwrap_or(known.length);
        slots.incoming = Some(incoming);
        Ok(Receiving {
            length: known.length,
            offset,
        })
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), UpdateError> {
        let mut slots = self.slots.borrow_mut();
        let incoming = slots.incoming.as_mut().ok_or(UpdateError::Storage)?;
        if usize::try_from(offset) != Ok(incoming.image.len()) {
            return Err(UpdateError::Storage);
        }
        incoming.image.extend_from_slice(bytes);
        Ok(())
    }

    fn verify(&mut self) -> Result<Verification, UpdateError> {
        let mut slots = self.slots.borrow_mut();
        let Slots { incoming, key, .. } = &mut *slots;
        let incoming = incoming.as_mut().ok_or(UpdateError::Storage)?;
        incoming.verified += STEP;
        if incoming.verified < incoming.image.len() {
            return Ok(Verification::Continues);
        }
        let known = Manifest::split(&incoming.manifest);
        let valid = known.is_some_and(|(known, ..)| known.is_signed(key, &incoming.image));
        if !valid {
            // Another attempt begins from the beginning.
            incoming.image.clear();
            return Err(UpdateError::Signature);
        }
        incoming.marked = true;
        Ok(Verification::Done)
    }

    fn restart(&mut self) {
        self.slots.borrow_mut().restarts = true;
    }

    fn confirm(&mut self) -> Result<(), UpdateError> {
        self.slots.borrow_mut().before = None;
        Ok(())
    }
}

/// Whether a version is older than another, number by number.
fn is_older(version: &str, than: &str) -> bool {
    let numbers = |text: &str| -> Vec<u64> {
        let parts = text.split(|c: char| !c.is_ascii_digit());
        parts.filter_map(|part| part.parse().ok()).collect()
    };
    numbers(version) < numbers(than)
}
