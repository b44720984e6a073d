//! Mistakes that could be made in the two ends, each of which the model must catch.
//!
//! `build.rs` compiles a second copy of the ends in which each of these can be switched on. A
//! mistake is written as changes of the source, so that it is the real code that is broken; when
//! that code has changed, the test `every_mistake_has_its_place` says which is to be rewritten.

/// A mistake.
#[derive(Debug)]
pub struct Mutant {
    /// Its name.
    pub name: &'static str,
    /// The changes: file, what stands there once, and what stands there instead. `ON` is replaced
    /// by the switch.
    pub edits: &'static [(&'static str, &'static str, &'static str)],
    /// The scenario that catches it, and with how many faults.
    pub caught_in: (&'static str, u8),
    /// How the complaint begins.
    pub complaint: &'static str,
}

const COMMANDS: &str = "ztl-mcu/src/node/commands.rs";
const RUNNER: &str = "ztl-mcu/src/node/runner.rs";
const SESSION: &str = "ztl-link/src/session.rs";
const SEND: &str = "ztl-link/src/session/send.rs";
const RECEIVE: &str = "ztl-link/src/session/receive.rs";
const ENDS: &str = "ztl-link/src/session/ends.rs";

const REPEATED: (&str, &str, &str) = (
    COMMANDS,
    "if seq == self.seq {",
    "if seq == self.seq && !ON {",
);
const NEXT: (&str, &str, &str) = (
    COMMANDS,
    "if seq != next_seq(self.seq) {",
    "if seq != next_seq(self.seq) && !ON {",
);
const HIGHEST: (&str, &str, &str) = (
    COMMANDS,
    "if task <= self.highest {",
    "if task <= self.highest && !ON {",
);

