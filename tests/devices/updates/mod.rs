//! Firmware updates on a board: the bootloader and two images on a micro:bit in QEMU, as `docs/update.md` describes them.

mod cuts;
mod rig;
mod talk;
mod walk;
mod watchdog;

use ztl_core::link::update::UpdateError;
use ztl_core::manifest::MANIFEST_LEN;

use rig::{ACTIVE, End, NEW, OLD, Rig, Script, signed};

fn version(version: &str) -> End {
    End::Version(version.to_owned())
}

#[test]
fn an_update_runs_the_new_image_and_stays_when_it_is_confirmed() {
    let mut rig = Rig::start();
    assert_eq!(rig.assert_serves("as flashed"), OLD);
    assert_eq!(rig.run(Script::Update, |_, _| true), version(NEW));
    assert_eq!(rig.run(Script::Confirm, |_, _| true), End::Confirmed);
    rig.board.cut_power();
    assert_eq!(rig.assert_serves("confirmed"), NEW);
    // The verification needs the most. Beyond these bytes the stack would overwrite what is static.
    assert!(rig.stack_left() > 2 << 10, "{} bytes", rig.stack_left());
}

#[test]
fn an_image_that_is_not_confirmed_goes_back_at_the_next_restart() {
    let mut rig = Rig::start();
    assert_eq!(rig.run(Script::Update, |_, _| true), version(NEW));
    rig.board.cut_power();
    assert_eq!(rig.assert_serves("reverted"), OLD);
    rig.board.cut_power();
    assert_eq!(rig.assert_serves("stays"), OLD);
}

#[test]
fn an_image_that_faults_goes_back_by_itself() {
    let mut rig = Rig::start();
    let [_, new] = &rig.images;
    let mut broken = new.clone();
    let reset = u32::from_le_bytes(new[4..8].try_into().expect("a vector"));
    let reset = (reset & !1) as usize - ACTIVE;
    // An instruction that is not one.
    broken[reset..reset + 2].copy_from_slice(&[0xFE, 0xDE]);
    rig.file = signed(&broken, NEW, "microbit");
    assert_eq!(rig.run(Script::Update, |_, _| true), version(OLD));
    assert_eq!(rig.assert_serves("reverted"), OLD);
}

#[test]
fn images_that_are_not_for_this_board_are_refused_and_a_good_one_runs_afterwards() {
    let mut rig = Rig::start();
    let good = rig.file.clone();
    let image = rig.images[1].clone();
    let mut altered = good.clone();
    altered[MANIFEST_LEN + 2000] ^= 1;
    let mut damaged = good.clone();
    damaged[0] ^= 1;
    let long = vec![0; 63 << 10];
    let mut promoted = good.clone();
    // The version is under the signature, too.
    promoted[6] = 7;
    for (file, expected) in [
        (signed(&image, NEW, "nano"), UpdateError::Board),
        (signed(&image, "0.9.9", "microbit"), UpdateError::Older),
        (signed(&long, NEW, "microbit"), UpdateError::TooLong),
        (damaged, UpdateError::Manifest),
        (altered, UpdateError::Signature),
        (promoted, UpdateError::Signature),
    ] {
        rig.file = file;
        let end = rig.run(Script::Update, |_, _| true);
        assert_eq!(end, End::Failed(expected));
        rig.board.cut_power();
        assert_eq!(rig.assert_serves("refused"), OLD);
    }
    rig.file = good;
    assert_eq!(rig.run(Script::Update, |_, _| true), version(NEW));
}

#[test]
fn an_update_goes_on_where_power_cuts_stopped_it() {
    let mut rig = Rig::start();
    rig.set_stops(true, false);
    let mut resumed = Vec::new();
    while resumed.last() < Some(&20_000) {
        let mut erases = 0;
        rig.resumed = None;
        // Two pages further each time.
        let end = rig.run(Script::Update, |_, _| {
            erases += 1;
            erases <= 2
        });
        assert_eq!(end, End::Stopped);
        resumed.extend(rig.resumed);
        rig.board.cut_power();
    }
    // The page of the manifest is the first that was erased, and the power failed when the third one was.
    let expected = [0]
        .into_iter()
        .chain((1..).step_by(2).map(|page| page * 1024));
    assert!(
        expected.zip(&resumed).all(|(expected, at)| expected == *at),
        "{resumed:?}"
    );
    rig.set_stops(false, false);
    assert_eq!(rig.run(Script::Update, |_, _| true), version(NEW));
    assert_eq!(rig.assert_serves("updated"), NEW);
}
