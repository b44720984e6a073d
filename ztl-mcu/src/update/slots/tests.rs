//! The power of a board fails at each change of its flash, or the flash does.

mod board;

use super::*;
use board::{Board, Fault, LONGEST, NEW, OLD, PAGE, STATE, WORD, key, noise, signed};
use embassy_boot::BlockingFirmwareUpdater;
use salty::{Keypair, PublicKey, Signature};
use std::vec::Vec;

/// Bytes that are sent at a time.
const PIECE: usize = 96;
/// Calls of `verify` for the signature.
const SIGNATURE_PARTS: usize = 256 + 1;

/// Sends the rest of the image.
fn receive(slots: &mut impl Updater, file: &[u8]) -> Result<Receiving, UpdateError> {
    let (manifest, image) = file.split_at(MANIFEST_LEN);
    let receiving = slots.begin(manifest, false)?;
    let mut at = receiving.offset as usize;
    while at < image.len() {
        let piece = &image[at..image.len().min(at + PIECE)];
        slots.write(at as u32, piece)?;
        at += piece.len();
    }
    Ok(receiving)
}

/// Verifies all parts, and counts them.
fn verify(slots: &mut impl Updater) -> Result<usize, UpdateError> {
    let mut parts = 1;
    while slots.verify()? == Verification::Continues {
        parts += 1;
    }
    Ok(parts)
}

/// How many calls verify an image of this length.
fn parts(length: usize) -> usize {
    (length + HEAD_LEN).div_ceil(BLOCK) + SIGNATURE_PARTS
}

#[test]
fn images_of_all_lengths_are_received_verified_run_and_kept() {
    for length in (IMAGE_UNIT..=LONGEST).step_by(IMAGE_UNIT) {
        let board = Board::new(length);
        let mut slots = board.slots().unwrap();
        let receiving = receive(&mut slots, &board.file).unwrap();
        let length = length as u32;
        assert_eq!(receiving, Receiving { length, offset: 0 });
        assert_eq!(verify(&mut slots), Ok(parts(length as usize)));
        assert!(board.is_marked());
        assert_eq!(board.restart(), NEW);
        assert!(!board.slots().unwrap().firmware().confirmed);
        let mut on_trial = board.slots().unwrap();
        let refused = on_trial.begin(&board.file[..MANIFEST_LEN], false);
        assert_eq!(refused, Err(UpdateError::OnTrial));
        board.confirm().unwrap();
        assert_eq!(board.restart(), NEW);
    }
}

#[test]
fn an_image_that_is_not_confirmed_is_swapped_back() {
    let board = Board::new(LONGEST);
    board.update().unwrap();
    assert_eq!([board.restart(), board.restart()], [NEW, OLD]);
    assert_eq!(board.restart(), OLD);
}

#[test]
fn what_is_not_for_this_board_is_refused_with_its_reason() {
    let board = Board::new(LONGEST);
    let image = &board.new;
    let mut damaged = board.file.clone();
    damaged[4] = 9;
    let too_long = noise(3, LONGEST + IMAGE_UNIT);
    for (file, expected) in [
        (signed(image, "other", NEW), UpdateError::Board),
        (signed(image, "board", "0.9.9"), UpdateError::Older),
        (signed(&too_long, "board", NEW), UpdateError::TooLong),
        (damaged, UpdateError::Manifest),
        (board.file[..50].to_vec(), UpdateError::Manifest),
    ] {
        let board = board.clone();
        let mut slots = board.slots().unwrap();
        let manifest = file.get(..MANIFEST_LEN).unwrap_or(&file);
        assert_eq!(slots.begin(manifest, false), Err(expected));
        assert_eq!(board.chip.borrow().changes, 0);
        assert_eq!(slots.write(0, &[0; PIECE]), Err(UpdateError::Storage));
        assert_eq!(slots.verify(), Err(UpdateError::Storage));
        assert_eq!(board.restart(), OLD);
    }
    let older = signed(image, "board", "0.9.9");
    let mut slots = board.slots().unwrap();
    assert!(slots.begin(&older[..MANIFEST_LEN], true).is_ok());
}

