//! Firmware updates over the link: what the firmware provides, and how a node uses it (`docs/link.md`, section 16).

use ztl_core::link::update::Firmware;
pub use ztl_core::link::update::{PIECE_UNIT, SelfTest, UpdateError};

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
    /// that was being received before, goes on where that ended, if it is known; otherwise from the beginning.
    ///
    /// # Errors
    /// [`UpdateError`]: the manifest is damaged, the image is for another board, older than what runs (unless `downgrade`), or
    /// too long, what runs is on trial, or the flash fails.
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
