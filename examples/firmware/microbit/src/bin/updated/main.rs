//! A later version of `update`, with room for more tasks.
#![no_std]
#![no_main]

#[path = "../../updatable.rs"]
mod updatable;

use cortex_m_rt::entry;

#[entry]
fn main() -> ! {
    updatable::run::<4>("1.1.0")
}

board_support::handlers!();
