//! The power fails at a change of the flash: an erase of a page, or the write of a word.
//!
//! An update is recorded once: the flash as it is at each erase. For a cut, the board gets the flash of one of them, so that it
//! goes on with exactly this erase, and runs to the change at which its power fails. All images that it may run serve then.

use std::time::Instant;

use ztl_tests::lab::{Random, number, seed};

use super::rig::{Change, End, NEW, OLD, PAGE, PARTITIONS, Rig, Script};

/// What the flash is changed for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Phase {
    Receive,
    Mark,
    Swap,
    Confirm,
    Revert,
}

/// The changes from an erase to the next one.
#[derive(Debug)]
struct Unit {
    phase: Phase,
    /// Before the erase.
    partitions: Vec<u8>,
}

/// More changes than a unit has: an erase, a page, its mark, the head of a manifest, and the state.
const MOST_CHANGES: usize = 300;

/// Runs the halted board and records its units from these partitions on.
#[track_caller]
fn record(
    rig: &mut Rig,
    script: Script,
    partitions: &mut [u8],
    phase: impl Fn(usize, bool) -> Phase,
) -> (Vec<Unit>, End) {
    rig.set_stops(true, false);
    let mut units: Vec<Unit> = Vec::new();
    let mut is_marked = false;
    // The state, and what is recorded of a manifest, change without an erase.
    let fixed = [PARTITIONS.start, PARTITIONS.end - PAGE];
    let mut erased = PARTITIONS.start;
    let end = rig.run(script, |board, change| {
        for page in fixed.into_iter().chain([erased]) {
            let memory = board.read_memory(page..page + PAGE);
            partitions[page - PARTITIONS.start..][..PAGE].copy_from_slice(&memory);
        }
        let Change { is_erase, address } = change;
        assert!(is_erase);
        erased = address;
        let phase = phase(address, is_marked);
        is_marked |= phase == Phase::Mark;
        let partitions = partitions.to_vec();
        units.push(Unit { phase, partitions });
        true
    });
    (units, end)
}

/// The units of an update that is confirmed, and of one that is not.
#[track_caller]
fn record_all(rig: &mut Rig) -> Vec<Unit> {
    let mut partitions = rig.first[PARTITIONS].to_vec();
    let update = |page, is_marked| match page {
        _ if is_marked => Phase::Swap,
        page if page == PARTITIONS.start => Phase::Mark,
        _ => Phase::Receive,
    };
    let (mut units, end) = record(rig, Script::Update, &mut partitions, update);
    assert_eq!(end, End::Version(NEW.to_owned()));
    // Nothing but these changes has changed the flash: the last page that was swapped is still to be read.
    let at_end = rig.board.read_memory(PARTITIONS);
    let differ = (0..at_end.len())
        .step_by(PAGE)
        .filter(|at| at_end[*at..][..PAGE] != partitions[*at..][..PAGE]);
    assert!(differ.count() <= 2);
    let mut trial = at_end.clone();
    let (confirms, end) = record(rig, Script::Confirm, &mut trial, |_, _| Phase::Confirm);
    assert_eq!(end, End::Confirmed);
    rig.restore(&at_end);
    let mut reverted = at_end;
    let (reverts, end) = record(rig, Script::Greet, &mut reverted, |_, _| Phase::Revert);
    assert_eq!(end, End::Version(OLD.to_owned()));
    units.extend(confirms);
    units.extend(reverts);
    units
}

