//! The bootloader for images that are updated over the link: `embassy-boot` on the nRF51. Its size is recorded.
//!
//! It swaps the image that was received with the one that runs, goes on with a swap that a power cut has stopped, and swaps
//! back if the new image was not confirmed. Then it starts the image in the active partition.
#![no_std]
#![no_main]

// Not by the library, which has another vector table.
#[expect(dead_code, unreachable_pub, reason = "the library has more users")]
#[path = "../../flash.rs"]
mod flash;
#[expect(dead_code, unreachable_pub, reason = "the library has more users")]
#[path = "../../watchdog.rs"]
mod watchdog;

use core::arch::global_asm;
use core::cell::RefCell;
use core::panic::PanicInfo;

use cortex_m::peripheral::SCB;
use cortex_m_rt::entry;
use embassy_boot::{AlignedBuffer, BootLoader, BootLoaderConfig};
use embassy_sync_08::blocking_mutex::Mutex;
use flash::{PAGE, WHOLE};

unsafe extern "C" {
    /// Set by partitions.x.
    safe static __bootloader_active_start: u32;
}

#[entry]
fn main() -> ! {
    // An image that hangs is reset by it, and goes back if it was on trial.
    watchdog::watchdog_start();
    let flash = Mutex::new(RefCell::new(WHOLE));
    let partitions = BootLoaderConfig::from_linkerfile_blocking(&flash, &flash, &flash);
    let mut page = AlignedBuffer([0; PAGE]);
    // If the flash fails, the active partition may hold parts of two images. Then nothing starts.
    if BootLoader::new(partitions)
        .prepare_boot(&mut page.0)
        .is_err()
    {
        SCB::sys_reset();
    }
    // SAFETY: the active partition begins with the vector table of an image; no interrupt is enabled.
    unsafe { cortex_m::asm::bootload(&raw const __bootloader_active_start) }
}

// The Cortex-M0 takes its vectors from address 0 only. So each exception and interrupt goes on to the handler that the image's
// own table has for it; all registers are as they were, but those that the processor has saved.
global_asm!(
    ".section .text.forward, \"ax\", %progbits",
    ".global DefaultHandler",
    ".global HardFault",
    ".type DefaultHandler, %function",
    ".type HardFault, %function",
    ".thumb_func",
    "DefaultHandler:",
    ".thumb_func",
    "HardFault:",
    "mrs r0, ipsr",
    "lsls r0, r0, #2",
    "ldr r1, =__bootloader_active_start",
    "ldr r0, [r1, r0]",
    "bx r0",
    ".pool",
    ".size DefaultHandler, . - DefaultHandler",
);

unsafe extern "C" {
    /// As above.
    fn DefaultHandler();
}

/// The interrupts' part of the vector table.
#[used]
#[unsafe(no_mangle)]
#[unsafe(link_section = ".vector_table.interrupts")]
static __INTERRUPTS: [unsafe extern "C" fn(); 32] = [DefaultHandler; 32];

#[panic_handler]
fn panic(_: &PanicInfo<'_>) -> ! {
    SCB::sys_reset()
}
