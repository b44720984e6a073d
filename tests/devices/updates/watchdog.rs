//! The watchdog. QEMU's nRF51 has none: the tests see where the firmware starts it and feeds it, and reset the board themselves.

use std::collections::BTreeSet;

use ztl_tests::lab::{FlashImage, PATIENCE, until};

use super::rig::{ACTIVE, End, NEW, OLD, PAGE, PARTITIONS, Rig, Script, signed};

/// Where a function of an image is.
#[track_caller]
fn function(image: &str, name: &str) -> u64 {
    FlashImage::built(&format!("microbit-{image}")).symbol(name)
}

/// Where the bootloader starts the watchdog, and where the two images feed it.
#[track_caller]
fn places() -> (u64, [u64; 2]) {
    let feeds = ["update", "updated"].map(|image| function(image, "watchdog_feed"));
    (function("boot", "watchdog_start"), feeds)
}

/// Runs the halted board until it stops, and says where.
#[track_caller]
fn next_stop(rig: &mut Rig) -> u64 {
    rig.board.run();
    until("a stop", PATIENCE, || rig.board.wait(20).then_some(()));
    rig.board.stopped_at().0
}

#[test]
fn the_bootloader_starts_the_watchdog_before_the_main_loop_feeds_it() {
    let mut rig = Rig::start();
    let (start, [feed, _]) = places();
    rig.board.set_stops(&BTreeSet::from([start, feed]));
    let stops = [(); 4].map(|()| next_stop(&mut rig));
    assert_eq!(stops, [start, feed, feed, feed]);
}

#[test]
fn the_main_loop_turns_and_the_node_answers_while_it_verifies() {
    let mut rig = Rig::start();
    // The last change of what is received marks its last page as complete.
    let pages = rig.file.len().div_ceil(PAGE);
    let mark = PARTITIONS.end - PAGE + 128 + 4 * (pages - 1);
    rig.set_stops(true, true);
    let end = rig.run(Script::Update, |_, change| change.address != mark);
    assert_eq!(end, End::Stopped);
    let (_, [feed, _]) = places();
    // A turn verifies 128 bytes or a bit, and nothing while an answer is sent. All of it would take hundreds.
    rig.verify_by_turns(feed, 20);
}

#[test]
fn an_image_that_hangs_with_interrupts_off_does_not_feed_the_watchdog_and_goes_back_at_its_reset() {
    let mut rig = Rig::start();
    let [_, new] = &rig.images;
    let mut hanging = new.clone();
    let reset = u32::from_le_bytes(new[4..8].try_into().expect("a vector"));
    let reset = (reset & !1) as usize;
    // CPSID i, and a branch to itself.
    hanging[reset - ACTIVE..][..4].copy_from_slice(&[0x72, 0xB6, 0xFE, 0xE7]);
    rig.file = signed(&hanging, NEW, "microbit");
    // Until the bootloader swaps.
    let received = PARTITIONS.end - (64 << 10)..PARTITIONS.end;
    let mut is_received = false;
    rig.set_stops(true, false);
    let end = rig.run(Script::Update, |_, change| {
        let swaps = is_received && change.address >= ACTIVE;
        is_received |= change.address == PARTITIONS.start;
        assert!(swaps || is_received || received.contains(&change.address));
        !swaps
    });
    assert_eq!(end, End::Stopped);
    let (start, [old, new]) = places();
    let hang = reset as u64 + 2;
    rig.board
        .set_stops(&BTreeSet::from([start, old, new, hang]));
    let stops = [(); 3].map(|()| next_stop(&mut rig));
    assert_eq!(stops, [hang; 3]);
    rig.board.cut_power();
    assert_eq!(rig.assert_serves("reverted"), OLD);
}
