//! Mutants of the two ends. The model must catch each of them.
//!
//! `build.rs` compiles a second copy of the ends in which each mutant can be switched on. A mutant is a change of the
//! source, so it breaks the real code. When that code has changed, the test `every_mutant_is_found_in_the_source` names
//! the mutant to rewrite.

/// A change of the ends that breaks a promise.
#[derive(Debug)]
pub struct Mutant {
    /// Its name.
    pub name: &'static str,
    /// The changes: file, code that occurs there once, and its replacement. `ON` stands for the switch.
    pub edits: &'static [(&'static str, &'static str, &'static str)],
    /// The scenario that catches it, and with how many faults; or [`SEEDS`], and how many of them.
    pub caught_in: (&'static str, u8),
    /// How the message of the violation begins.
    pub complaint: &'static str,
}

/// The simulation of whole shared lines, in place of a scenario of the model.
pub const SEEDS: &str = "seeds of shared lines";

const COMMANDS: &str = "ztl-mcu/src/node/commands.rs";
const RUNNER: &str = "ztl-mcu/src/node/runner.rs";
const SESSION: &str = "ztl-link/src/session.rs";
const SEND: &str = "ztl-link/src/session/send.rs";
const RECEIVE: &str = "ztl-link/src/session/receive.rs";
const OUTCOME: &str = "ztl-link/src/session/outcome.rs";
const DOUBT: &str = "ztl-link/src/session/doubt.rs";
const OWN: &str = "ztl-link/src/session/own.rs";
const OWN_NODE: &str = "ztl-mcu/src/node/own.rs";
const BUS: &str = "ztl-link/src/bus.rs";
const BOARDS: &str = "ztl-link/src/bus/boards.rs";
const MEMBER: &str = "ztl-link/src/bus/member.rs";
const BUS_FRAMES: &str = "ztl-mcu/src/node/bus.rs";
const PARAMETERS_NODE: &str = "ztl-mcu/src/node/parameters.rs";
const PARAMETERS: &str = "ztl-link/src/session/parameters.rs";
const ACTING: &str = "ztl-mcu/src/acting.rs";

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
    "if task <= self.highest ||",
    "if task <= self.highest && !ON ||",
);