#[test]
fn an_image_with_one_wrong_bit_is_not_marked_and_the_right_one_runs_afterwards() {
    let board = Board::new(LONGEST);
    let last = board.file.len() - 1;
    // Of the version, the two halves of the signature, the image's first, a middle and its last byte.
    for at in [
        6,
        HEAD_LEN,
        HEAD_LEN + 33,
        MANIFEST_LEN,
        MANIFEST_LEN + 400,
        last,
    ] {
        let mut altered = board.clone();
        altered.file[at] ^= 2;
        assert_eq!(altered.update(), Err(UpdateError::Signature), "byte {at}");
        assert!(!altered.is_marked());
        assert_eq!(altered.restart(), OLD);
        altered.file = board.file.clone();
        assert_eq!(altered.update(), Ok(()));
        assert_eq!(altered.restart(), NEW);
    }
    // Signed with another key.
    let mut slots = board.slots().unwrap();
    slots.image.key = &[1; 32];
    receive(&mut slots, &board.file).unwrap();
    assert_eq!(verify(&mut slots), Err(UpdateError::Signature));
    assert!(!board.is_marked());
}

#[test]
fn pieces_twice_out_of_order_or_of_a_wrong_length_end_the_update_unmarked() {
    let board = Board::new(LONGEST);
    let image = board.new.clone();
    let piece = |at: usize| (at as u32, &image[at..at + PIECE]);
    for (offset, bytes) in [
        piece(0),
        piece(2 * PIECE),
        piece(PIECE + IMAGE_UNIT),
        (PIECE as u32, &image[..IMAGE_UNIT + 1]),
        (PIECE as u32, &noise(4, LONGEST)),
        (u32::MAX - 31, &image[..IMAGE_UNIT]),
    ] {
        let mut slots = board.slots().unwrap();
        slots.begin(&board.file[..MANIFEST_LEN], false).unwrap();
        let (at, first) = piece(0);
        slots.write(at, first).unwrap();
        assert_eq!(slots.write(offset, bytes), Err(UpdateError::Storage));
        // It is over until it begins again.
        let (at, second) = piece(PIECE);
        assert_eq!(slots.write(at, second), Err(UpdateError::Storage));
        assert_eq!(slots.verify(), Err(UpdateError::Storage));
        assert!(!board.is_marked());
        assert_eq!(board.clone().update(), Ok(()));
    }
    // Incomplete.
    let mut slots = board.slots().unwrap();
    slots.begin(&board.file[..MANIFEST_LEN], false).unwrap();
    slots.write(0, piece(0).1).unwrap();
    assert_eq!(slots.verify(), Err(UpdateError::Storage));
    // Nothing at the end writes nothing.
    receive(&mut slots, &board.file).unwrap();
    let changes = board.changes();
    slots.write(LONGEST as u32, &[]).unwrap();
    assert_eq!(board.changes(), changes);
    assert!(verify(&mut slots).is_ok());
}

#[test]
fn an_update_goes_on_with_the_first_page_that_is_not_complete() {
    for length in [LONGEST, 2 * PAGE, 2 * PAGE - TAIL, PAGE - IMAGE_UNIT] {
        let board = Board::new(length);
        let (manifest, image) = board.file.split_at(MANIFEST_LEN);
        let units: Vec<_> = image.chunks(IMAGE_UNIT).collect();
        for stored in 0..=units.len() {
            let board = board.clone();
            let mut slots = board.slots().unwrap();
            slots.begin(manifest, false).unwrap();
            for (at, unit) in (0..).step_by(IMAGE_UNIT).zip(&units[..stored]) {
                slots.write(at, unit).unwrap();
            }
            assert_eq!(board.restart(), OLD);
            let mut slots = board.slots().unwrap();
            let offset = slots.begin(manifest, false).unwrap().offset as usize;
            let expected = match stored * IMAGE_UNIT {
                stored if stored == length => length,
                // The tail is written with the last bytes.
                stored => (stored / PAGE * PAGE).min((length - 1) / PAGE * PAGE),
            };
            assert_eq!(offset, expected, "{stored} units of {length} bytes");
            receive(&mut slots, &board.file).unwrap();
            assert_eq!(verify(&mut slots), Ok(parts(length)));
            assert_eq!(board.restart(), NEW);
        }
    }
}