/// Cuts the power at a change of a unit, counted from 0, and checks what runs then; `None` if the unit has fewer changes.
#[track_caller]
fn cut(rig: &mut Rig, units: &[Unit], unit: usize, change: usize) -> Option<&'static str> {
    let Unit { phase, partitions } = &units[unit];
    let script = match phase {
        Phase::Receive | Phase::Mark => Script::Update,
        Phase::Swap | Phase::Revert => Script::Greet,
        Phase::Confirm => {
            // Only after a swap there is something to confirm.
            let swap = units
                .iter()
                .rfind(|unit| unit.phase == Phase::Swap)
                .expect("a swap");
            rig.set_stops(false, false);
            rig.restore(&swap.partitions);
            assert_eq!(
                rig.run(Script::Greet, |_, _| true),
                End::Version(NEW.to_owned())
            );
            Script::Confirm
        }
    };
    if *phase != Phase::Confirm {
        rig.restore(partitions);
    }
    rig.set_stops(true, true);
    let mut changes = 0;
    let mut is_beyond = false;
    let end = rig.run(script, |_, Change { is_erase, .. }| {
        is_beyond = changes > 0 && is_erase && *phase != Phase::Confirm;
        changes += 1;
        changes <= change && !is_beyond
    });
    if end != End::Stopped || is_beyond {
        rig.board.halt();
        return None;
    }
    rig.board.cut_power();
    let context = format!("{phase:?}, unit {unit}, change {change}");
    let version = rig.assert_serves(&context);
    let expected = match phase {
        Phase::Receive | Phase::Mark | Phase::Revert => OLD,
        Phase::Swap => NEW,
        // Before the first change it is not confirmed.
        Phase::Confirm if change == 0 => OLD,
        Phase::Confirm => NEW,
    };
    assert_eq!(version, expected, "{context}");
    Some(version)
}

/// Cuts the power at each change from `ZTL_CUT_CHANGE` of the unit `ZTL_CUT_UNIT` on, for `ZTL_CUT_MINUTES` if that is not 0.
/// Says where the next run goes on. Returns how many there were.
#[track_caller]
fn cut_all(rig: &mut Rig, units: &[Unit]) -> usize {
    let minutes = number("ZTL_CUT_MINUTES", 0);
    let first = number("ZTL_CUT_UNIT", 0) as usize;
    let mut change = number("ZTL_CUT_CHANGE", 0) as usize;
    let (begun, mut done) = (Instant::now(), 0);
    for unit in first..units.len() {
        while change < MOST_CHANGES && cut(rig, units, unit, change).is_some() {
            (done, change) = (done + 1, change + 1);
            if minutes > 0 && begun.elapsed().as_secs() >= 60 * minutes {
                println!("next: cargo xtask cuts --unit {unit} --change {change}");
                return done;
            }
        }
        change = 0;
    }
    println!("these were the last ones");
    done
}

/// The power fails at so many changes, chosen by a seed (`ZTL_SEED`), or at each one (`ZTL_CUTS=0`, which takes hours:
/// `cargo xtask cuts`).
#[test]
fn a_power_cut_at_any_change_of_the_flash_leaves_the_old_or_the_new_image() {
    let cuts = number("ZTL_CUTS", 120) as usize;
    let mut random = Random::new(seed());
    let mut rig = Rig::start();
    let units = record_all(&mut rig);
    let of = |phase: Phase| -> Vec<usize> {
        let numbered = units.iter().enumerate();
        numbered
            .filter(|(_, unit)| unit.phase == phase)
            .map(|(at, _)| at)
            .collect()
    };
    let pages = 63;
    assert_eq!(of(Phase::Swap).len(), 2 * pages);
    // At the end it also erases the state.
    assert_eq!(of(Phase::Revert).len(), 2 * pages + 1);
    let mut done = 0;
    if cuts == 0 {
        done = cut_all(&mut rig, &units);
    } else {
        // These have few changes; all are cut.
        for unit in [of(Phase::Mark), of(Phase::Confirm)].concat() {
            let changes = (0..MOST_CHANGES)
                .take_while(|change| cut(&mut rig, &units, unit, *change).is_some());
            done += changes.count();
        }
        while done < cuts {
            let phase = random.pick(&[
                Phase::Receive,
                Phase::Swap,
                Phase::Swap,
                Phase::Revert,
                Phase::Revert,
            ]);
            let unit = random.pick(&of(phase));
            // Few stops take little time; the last changes of a unit are its last word and what marks it as complete.
            let change = match random.once_in(10) {
                true => 256 + random.below(2),
                false => random.below(8),
            };
            done += usize::from(cut(&mut rig, &units, unit, change).is_some());
        }
    }
    println!("{done} power cuts in {} units", units.len());
}
