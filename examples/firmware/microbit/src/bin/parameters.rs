//! The lamp of `smallest.rs` with parameters, which last until the next reset. Its size is recorded.
#![no_std]
#![no_main]

#[path = "../lamp.rs"]
mod lamp;

use cortex_m_rt::entry;
use lamp::{Settings, TunedLamp, run};

#[entry]
fn main() -> ! {
    let lamp = TunedLamp::new([lamp::output()]);
    run(lamp.with_firmware(Settings::default()))
}

board_support::handlers!();
