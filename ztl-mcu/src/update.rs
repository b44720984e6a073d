//! Firmware updates over the link: what the firmware provides, and how a node uses it (`docs/link.md`, section 16).

#[cfg(feature = "embassy-boot")]
mod signed;
#[cfg(feature = "embassy-boot")]
mod slots;

use ztl_core::Instant;
use ztl_core::link::update::UpdatePhase;
pub use ztl_core::link::update::{Firmware, PIECE_UNIT, SelfTest, UpdateError};

#[cfg(feature = "embassy-boot")]
pub use slots::{Image, Slots};

use crate::component::{Components, forward};

/// An image that is being received.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Receiving {
    /// Length of the image in bytes, from its manifest.
    pub length: u32,
    /// The bytes before this offset are stored already: 0, or after a break where to go on. A multiple of [`PIECE_UNIT`], or
    /// `length`.
    pub offset: u32,
}

/// How far the verification of an image is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Verification {
    /// It goes on with the next call.
    Continues,
    /// The signature is valid, and the next restart runs the image.
    Done,
}

/// Receives, verifies and starts an image: the border between the node and the bootloader.
///
/// Each call is made between two bytes of the link, and takes a bounded time: at most one erase of a flash page, or a part of
/// the verification. The node calls `begin`, `write`, `verify` and `restart` only while no component moves.
///
/// A power cut or a reset at any moment leaves the old or the new image to boot, never a mixture.
pub trait Updater {
    /// What runs: its board, its version, whether it was confirmed, for how long it is on trial, and the task that tests it.
    /// All texts together have at most 100 bytes. Must not change, except by [`confirm`](Self::confirm).
    fn firmware(&self) -> Firmware<'_>;

    /// Begins to receive an image. `manifest` is the signed manifest at the beginning of its file. If it is that of the image
    /// that was being received before, goes on where that ended, if it is known; otherwise from the beginning. An image that was
    /// verified before and has not run yet is not marked to run any more.
    ///
    /// # Errors
    /// [`UpdateError`]: the manifest is damaged, the image is for another board, older than what runs (unless `downgrade`), or
    /// too long, or the flash fails. The node itself refuses while what runs is on trial.
    fn begin(&mut self, manifest: &[u8], downgrade: bool) -> Result<Receiving, UpdateError>;

    /// Stores the next bytes of the image: `offset` is where those before end, and the length a multiple of [`PIECE_UNIT`]
    /// unless they are the last ones. Erases at most one page.
    ///
    /// # Errors
    /// [`UpdateError::Storage`].
    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), UpdateError>;

    /// All bytes are stored. Verifies the next part of the image; when all parts and the signature are verified, marks it to
    /// run at the next restart. The node calls it until it returns something other than [`Verification::Continues`], and
    /// handles the link in between.
    ///
    /// # Errors
    /// [`UpdateError::Signature`] or [`UpdateError::Storage`].
    fn verify(&mut self) -> Result<Verification, UpdateError>;

    /// Restarts the firmware. In a simulation it may return; the device then restarts soon.
    fn restart(&mut self);

    /// Keeps what runs: it is no longer on trial. Called again if the answer to the gateway is lost.
    ///
    /// # Errors
    /// [`UpdateError::Storage`].
    fn confirm(&mut self) -> Result<(), UpdateError>;
}

/// Components of a node whose firmware takes updates over the link from this [`Updater`]. It is the outermost wrapper of those
/// for components: `Updatable::new(Described((arm,)), updater)`.
///
/// While an update is received, all components are in their safe state, and the node refuses tasks. `Ping` and `Abort` are
/// served as ever.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct Updatable<C, U> {
    /// The components.
    pub components: C,
    /// Receives the images.
    pub updater: U,
    state: UpdateState,
}

impl<C, U> Updatable<C, U> {
    /// These components; nothing is being received.
    pub const fn new(components: C, updater: U) -> Self {
        Self {
            components,
            updater,
            state: UpdateState {
                phase: UpdatePhase::Idle,
                length: 0,
                until: Instant::ZERO,
                restart_at: Instant::ZERO,
                has_begun: false,
                trial_ends: Instant::NEVER,
            },
        }
    }
}

impl<C: Components, U: Updater> Components for Updatable<C, U> {
    const UPDATES: bool = true;

    forward!(components: parts descriptions bus own_work parameters);

    fn update(&self) -> Option<(&UpdateState, &dyn Updater)> {
        Some((&self.state, &self.updater))
    }

    fn update_mut(&mut self) -> Option<(&mut UpdateState, &mut dyn Updater)> {
        Some((&mut self.state, &mut self.updater))
    }
}

/// How far a node is with an update; only [`Updatable`] has it.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct UpdateState {
    pub(crate) phase: UpdatePhase,
    /// Length of the image in bytes.
    pub(crate) length: u32,
    /// When an update without a further command is over, or until when a restart waits for the components.
    pub(crate) until: Instant,
    /// When the node restarts, in [`UpdatePhase::Restarting`].
    pub(crate) restart_at: Instant,
    /// Whether the trial, if there is one, has begun.
    pub(crate) has_begun: bool,
    /// When a trial ends by a restart; [`Instant::NEVER`] without one.
    pub(crate) trial_ends: Instant,
}

impl UpdateState {
    /// Whether the node receives an image, so that it takes no tasks.
    pub(crate) const fn is_active(&self) -> bool {
        !matches!(self.phase, UpdatePhase::Idle | UpdatePhase::Failed(_))
    }
}