/// All mutants.
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
        name: "the node executes a Start that is not above the highest",
        edits: &[HIGHEST],
        caught_in: ("repeat", 2),
        complaint: "promise 1",
    },
    Mutant {
        name: "the node executes a Start after its deadline",
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
        name: "the gateway does not send an Abort again in another session",
        edits: &[(
            SEND,
            "self.strangers.clear();",
            "self.strangers.clear();
            for task in self.tasks.values_mut() {
                task.abort &= !ON;
            }",
        )],
        caught_in: ("renew", 0),
        complaint: "promise 2",
    },
    Mutant {
        name: "the gateway reports REJECTED before the device has refused",
        edits: &[(
            OUTCOME,
            ".filter(|(_, task)| task.waits() && now >= task.deadline)",
            ".filter(|(_, task)| (task.waits() || ON && matches!(task.stage, Stage::Sent(_))) && now >= task.deadline)",
        )],
        caught_in: ("cut", 1),
        complaint: "promise 6",
    },
    Mutant {
        name: "the gateway reports FAILED after one link timeout",
        edits: &[(
            OUTCOME,
            "(self.heard + timeout * 2)",
            "(self.heard + timeout * if ON { 1 } else { 2 })",
        )],
        caught_in: ("unplug", 1),
        complaint: "promise 4",
    },
    Mutant {
        name: "the gateway ignores that a Start may be executed until its deadline",
        edits: &[(
            OUTCOME,
            ".max(task.deadline + timeout)",
            ".max(if ON { self.heard } else { task.deadline + timeout })",
        )],
        caught_in: ("late", 2),
        complaint: "promise 4",
    },
    Mutant {
        name: "a session is identified by its Hello alone, not by the boot of its Welcome",
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
        name: "the gateway ignores the boot id",
        edits: &[(
            DOUBT,
            "sent.boot != welcome.boot || welcome.replaces == 0",
            "(sent.boot != welcome.boot || welcome.replaces == 0) && !ON",
        )],
        caught_in: ("reset", 1),
        complaint: "promise 2",
    },
    Mutant {
        name: "the gateway opens no new session when its device is silent or was reset",
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
        name: "the node admits a second gateway",
        edits: &[(
            COMMANDS,
            "if live && hello.gateway != self.gateway {",
            "if live && hello.gateway != self.gateway && !ON {",
        )],
        caught_in: ("two", 0),
        complaint: "promise: the device of one gateway",
    },
    Mutant {
        name: "repeated commands restart the node's link timer",
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
        name: "the node ignores idle components when the link is lost",
        edits: &[(
            RUNNER,
            "if !goes_to_safety(component, all) {",
            "if !goes_to_safety(component, all) || ON && self.tasks.running_on(index).is_none() {",
        )],
        caught_in: ("full", 1),
        complaint: "promise 4",
    },
    Mutant {
        name: "the node does not poll an idle component until it is safe",
        edits: &[(
            RUNNER,
            "self.safety_wake = now;",
            "self.safety_wake = if ON { Instant::NEVER } else { now };",
        )],
        caught_in: ("full", 1),
        complaint: "promise 4",
    },
    Mutant {
        name: "the node takes a component for safe that fails to become safe",
        edits: &[(
            RUNNER,
            "if to_safety && run == Run::Failed {",
            "if to_safety && run == Run::Failed && !ON {",
        )],
        caught_in: ("fails", 1),
        complaint: "promise 4",
    },
    Mutant {
        name: "the node lets another gateway use the id of a Start that may still arrive",
        edits: &[(
            COMMANDS,
            "self.highest = LinkId(self.highest.0.saturating_add(1));",
            "self.highest = LinkId(self.highest.0.saturating_add(if ON { 0 } else { 1 }));",
        )],
        caught_in: ("takeover", 2),
        complaint: "promise 2",
    },
    Mutant {
        name: "the gateway reports FAILED for a task that carries on",
        edits: &[(
            OUTCOME,
            ".filter(|(_, task)| task.may_run() && !task.carries_on())",
            ".filter(|(_, task)| task.may_run() && (!task.carries_on() || ON))",
        )],
        caught_in: ("carry-on", 1),
        complaint: "promise 4",
    },
    Mutant {
        name: "the gateway does not journal a Start before it is sent",
        edits: &[(
            SEND,
            "if let Err(reason) = self.journal.starting(&entry) {",
            "if !ON && let Err(reason) = self.journal.starting(&entry) {",
        )],
        caught_in: ("journal", 1),
        complaint: "promise 6",
    },
    Mutant {
        name: "the gateway does not journal an outcome before it is reported",
        edits: &[(
            OUTCOME,
            "if let Err(reason) = self.journal.ended(&task.entry(id), state, text) {",
            "if !ON && let Err(reason) = self.journal.ended(&task.entry(id), state, text) {",
        )],
        caught_in: ("journal", 1),
        complaint: "promise 2",
    },
    Mutant {
        name: "the gateway does not abort unknown tasks of the device",
        edits: &[(
            RECEIVE,
            ".filter(|link| self.find(*link).is_none())",
            ".filter(|link| self.find(*link).is_none() && !ON)",
        )],
        caught_in: ("restart", 1),
        complaint: "promise 4",
    },
    Mutant {
        name: "the gateway reports an outcome each time it arrives",
        edits: &[(
            OUTCOME,
            "let undecided = matches!(task.stage, Stage::Sent(_));
        self.tasks.remove(&id);",
            "let undecided = matches!(task.stage, Stage::Sent(_));
        if !ON {
            self.tasks.remove(&id);
        }",
        )],
        caught_in: ("frames", 1),
        complaint: "promise 2",
    },
    Mutant {
        name: "the gateway considers a Start without an answer refused",
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
        name: "the gateway uses the numbers of commands again in one session",
        edits: &[(
            RECEIVE,
            "if self.seq == u8::MAX {",
            "if self.seq == u8::MAX && !ON {",
        )],
        caught_in: ("renew", 1),
        complaint: "promise 6",
    },
    Mutant {
        name: "the node drops an outcome that is not acknowledged",
        edits: &[(
            RUNNER,
            "if known.is_free() {",
            "if known.is_free() || ON && known.end().is_some() {",
        )],
        caught_in: ("full", 1),
        complaint: "promise 2",
    },
    Mutant {
        name: "the node drops its outcomes in a new session",
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
    Mutant {
        name: "the gateway does not journal a task of the device before it says that it knows it",
        edits: &[(
            OWN,
            "if self.journal.starting(&task.entry(id)).is_err() {",
            "if !ON && self.journal.starting(&task.entry(id)).is_err() {",
        )],
        caught_in: ("own", 1),
        complaint: "promise 7",
    },
    Mutant {
        name: "a restarted gateway does not know which tasks of the device have ended",
        edits: &[(
            SESSION,
            "own: Own::new(journal.latest_own()),",
            "own: Own::new(journal.latest_own().filter(|_| !ON)),",
        )],
        caught_in: ("jog", 1),
        complaint: "promise 7",
    },
    Mutant {
        name: "the gateway takes up a task of the device again when it is announced after its end",
        edits: &[(
            OWN,
            "self.find(link).is_some() || self.was_taken_up(link)",
            "self.find(link).is_some() || self.was_taken_up(link) && !ON",
        )],
        caught_in: ("jog", 1),
        complaint: "promise 7",
    },
    Mutant {
        name: "the gateway acknowledges the end of a task of the device that it does not know",
        edits: &[(
            RECEIVE,
            "None if task.is_local() && !self.was_taken_up(task) => return,",
            "None if task.is_local() && !self.was_taken_up(task) && !ON => return,",
        )],
        caught_in: ("jog", 1),
        complaint: "promise 2",
    },
    Mutant {
        name: "the gateway misses tasks of the device in the list of a Welcome",
        edits: &[(
            RECEIVE,
            "task.may_run() && !task.is_own()",
            "task.may_run() && (!task.is_own() || ON)",
        )],
        caught_in: ("own", 1),
        complaint: "promise",
    },
    Mutant {
        name: "the gateway does not notice that a task of the device was lost by its reset",
        edits: &[(
            RECEIVE,
            "of_other(sent, welcome)) && !self.stays(task, welcome)",
            "of_other(sent, welcome)) && !self.stays(task, welcome) && !(ON && task.is_own())",
        )],
        caught_in: ("own", 1),
        complaint: "promise",
    },
    Mutant {
        name: "the node starts tasks itself without a link",
        edits: &[(
            OWN_NODE,
            "if !up && acts && !self.runner.is_stopped() {",
            "if !up && acts && !self.runner.is_stopped() && !ON {",
        )],
        caught_in: ("jog", 1),
        complaint: "promise 4",
    },
    Mutant {
        name: "the node does not announce its tasks to the next session",
        edits: &[(
            ACTING,
            "task.noted = false;
        }
        self.begun_due = now;
        self.event_due",
            "task.noted &= ON;
        }
        self.begun_due = now;
        self.event_due",
        )],
        caught_in: ("own-restart", 1),
        complaint: "promise 7",
    },
    Mutant {
        name: "a node on a shared line handles frames for others",
        edits: &[(
            BUS_FRAMES,
            "if !bus.is_for(address) {",
            "if !bus.is_for(address) && !ON {",
        )],
        caught_in: ("bus-frames", 0),
        complaint: "promise",
    },
    Mutant {
        name: "the gateway never polls a node on a shared line",
        edits: &[(
            MEMBER,
            "command.into_iter().chain([poll])",
            "command.into_iter().chain(Some(poll).filter(|_| !ON))",
        )],
        caught_in: ("bus-frames", 0),
        complaint: "promise",
    },
    Mutant {
        name: "the gateway waits for ever for an answer on a shared line",
        edits: &[(
            BUS,
            "now >= question.deadline)",
            "now >= question.deadline && !ON)",
        )],
        caught_in: ("bus-frames", 1),
        complaint: "promise",
    },
    Mutant {
        name: "the gateway never asks a node on a shared line again that was silent",
        edits: &[(
            MEMBER,
            "self.not_before = now + pause.min(BACK_OFF_MOST);",
            "self.not_before = if ON { Instant::NEVER } else { now + pause.min(BACK_OFF_MOST) };",
        )],
        caught_in: ("bus-abort", 1),
        complaint: "promise",
    },
    Mutant {
        name: "the gateway takes another board on a shared line for its device after a reset",
        edits: &[(DOUBT, "        !alone", "        !alone && !ON")],
        caught_in: ("bus-second", 1),
        complaint: "promise",
    },
    Mutant {
        name: "the node sets a value again when the command is repeated",
        edits: &[REPEATED, NEXT],
        caught_in: ("set", 1),
        complaint: "promise 8",
    },
    Mutant {
        name: "the node sets a value under a task",
        edits: &[(
            PARAMETERS_NODE,
            "if self.moves(component) {",
            "if self.moves(component) && !ON {",
        )],
        caught_in: ("set-task", 1),
        complaint: "promise 8",
    },
    Mutant {
        name: "the gateway says that a value is not set when its answer is lost with the session",
        edits: &[(
            PARAMETERS,
            "Err(ParameterFailure::Unknown)",
            "Err(if ON { ParameterFailure::NotSent(\"\") } else { ParameterFailure::Unknown })",
        )],
        caught_in: ("set", 1),
        complaint: "promise 8",
    },
    Mutant {
        name: "a Start and an Abort wait for the polls of a shared line",
        edits: &[(
            MEMBER,
            "let urgent = command.urgent || self.needs.urgent;",
            "let urgent = !ON && (command.urgent || self.needs.urgent);",
        )],
        caught_in: (SEEDS, 3),
        complaint: "turn: a Start or an Abort",
    },
    Mutant {
        name: "a search of a shared line goes before the turns of busy nodes",
        edits: &[(
            BUS,
            "search.set_waiting(!fits);",
            "search.set_waiting(!fits && !ON);",
        )],
        caught_in: (SEEDS, 10),
        complaint: "turn: a turn at least every",
    },
    Mutant {
        name: "a node with a task on a shared line is polled like one at rest",
        edits: &[(
            MEMBER,
            "if self.needs.busy { BUSY }",
            "if self.needs.busy && !ON { BUSY }",
        )],
        caught_in: (SEEDS, 3),
        complaint: "turn: a turn at least every",
    },
    Mutant {
        name: "the gateway takes the tasks of another board for those of the board that a search has found",
        edits: &[(
            BOARDS,
            "boots.all(|known| known.is_some_and(|known| known.id == found))",
            "boots.all(|known| known.is_some_and(|known| known.id == found || ON))",
        )],
        caught_in: (SEEDS, 3),
        complaint: "promise 4",
    },
    Mutant {
        name: "the gateway asks the next question while a node of a shared line answers",
        edits: &[(
            BUS,
            "if self.question.is_some() || now < self.quiet_at {",
            "if self.question.is_some() && !ON || now < self.quiet_at {",
        )],
        caught_in: (SEEDS, 3),
        complaint: "promise 3",
    },
];