#[test]
fn a_verification_that_is_interrupted_after_any_part_begins_again() {
    let board = Board::new(LONGEST);
    let mut slots = board.slots().unwrap();
    receive(&mut slots, &board.file).unwrap();
    let all = parts(LONGEST);
    // All parts of the image, some of the signature, and the last one.
    let hash = all - SIGNATURE_PARTS;
    for done in (1..=hash)
        .chain((hash + 1..all).step_by(40))
        .chain([all - 1])
    {
        let board = board.clone();
        let interrupted = || {
            let mut slots = board.slots().unwrap();
            receive(&mut slots, &board.file).unwrap();
            for part in 0..done {
                assert_eq!(slots.verify(), Ok(Verification::Continues), "part {part}");
            }
            assert!(!board.is_marked(), "after {done} parts");
            slots
        };
        // By another update, which has the same manifest.
        let mut slots = interrupted();
        let receiving = receive(&mut slots, &board.file).unwrap();
        assert_eq!(receiving.offset, receiving.length);
        assert_eq!(verify(&mut slots), Ok(all));
        // By one that marks nothing, since it is not complete.
        slots.begin(&board.file[..MANIFEST_LEN], false).unwrap();
        assert!(!board.is_marked());
        // By a piece that does not belong there.
        let mut slots = interrupted();
        let written = slots.write(0, &board.new[..PIECE]);
        assert_eq!(written, Err(UpdateError::Storage));
        assert_eq!(slots.verify(), Err(UpdateError::Storage));
        // By a reset.
        interrupted();
        assert_eq!(board.restart(), OLD);
        assert!(!board.is_marked());
    }
}

#[test]
fn a_flash_that_fails_at_any_operation_is_the_reason_and_nothing_is_marked() {
    let board = Board::new(LONGEST);
    let good = board.clone();
    assert_eq!(good.update(), Ok(()));
    let (changes, reads) = (good.changes(), good.chip.borrow().reads);
    assert!(changes > LONGEST / WORD && reads > parts(LONGEST) - SIGNATURE_PARTS);
    let at_change = (0..changes).map(|at| (Some((at, Fault::Fails)), None));
    let at_read = (0..reads).map(|at| (None, Some((at, Fault::Fails))));
    for faults in at_change.chain(at_read) {
        let board = board.clone();
        {
            let mut chip = board.chip.borrow_mut();
            (chip.at_change, chip.at_read) = faults;
        }
        // The firmware does not start if it cannot read the state.
        let Some(mut slots) = board.slots() else {
            continue;
        };
        let ended = receive(&mut slots, &board.file).and_then(|_| verify(&mut slots));
        assert_eq!(ended, Err(UpdateError::Storage), "{faults:?}");
        assert_eq!(slots.verify(), Err(UpdateError::Storage), "{faults:?}");
        assert!(!board.is_marked(), "{faults:?}");
        // It was for once. The same firmware goes on.
        receive(&mut slots, &board.file).unwrap();
        assert!(verify(&mut slots).is_ok(), "{faults:?}");
        assert_eq!(board.restart(), NEW);
    }
}

