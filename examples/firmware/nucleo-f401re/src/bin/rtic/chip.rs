//! What RTIC has to know of the STM32F401: its interrupts. A chip's crate (`stm32f4`) has the same for all of them.

use cortex_m::interrupt::InterruptNumber;
// Start-up code and the rest of the vector table.
use cortex_m_rt as _;

/// Bits of an interrupt's priority.
pub(crate) const NVIC_PRIO_BITS: u8 = 4;

/// The interrupts in use.
#[derive(Clone, Copy)]
#[expect(non_camel_case_types, reason = "as in a chip's crate")]
#[repr(u16)]
pub(crate) enum Interrupt {
    DMA1_STREAM5 = 16,
    USART2 = 38,
}

/// Its name where RTIC checks that an interrupt exists.
pub(crate) use Interrupt as interrupt;

// SAFETY: their numbers by the STM32F401's manual.
unsafe impl InterruptNumber for Interrupt {
    fn number(self) -> u16 {
        self as u16
    }
}

unsafe extern "C" {
    /// Defined by RTIC.
    safe fn DMA1_STREAM5();
    /// Defined by RTIC.
    safe fn USART2();
}

extern "C" fn on_stream() {
    DMA1_STREAM5();
}

extern "C" fn on_usart() {
    USART2();
}

board_support::vectors! { 39: 16 => on_stream, 38 => on_usart }
