//! Which fields of the state machines matter, and how.

use std::time::Duration;

/// Times further in the past are equal: no timer looks back that far.
pub(super) const PAST: Duration = Duration::from_millis(2600);
/// Times further in the future are equal.
pub(super) const FUTURE: Duration = Duration::from_secs(60);

/// Fields without influence on the behaviour: derived from others, statistics, or for readings, which the model has not.
pub(super) const SKIPPED: [u64; 10] = [
    name("ending"),
    name("decoder"),
    name("bytes"),
    name("counters"),
    name("random"),
    name("frame_out"),
    name("readings_at"),
    name("readings_wake"),
    name("turnaround"),
    name("round_trips"),
];

/// Frames that a bus keeps as bytes. Whoever skips them adds them in another form.
pub const BUS_FRAMES: [u64; 2] = [name("sent"), name("unasked")];

/// How often in a row something has failed. Larger numbers are equal.
pub(super) const FAILURES: [u64; 2] = [name("garbled"), name("silent")];
pub(super) const MANY_FAILURES: u64 = 12;

pub(super) const SEQ: u64 = name("seq");
pub(super) const CLOCK: u64 = name("clock");
pub(super) const NODE_CLOCKS: [u64; 2] = [CLOCK_MS, name("before_ms")];
/// The node's clock in a frame.
pub(super) const CLOCK_MS: u64 = name("clock_ms");
pub(super) const SESSIONS: [u64; 2] = [name("session"), name("hello")];
/// A session before this one. Which one it was does not matter.
pub(super) const REPLACED: [u64; 2] = [name("replaced"), name("replaces")];
/// Times at which something is due: how long ago does not matter.
pub(super) const DUE: [u64; 13] = [
    name("ask_at"),
    name("awake_due"),
    name("begun_due"),
    name("due"),
    name("event_due"),
    name("not_before"),
    name("quiet_at"),
    name("receiving"),
    name("repeat"),
    name("retry_at"),
    name("safety_wake"),
    name("until"),
    name("wake"),
];
pub(super) const INSTANT: u64 = name("Instant");
/// The phase of a session. While its `Hello` is not answered, these fields are not read, and the answer overwrites them; a
/// `Hello` is repeated for ever, in step with what is sent when it was not answered for long.
pub(super) const PHASE: u64 = name("phase");
pub(super) const UNANSWERED: [u64; 2] = [name("Down"), name("Greeting")];
pub(super) const ANSWERED: [u64; 2] = [name("Describing"), name("Up")];
pub(super) const OVERWRITTEN: [u64; 5] = [
    name("clock"),
    name("commanded"),
    name("highest"),
    name("repeated"),
    name("sent"),
];
/// When the last answer arrived. A session reads it only for tasks that may run, and it is no earlier than one second before
/// the deadline of any that is sent later.
pub(super) const HEARD: u64 = name("heard");
/// The deadline of a task of a session, and the stage that follows it.
pub(super) const DEADLINE: u64 = name("deadline");
pub(super) const STAGE: u64 = name("stage");
pub(super) const RUNNING: u64 = name("Running");
/// Ids of tasks on the link. Only their differences matter.
pub(super) const LINK_ID: u64 = name("LinkId");
pub(super) const HIGHEST: u64 = name("highest");
/// Larger differences are equal: no scenario has that many tasks.
pub(super) const APART: i64 = 9;

/// Larger differences between the sequence numbers of a session are equal.
pub(super) const FAR: u64 = 9;
/// Smaller sequence numbers differ, because a delayed `Hello` opens a session again and its numbers begin again.
pub(super) const FIRST: u64 = 3;
/// Sequence numbers from here on differ, because the gateway opens a new session after 255.
pub const NEARLY_ALL: u8 = 250;

pub(super) const SEED: u64 = 0xcbf2_9ce4_8422_2325;
pub(super) const PRIME: u64 = 0x9e37_79b9_7f4a_7c15;

pub(super) const fn step(hash: u64, number: u64) -> u64 {
    (hash.rotate_left(23) ^ number).wrapping_mul(PRIME)
}

const fn name(text: &str) -> u64 {
    word(SEED, text.as_bytes())
}

/// Hashes a piece of a word, eight bytes at a time.
pub(super) const fn word(mut hash: u64, bytes: &[u8]) -> u64 {
    let (eights, rest) = bytes.as_chunks::<8>();
    let mut place = 0;
    while place < eights.len() {
        hash = step(hash, u64::from_be_bytes(eights[place]));
        place += 1;
    }
    if rest.is_empty() {
        return hash;
    }
    let (mut last, mut place) = (0, 0);
    while place < rest.len() {
        last = last << 8 | rest[place] as u64;
        place += 1;
    }
    step(hash, last)
}
