//! A lamp whose firmware is updated over the link; for the bootloader of `boot`. Its size is recorded.
#![no_std]
#![no_main]

#[path = "../../updatable.rs"]
mod updatable;

use cortex_m_rt::entry;

#[entry]
fn main() -> ! {
    updatable::run::<2>("1.0.0")
}

board_support::handlers!();
