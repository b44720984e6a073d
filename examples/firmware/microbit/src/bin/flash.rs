//! The lamp of `smallest.rs` with parameters that are saved in flash. Its size is recorded.
#![no_std]
#![no_main]

#[path = "../lamp.rs"]
mod lamp;

use cortex_m::peripheral::SCB;
use cortex_m_rt::entry;
use lamp::{Settings, TunedLamp, run};
use microbit::flash::{PAGE, PARAMETERS};
use ztl_mcu::parameters::Flash;

#[entry]
fn main() -> ! {
    let Some(flash) = Flash::new(PARAMETERS, 0..2 * PAGE as u32) else {
        SCB::sys_reset()
    };
    let lamp = TunedLamp::new([lamp::output()]);
    run(lamp.with_firmware(Settings::default()).load::<_, 2>(flash))
}

board_support::handlers!();
