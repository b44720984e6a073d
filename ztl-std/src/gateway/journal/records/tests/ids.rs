//! Which task ids are reserved.

use super::*;

#[test]
fn no_id_is_reused_after_a_power_cut_at_any_point() {
    let mut log = JournalRecords::open(Synced::default(), b"", at(0), 7);
    let mut flushes = 0;
    for number in (5_000..60_000).step_by(701) {
        let before = log.storage.synced;
        log.start(at(1), number).unwrap();
        let storage = &log.storage;
        flushes += u32::from(storage.synced > before);
        let left = storage.written[..storage.synced].to_vec();
        let after = JournalRecords::open(Synced::default(), &left, at(2), 99);
        assert!(after.reserved_ids().given() >= number, "{number}");
        // All of the gateway's promises to its devices hang on it.
        assert_eq!(after.gateway(), 7);
    }
    // One for each half of a block, and for each new file.
    assert!(flushes < 20, "{flushes}");
}

#[test]
fn the_last_block_of_ids_ends_with_the_last_id() {
    let mut log = fresh();
    let last = TaskId::MAX;
    let entry = Entry {
        id: last,
        ..task(200)
    };
    log.starting(at(1), "gripper", None, None, &entry).unwrap();
    assert_eq!(restarted(&log).reserved_ids().given(), last.get());
}

#[test]
fn ids_without_an_entry_are_reserved_before_they_are_given() {
    let mut log = fresh();
    let ids = Arc::clone(log.reserved_ids());
    let mut given = ids.given();
    for _ in 0..5 {
        // To the last one that may be given.
        let last = ids.last().unwrap();
        assert!(last.get() > given + FIRST_BLOCK / 2);
        given = last.get();
        ids.give(last);
        assert_eq!(restarted(&log).reserved_ids().given(), given);
        log.check(at(1)).unwrap();
    }
    // Few are used up by each start.
    let restarts = (0..100).fold(log, |log, _| restarted(&log));
    assert!(restarts.reserved_ids().given() <= given + BLOCK + 100 * FIRST_BLOCK);
}

#[test]
fn ids_are_reserved_at_the_start_also_after_an_unreadable_line() {
    let mut written = fresh().storage().clone();
    written.extend_from_slice(b"{\"what\n");
    let log = JournalRecords::open(Vec::new(), &written, at(1), 7);
    let ids = log.reserved_ids();
    assert!(ids.last() > Some(id(ids.given())));
}

#[test]
fn no_id_is_given_while_none_can_be_reserved() {
    let mut log = JournalRecords::open(Small::new(0), b"", at(0), 7);
    let ids = Arc::clone(log.reserved_ids());
    assert_eq!(ids.last(), Some(id(ids.given())));
    assert!(log.check(at(1)).is_err());
    log.storage.room = usize::MAX;
    log.check(at(2)).unwrap();
    assert!(ids.last() > Some(id(ids.given())));
}
