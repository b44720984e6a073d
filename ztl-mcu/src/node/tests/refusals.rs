//! The order of the reasons to refuse a `Start`: clause 11.2.

use super::*;

/// The reasons, in the order of the specification.
const REASONS: [&str; 10] = [
    "the command came too late",
    "a task of this or a later id was started already",
    "emergency stop",
    "no such component",
    "busy with another task",
    "busy going to its safe state",
    "a number of ms",
    "busy, and no more tasks may wait",
    "busy, and the goal is too long to wait: more than 48 bytes",
    "too many tasks are running",
];
const LATE: usize = 0;
const OLD: usize = 1;
const STOPPED: usize = 2;
const NOWHERE: usize = 3;
const BUSY: usize = 4;
const UNSAFE: usize = 5;
const GOAL: usize = 6;
const QUEUE: usize = 7;
const LONG: usize = 8;
const FULL: usize = 9;

/// Whether the reasons are compatible: a missing component is neither busy nor unsafe and accepts any
/// goal, an unsafe component has no task, and a component that refuses while busy has no queue.
fn together(has: impl Fn(usize) -> bool) -> bool {
    let waits = has(QUEUE) || has(LONG);
    !(has(NOWHERE) && (has(BUSY) || has(UNSAFE) || has(GOAL) || waits)
        || has(UNSAFE) && (has(BUSY) || waits)
        || has(BUSY) && waits)
}

/// A node's reply to a `Start` that it must refuse for these reasons.
fn refusal(has: impl Fn(usize) -> bool) -> String {
    let waits = has(QUEUE) || has(LONG);
    let trace = Trace::default();
    let mut components = [
        motor("slow", Loss::Abort, &trace),
        motor("busy", Loss::CarryOn, &trace),
        motor("other", Loss::CarryOn, &trace),
    ];
    components[0].slow = 5000;
    components[1].busy = if waits { Busy::Queue(1) } else { Busy::Refuse };
    let mut node = TestNode::<2>::new(Identity::new("desk", "1", 77), components);
    let mut gateway = gateway(&mut node);
    gateway.hello(5, 1);
    gateway.start(1, 7, 1, "60000");
    let mut seq = 1;
    if has(QUEUE) || has(FULL) {
        seq += 1;
        gateway.start(seq, 8, if has(QUEUE) { 1 } else { 2 }, "60000");
    }
    if has(UNSAFE) {
        gateway
            .node
            .handle_timeout(gateway.now + Duration::from_secs(1));
    }
    gateway.node.state.runner.stopped = has(STOPPED);
    let number = if has(GOAL) { "x" } else { "5" };
    let goal = format!("{number:>0$}", if has(LONG) { 49 } else { 1 });
    let start = Body::Start {
        task: LinkId(if has(OLD) { 7 } else { 99 }),
        component: match () {
            () if has(NOWHERE) => 7,
            () if has(BUSY) || waits => 1,
            () => 0,
        },
        goal: &goal,
        before_ms: if has(LATE) { 0 } else { u64::MAX },
    };
    gateway.command(seq + 1, start).remove(0)
}

#[test]
fn a_start_with_two_faults_is_rejected_for_the_first() {
    for (first, told) in REASONS.iter().enumerate() {
        for (second, other) in REASONS.iter().enumerate().skip(first) {
            let has = |reason| reason == first || reason == second;
            if together(has) {
                let heard = refusal(has);
                let (_, heard) = heard.split_once(" Refused ").unwrap();
                assert_eq!(heard, *told, "and {other}");
            }
        }
    }
}
