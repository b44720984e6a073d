//! Device registers.

/// A register of 32 bits.
#[derive(Debug, Clone, Copy)]
pub struct Register(*mut u32);

// SAFETY: an access is one instruction, also in an interrupt.
unsafe impl Sync for Register {}

impl Register {
    /// The register at this address.
    ///
    /// # Safety
    /// There must be a register, and accessing it must not change the memory of the program.
    #[must_use]
    pub const unsafe fn at(address: usize) -> Self {
        Self(core::ptr::without_provenance_mut(address))
    }

    /// Reads it.
    #[must_use]
    pub fn read(self) -> u32 {
        // SAFETY: by the condition of `at`.
        unsafe { self.0.read_volatile() }
    }

    /// Writes it.
    pub fn write(self, value: u32) {
        // SAFETY: by the condition of `at`.
        unsafe { self.0.write_volatile(value) }
    }
}
