//! The nRF51's flash: pages of 1 KiB, written by words. Erasing a page stops the processor for 22 ms.

use board_support::Register;
use embedded_storage::nor_flash::{
    ErrorType, NorFlash, NorFlashError, NorFlashErrorKind, ReadNorFlash,
};

const fn register(offset: usize) -> Register {
    // SAFETY: the nRF51's NVMC, which changes only the pages below; the offsets are those below.
    unsafe { Register::at(0x4001_E000 + offset) }
}

const READY: Register = register(0x400);
const CONFIG: Register = register(0x504);
const ERASE_PAGE: Register = register(0x508);

/// For `CONFIG`.
const READ: u32 = 0;
const WRITE: u32 = 1;
const ERASE: u32 = 2;

const PAGE: usize = 1024;
/// The last pages of the flash, which hold no program.
const BEGIN: usize = 0x3_F800;
/// Their length in bytes.
pub const LENGTH: usize = 2 * PAGE;

/// The last two pages of the flash; address 0 is the first of their bytes.
#[derive(Debug)]
pub struct Pages;

/// An address beyond the pages, or within a word.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BadAddress;

impl NorFlashError for BadAddress {
    fn kind(&self) -> NorFlashErrorKind {
        NorFlashErrorKind::OutOfBounds
    }
}

/// The words from `offset` on.
fn words(offset: u32, bytes: usize) -> Result<impl Iterator<Item = usize>, BadAddress> {
    let offset = usize::try_from(offset).map_err(|_| BadAddress)?;
    let end = offset.checked_add(bytes).filter(|end| *end <= LENGTH);
    let aligned = offset.is_multiple_of(4) && bytes.is_multiple_of(4);
    let end = end.filter(|_| aligned).ok_or(BadAddress)?;
    Ok((BEGIN + offset..BEGIN + end).step_by(4))
}

/// A word of the pages.
fn word(address: usize) -> Register {
    // SAFETY: a word of the pages above, where there is no program.
    unsafe { Register::at(address) }
}

fn set(mode: u32) {
    CONFIG.write(mode);
    wait();
}

fn wait() {
    while READY.read() == 0 {}
}

impl ErrorType for Pages {
    type Error = BadAddress;
}

impl ReadNorFlash for Pages {
    const READ_SIZE: usize = 4;

    fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), BadAddress> {
        for (address, to) in words(offset, bytes.len())?.zip(bytes.chunks_exact_mut(4)) {
            to.copy_from_slice(&word(address).read().to_le_bytes());
        }
        Ok(())
    }

    fn capacity(&self) -> usize {
        LENGTH
    }
}

impl NorFlash for Pages {
    const WRITE_SIZE: usize = 4;
    const ERASE_SIZE: usize = PAGE;

    fn erase(&mut self, from: u32, to: u32) -> Result<(), BadAddress> {
        let bytes = to.checked_sub(from).ok_or(BadAddress)?;
        let bytes = usize::try_from(bytes).map_err(|_| BadAddress)?;
        set(ERASE);
        for page in words(from, bytes)?.step_by(PAGE / 4) {
            ERASE_PAGE.write(page as u32);
            wait();
        }
        set(READ);
        Ok(())
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), BadAddress> {
        set(WRITE);
        for (address, from) in words(offset, bytes.len())?.zip(bytes.chunks_exact(4)) {
            if let Ok(from) = from.try_into() {
                word(address).write(u32::from_le_bytes(from));
                wait();
            }
        }
        set(READ);
        Ok(())
    }
}