/// Cuts the power at each change of what a board does, and at none.
#[track_caller]
fn cut_everywhere(
    before: &Board,
    act: impl Fn(&Board) -> Option<()>,
    check: impl Fn(&Board, &'static str, usize),
) -> Board {
    let whole = before.clone();
    act(&whole).expect("without a cut");
    let changes = whole.changes() - before.changes();
    for at in 0..changes {
        for fault in [Fault::Cut, Fault::CutWithin] {
            let board = before.with_fault(at, fault);
            assert_eq!(act(&board), None, "{fault:?} at {at} of {changes}");
            let version = board.restart();
            check(&board, version, changes - at);
        }
    }
    whole
}

#[test]
fn a_power_cut_at_any_change_of_the_flash_leaves_the_old_or_the_new_image() {
    let first = Board::new(LONGEST);
    let update = |board: &Board| board.update().ok();
    let marked = cut_everywhere(&first, update, |board, version, left| {
        // The last word is the mark; half of it is none.
        assert_eq!(version, OLD, "{left} changes before the end");
        assert_eq!(board.update(), Ok(()), "{left} changes before the end");
        assert_eq!(board.restart(), NEW);
    });
    let swapped = cut_everywhere(&marked, Board::boot, |board, version, left| {
        // Half of the last word can count as written: the swap was complete, and this start is the one after the trial.
        assert!(version == NEW || left == 1, "{left} changes before the end");
        assert_eq!(board.restart(), OLD);
    });
    assert_eq!(swapped.active(), NEW);
    let confirm = |board: &Board| board.confirm().ok();
    let kept = cut_everywhere(&swapped, confirm, |board, version, _| {
        // Whichever it is now, it stays.
        assert_eq!(board.restart(), version);
    });
    assert_eq!(kept.restart(), NEW);
    let reverted = cut_everywhere(&swapped, Board::boot, |board, version, _| {
        assert_eq!(version, OLD);
        assert_eq!(board.restart(), OLD);
    });
    assert_eq!(reverted.update(), Ok(()));
    assert_eq!(reverted.restart(), NEW);
}

#[test]
fn what_is_accepted_is_what_embassy_boot_accepts() {
    let board = Board::new(LONGEST);
    board.update().unwrap();
    for (bit, expected) in [(None, true), (Some(0), false), (Some(511), false)] {
        let mut file = board.file.clone();
        if let Some(bit) = bit {
            file[HEAD_LEN + bit / 8] ^= 1 << (bit % 8);
        }
        board.chip.borrow_mut().bytes[STATE].fill(0xFF);
        let mut word = AlignedBuffer([0; WORD]);
        let mut updater = BlockingFirmwareUpdater::new(board.partitions(), &mut word.0);
        let signature = file[HEAD_LEN..MANIFEST_LEN].try_into().unwrap();
        let signed = (LONGEST + HEAD_LEN) as u32;
        let verified = updater.verify_and_mark_updated(key(), signature, signed);
        assert_eq!(verified.is_ok(), expected, "{bit:?}");
        assert_eq!(board.is_marked(), expected);
    }
}

/// The answer of [`Check`], and that of `salty`.
fn both(key: &[u8; 32], signature: &[u8; 64], message: &[u8; 64]) -> [bool; 2] {
    let check = Check::new(key, signature, message);
    let ours = check.is_some_and(|mut check| {
        let answers = core::iter::repeat_with(|| check.step());
        answers.take(SIGNATURE_PARTS).flatten().next().unwrap()
    });
    let salty = PublicKey::try_from(key);
    let salty = salty.is_ok_and(|key| key.verify(message, &Signature::from(signature)).is_ok());
    [ours, salty]
}

#[test]
fn signatures_are_accepted_and_refused_as_by_salty() {
    for seed in 0..12 {
        let random = noise(seed, 128);
        let keys = Keypair::from(random.first_chunk().unwrap());
        let message: [u8; 64] = *random.last_chunk().unwrap();
        let key = keys.public.to_bytes();
        let good = keys.sign(&message).to_bytes();
        assert_eq!(both(&key, &good, &message), [true; 2]);
        for bit in (usize::from(seed)..512).step_by(73) {
            let mut signature = good;
            signature[bit / 8] ^= 1 << (bit % 8);
            assert_eq!(both(&key, &signature, &message), [false; 2], "bit {bit}");
        }
        let mut other = message;
        other[usize::from(seed)] ^= 1;
        assert_eq!(both(&key, &good, &other), [false; 2]);
        // Not every key is a point.
        let mut wrong = key;
        wrong[0] ^= 1 << (seed % 8);
        assert_eq!(both(&wrong, &good, &message), [false; 2]);
        // The same number, written as one that is greater than the order of the group.
        let mut greater = good;
        let order = salty::Scalar::ell();
        let mut carry = 0;
        for (digit, more) in greater[32..].iter_mut().zip(order) {
            let sum = u16::from(*digit) + u16::from(more) + carry;
            (*digit, carry) = (sum as u8, sum >> 8);
        }
        let [ours, salty] = both(&key, &greater, &message);
        assert_eq!(ours, salty);
    }
    // The neutral element as key and as R, with s = 0.
    let mut neutral = [0; 32];
    neutral[0] = 1;
    let mut signature = [0; 64];
    signature[0] = 1;
    assert_eq!(both(&neutral, &signature, &[5; 64]), [true; 2]);
}
