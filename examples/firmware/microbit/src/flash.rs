//! The nRF51's flash: pages of 1 KiB, written by words. Erasing a page stops the processor for 22 ms.

use board_support::Register;
use embedded_storage::nor_flash::{
    ErrorType, NorFlash, NorFlashError, NorFlashErrorKind, ReadNorFlash,
};

const fn register(offset: usize) -> Register {
    // SAFETY: the nRF51's NVMC, which changes only pages of a `Pages`; the offsets are those below.
    unsafe { Register::at(0x4001_E000 + offset) }
}

const READY: Register = register(0x400);
const CONFIG: Register = register(0x504);
const ERASE_PAGE: Register = register(0x508);

/// For `CONFIG`.
const READ: u32 = 0;
const WRITE: u32 = 1;
const ERASE: u32 = 2;

/// Length of a page in bytes, which is erased as a whole.
pub const PAGE: usize = 1024;

/// Pages from the address `BEGIN` on, of `LENGTH` bytes; offset 0 is the first of these bytes. Who writes them must know that
/// they hold no code that runs.
#[derive(Debug)]
pub struct Pages<const BEGIN: usize, const LENGTH: usize>;

/// The last two pages of the flash, which hold no program, only saved parameters.
pub const PARAMETERS: Pages<0x3_F800, { 2 * PAGE }> = Pages;

/// The whole flash.
pub const WHOLE: Pages<0, { 256 * PAGE }> = Pages;

/// An address beyond the pages, or within a word.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BadAddress;

impl NorFlashError for BadAddress {
    fn kind(&self) -> NorFlashErrorKind {
        NorFlashErrorKind::OutOfBounds
    }
}

/// A word of the flash.
fn word(address: usize) -> Register {
    // SAFETY: a word of some `Pages`, where no code runs.
    unsafe { Register::at(address) }
}

impl<const BEGIN: usize, const LENGTH: usize> Pages<BEGIN, LENGTH> {
    /// The addresses from `offset` on.
    fn addresses(offset: u32, bytes: usize) -> Result<core::ops::Range<usize>, BadAddress> {
        let offset = usize::try_from(offset).map_err(|_| BadAddress)?;
        let end = offset.checked_add(bytes).filter(|end| *end <= LENGTH);
        let end = end.ok_or(BadAddress)?;
        Ok(BEGIN + offset..BEGIN + end)
    }

    /// The same, if whole units begin and end there.
    fn units(
        offset: u32,
        bytes: usize,
        unit: usize,
    ) -> Result<impl Iterator<Item = usize>, BadAddress> {
        let addresses = Self::addresses(offset, bytes)?;
        // Units are powers of two.
        let aligned = (addresses.start | addresses.end) & (unit - 1) == 0;
        aligned.then(|| addresses.step_by(unit)).ok_or(BadAddress)
    }
}

/// Erases a page. Not inlined, so that a debugger can stop at each change of the flash.
#[unsafe(no_mangle)]
#[inline(never)]
extern "C" fn flash_erase_page(address: usize) {
    ERASE_PAGE.write(address as u32);
    wait();
}

/// Writes a word; the same.
#[unsafe(no_mangle)]
#[inline(never)]
extern "C" fn flash_write_word(address: usize, value: u32) {
    word(address).write(value);
    wait();
}

fn set(mode: u32) {
    CONFIG.write(mode);
    wait();
}

fn wait() {
    while READY.read() == 0 {}
}

impl<const BEGIN: usize, const LENGTH: usize> ErrorType for Pages<BEGIN, LENGTH> {
    type Error = BadAddress;
}

impl<const BEGIN: usize, const LENGTH: usize> ReadNorFlash for Pages<BEGIN, LENGTH> {
    const READ_SIZE: usize = 1;

    fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), BadAddress> {
        for (address, to) in Self::addresses(offset, bytes.len())?.zip(bytes) {
            let [at, shift] = [address & !3, 8 * (address & 3)];
            *to = (word(at).read() >> shift) as u8;
        }
        Ok(())
    }

    fn capacity(&self) -> usize {
        LENGTH
    }
}

impl<const BEGIN: usize, const LENGTH: usize> NorFlash for Pages<BEGIN, LENGTH> {
    const WRITE_SIZE: usize = 4;
    const ERASE_SIZE: usize = PAGE;

    fn erase(&mut self, from: u32, to: u32) -> Result<(), BadAddress> {
        let bytes = to.checked_sub(from).ok_or(BadAddress)?;
        let bytes = usize::try_from(bytes).map_err(|_| BadAddress)?;
        let pages = Self::units(from, bytes, PAGE)?;
        set(ERASE);
        pages.for_each(|page| flash_erase_page(page));
        set(READ);
        Ok(())
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), BadAddress> {
        let words = Self::units(offset, bytes.len(), 4)?;
        set(WRITE);
        for (address, from) in words.zip(bytes.chunks_exact(4)) {
            let from = u32::from_le_bytes(from.try_into().unwrap_or([0xFF; 4]));
            // As it is after an erase; swaps of images that do not fill their partition take less time.
            if from != u32::MAX {
                flash_write_word(address, from);
            }
        }
        set(READ);
        Ok(())
    }
}