/// All of them.
pub const MUTANTS: &[Mutant] = &[
    Mutant {
        name: "the node executes a repeated command again",
        edits: &[REPEATED, NEXT, HIGHEST],
        caught_in: ("frames", 1),
        complaint: "promise 1",
    },
    Mutant {
        name: "the node executes a repeated command again, but no Start",
        edits: &[REPEATED, NEXT],
        caught_in: ("abort", 1),
        complaint: "promise 6",
    },
    Mutant {
        name: "the node takes a Start that is not above the highest",
        edits: &[HIGHEST],
        caught_in: ("repeat", 2),
        complaint: "promise 1",
    },
    Mutant {
        name: "the node takes a Start after its moment",
        edits: &[(
            COMMANDS,
            "if now.as_millis() > before_ms {",
            "if now.as_millis() > before_ms && !ON {",
        )],
        caught_in: ("cut", 2),
        complaint: "promise 4",
    },
    Mutant {
        name: "the gateway sends a Start again in another session",
        edits: &[(
            SEND,
            "self.phase = Phase::Greeting;",
            "self.phase = Phase::Greeting;
            if ON {
                for task in self.tasks.values_mut() {
                    if matches!(task.stage, Stage::Sent(_)) {
                        task.stage = Stage::Waiting;
                    }
                }
            }",
        )],
        caught_in: ("cut", 1),
        complaint: "promise 6",
    },
    Mutant {
        name: "the gateway tells REJECTED before the device has refused",
        edits: &[(
            ENDS,
            ".filter(|(_, task)| task.waits() && now >= task.deadline)",
            ".filter(|(_, task)| (task.waits() || ON && matches!(task.stage, Stage::Sent(_))) && now >= task.deadline)",
        )],
        caught_in: ("cut", 1),
        complaint: "promise 6",
    },
    Mutant {
        name: "the gateway tells FAILED after one link timeout",
        edits: &[(
            ENDS,
            "(self.heard + timeout * 2)",
            "(self.heard + timeout * if ON { 1 } else { 2 })",
        )],
        caught_in: ("unplug", 1),
        complaint: "promise 4",
    },
    Mutant {
        name: "the gateway forgets that a Start is taken as late as its moment",
        edits: &[(
            ENDS,
            ".max(task.deadline + timeout)",
            ".max(if ON { self.heard } else { task.deadline + timeout })",
        )],
        caught_in: ("late", 2),
        complaint: "promise 4",
    },
    Mutant {
        name: "a session is known by its Hello alone, not by the boot of its Welcome",
        edits: &[
            (
                RECEIVE,
                "self.session = session_key(self.session, welcome.boot);",
                "self.session = session_key(self.session, if ON { 0 } else { welcome.boot });",
            ),
            (
                COMMANDS,
                "self.session = session_key(hello.session, self.boot);",
                "self.session = session_key(hello.session, if ON { 0 } else { self.boot });",
            ),
        ],
        caught_in: ("reset", 2),
        complaint: "promise 4",
    },
    Mutant {
        name: "the gateway does not look at the boot id",
        edits: &[(
            RECEIVE,
            "let other = |sent: Sent| sent.boot != welcome.boot || welcome.replaces == 0;",
            "let other = |sent: Sent| (sent.boot != welcome.boot || welcome.replaces == 0) && !ON;",
        )],
        caught_in: ("reset", 1),
        complaint: "promise 2",
    },
    Mutant {
        name: "the gateway opens no other session when its device is silent or has started anew",
        edits: &[
            (
                SESSION,
                "let wait = in_flight.sent + timeout;",
                "let wait = in_flight.sent + timeout * if ON { 1000 } else { 1 };",
            ),
            (
                SESSION,
                "let give_up = in_flight.sent + self.link_timeout();",
                "let give_up = in_flight.sent + self.link_timeout() * if ON { 1000 } else { 1 };",
            ),
            (
                RECEIVE,
                "Phase::Describing | Phase::Up if known != Some(boot) =>",
                "Phase::Describing | Phase::Up if known != Some(boot) && !ON =>",
            ),
        ],
        caught_in: ("reset", 1),
        complaint: "promise 3",
    },
    Mutant {
        name: "the node lets a second gateway in",
        edits: &[(
            COMMANDS,
            "if live && hello.gateway != self.gateway {",
            "if live && hello.gateway != self.gateway && !ON {",
        )],
        caught_in: ("two", 0),
        complaint: "promise: the device of one gateway",
    },
    Mutant {
        name: "the node's link timer is restarted by repeated commands",
        edits: &[(
            COMMANDS,
            "count(&mut counters.repeats);",
            "count(&mut counters.repeats);
            if ON {
                self.lost_at = now.after(self.link_timeout);
            }",
        )],
        caught_in: ("cut", 1),
        complaint: "promise 4",
    },
    Mutant {
        name: "the node does not act when the link is lost",
        edits: &[(
            RUNNER,
            "all || component.offer().loss != Loss::CarryOn",
            "(all || component.offer().loss != Loss::CarryOn) && !ON",
        )],
        caught_in: ("cut", 1),
        complaint: "promise 4",
    },
    Mutant {
        name: "the node leaves components without a task alone when the link is lost",
        edits: &[(
            RUNNER,
            "if !goes_to_safety(component, all) {",
            "if !goes_to_safety(component, all) || ON && self.tasks.moving(place).is_none() {",
        )],
        caught_in: ("full", 1),
        complaint: "promise 4",
    },
    Mutant {
        name: "the node does not poll a component without a task until it is safe",
        edits: &[(
            RUNNER,
            "self.safety_wake = now;",
            "self.safety_wake = if ON { Instant::NEVER } else { now };",
        )],
        caught_in: ("full", 1),
        complaint: "promise 4",
    },
    Mutant {
        name: "the node gives another gateway the number of a Start that may be under way",
        edits: &[(
            COMMANDS,
            "self.highest = LinkId(self.highest.0.saturating_add(1));",
            "self.highest = LinkId(self.highest.0.saturating_add(if ON { 0 } else { 1 }));",
        )],
        caught_in: ("takeover", 2),
        complaint: "promise 2",
    },
    Mutant {
        name: "the gateway tells FAILED of a task that carries on",
        edits: &[(
            ENDS,
            ".filter(|(_, task)| task.may_run() && !task.carries_on())",
            ".filter(|(_, task)| task.may_run() && (!task.carries_on() || ON))",
        )],
        caught_in: ("carry-on", 1),
        complaint: "promise 4",
    },
    Mutant {
        name: "the gateway does not write down a Start before it is sent",
        edits: &[(
            SEND,
            "if let Err(reason) = self.book.starting(&entry) {",
            "if !ON && let Err(reason) = self.book.starting(&entry) {",
        )],
        caught_in: ("journal", 1),
        complaint: "promise 6",
    },
    Mutant {
        name: "the gateway does not write down an end before it is told",
        edits: &[(
            ENDS,
            "if let Err(reason) = self.book.ended(&task.entry(id), state, text) {",
            "if !ON && let Err(reason) = self.book.ended(&task.entry(id), state, text) {",
        )],
        caught_in: ("journal", 1),
        complaint: "promise 2",
    },
    Mutant {
        name: "the gateway leaves alone what it finds running and does not know",
        edits: &[(
            RECEIVE,
            ".filter(|link| self.find(*link).is_none())",
            ".filter(|link| self.find(*link).is_none() && !ON)",
        )],
        caught_in: ("restart", 1),
        complaint: "promise 4",
    },
    Mutant {
        name: "the gateway tells an end each time it hears it",
        edits: &[(
            ENDS,
            "let taken = matches!(task.stage, Stage::Sent(_));
        self.tasks.remove(&id);",
            "let taken = matches!(task.stage, Stage::Sent(_));
        if !ON {
            self.tasks.remove(&id);
        }",
        )],
        caught_in: ("frames", 1),
        complaint: "promise 2",
    },
    Mutant {
        name: "the gateway takes a Start without an answer for refused",
        edits: &[
            (
                RECEIVE,
                "Stage::Sent(sent) if held.contains(&sent.link) =>",
                "Stage::Sent(sent) if held.contains(&sent.link) && !ON =>",
            ),
            (
                RECEIVE,
                "Stage::Sent(sent) if sent.link.0 > welcome.highest =>",
                "Stage::Sent(sent) if sent.link.0 > welcome.highest || ON =>",
            ),
        ],
        caught_in: ("cut", 1),
        complaint: "promise 6",
    },
    Mutant {
        name: "the node gives up an end that is not acknowledged",
        edits: &[(
            RUNNER,
            "if known.is_free() {",
            "if known.is_free() || ON && known.end().is_some() {",
        )],
        caught_in: ("full", 1),
        complaint: "promise 2",
    },
    Mutant {
        name: "the node forgets its ends in a new session",
        edits: &[(
            COMMANDS,
            "for task in self.runner.tasks.held_mut() {
                task.due = now;",
            "for task in self.runner.tasks.held_mut() {
                if ON && task.end().is_some() {
                    task.forget();
                    continue;
                }
                task.due = now;",
        )],
        caught_in: ("unplug", 1),
        complaint: "promise 2",
    },
];
