//! Power cuts while firmware is updated over the link: the bootloader and two images on a micro:bit in QEMU.

mod cuts;
mod rig;
mod talk;

use rig::{End, NEW, OLD, Rig, Script};

#[test]
fn an_update_runs_the_new_image_and_stays_when_it_is_confirmed() {
    let mut rig = Rig::start();
    assert_eq!(rig.assert_serves("as flashed"), OLD);
    let end = rig.run(Script::Update, |_, _| true);
    assert_eq!(end, End::Version(NEW.to_owned()));
    assert_eq!(rig.run(Script::Confirm, |_, _| true), End::Confirmed);
    rig.board.cut_power();
    assert_eq!(rig.assert_serves("confirmed"), NEW);
}

#[test]
fn an_image_that_is_not_confirmed_goes_back_at_the_next_restart() {
    let mut rig = Rig::start();
    let end = rig.run(Script::Update, |_, _| true);
    assert_eq!(end, End::Version(NEW.to_owned()));
    rig.board.cut_power();
    assert_eq!(rig.assert_serves("reverted"), OLD);
    rig.board.cut_power();
    assert_eq!(rig.assert_serves("stays"), OLD);
}
