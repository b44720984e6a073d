//! Which replies are valid.

use ztl_core::dispatcher::KEEP_INIT;
use ztl_core::envelope::{ClientId, Envelope};
use ztl_core::reply::Reply;
use ztl_core::{Instant, Message, State};

use super::state::{Asked, BOOT, First, LastInit, Model, Task, cut};

/// A reply's state, id and payload.
type Told<'a> = (&'a str, &'a str, &'a str);

const NO_CLIENTS: &str = "too many clients at a time, try again in a minute";
const NO_TASKS: &str = "too many tasks are running, wait for one to end";
const NO_WAITERS: &str = "too many requests are waiting, try again";
const NO_IDS: &str =
    "all task ids are used up; restart the server, without its journal if it has one";

impl Model {
    pub(in crate::dispatcher) fn on_answer(
        &mut self,
        now: Instant,
        place: usize,
        reply: &Reply<'_>,
    ) {
        let mut text = Vec::new();
        reply.put(&mut |bytes: &[u8]| text.extend_from_slice(bytes));
        let text = String::from_utf8(text).expect("UTF-8");
        let ask = &mut self.asks[place];
        assert!(!ask.answered, "a second answer, {text}, to {ask:?}");
        assert!(now <= ask.due, "a late answer to {ask:?}");
        ask.answered = true;
        let (asked, envelope, scope) = (ask.asked.clone(), ask.envelope, ask.scope.clone());
        let early = now < ask.due;
        let wish = envelope.is_some_and(|envelope| envelope.early_end);
        let told = Message::parse(text.as_bytes()).expect("a message");
        assert_eq!(told.scope, scope, "{text}");
        let told = (told.state, told.id, told.payload);
        if told.2 == NO_CLIENTS && self.asks[place].forgettable {
            assert_eq!(told.0, "2");
            assert_eq!(told.1, if scope == "$ztl" { "0" } else { "-1" });
            return self.assert_no_place(now, place);
        }
        match asked {
            Asked::Only(expected) => assert_eq!(text, expected),
            Asked::Init(None) => self.assert_refusal(now, place, told),
            Asked::Init(Some(task)) => self.assert_first(task, wish, told),
            Asked::Again { scope, task } => self.assert_first(task, wish && scope != "$ztl", told),
            Asked::Refusal {
                scope,
                text: reason,
            } => {
                assert_eq!(text, format!("{scope};2;-1;{}", cut(&reason)));
            }
            Asked::NeverSeen(client, number) => {
                self.assert_never_seen(now, place, (client, number), told)
            }
            Asked::Status { task, wait } => self.assert_status(task, wait && early, told),
            Asked::Abort { task, ended } => self.assert_abort(task, ended, told),
            Asked::Probe => self.assert_probe(told),
        }
    }

    /// Checks the rejection of an INIT that did not start.
    fn assert_refusal(&mut self, now: Instant, place: usize, told: Told<'_>) {
        let (state, id, text) = told;
        assert_eq!((state, id), ("2", "-1"));
        let held = self.asks.iter().filter(|ask| !ask.answered).count();
        match text {
            NO_IDS => {
                let last = self.tasks.last().map(|task| task.id.get());
                assert_eq!(last, Some(u32::MAX));
                return;
            }
            NO_CLIENTS => return self.assert_no_place(now, place),
            NO_TASKS => assert_eq!(self.running().count(), self.limits.tasks),
            NO_WAITERS => assert_eq!(held, self.limits.held),
            other => panic!("refused for {other}"),
        }
        let ask = &self.asks[place];
        if let Some(Envelope { client, number, .. }) = ask.envelope {
            let of = (ask.scope.clone(), ask.payload.clone());
            let first = First::Refused(text.to_owned());
            let until = Some(now + KEEP_INIT);
            self.remember(
                client,
                LastInit {
                    number,
                    received: false,
                    of,
                    first,
                    until,
                },
            );
        }
    }

    /// Checks the first or repeated reply to the INIT of a task.
    fn assert_first(&self, task: usize, wish: bool, told: Told<'_>) {
        let task = &self.tasks[task];
        let id = task.id.to_string();
        let undecided = format!("Initiated task '{id}', nobody has taken it yet");
        if let Some((state, reason)) = &task.refused {
            let threw = *state == State::Failed;
            let prefix = if threw {
                "Controller threw exception: "
            } else {
                ""
            };
            let state = state.code().to_string();
            let whole = format!("{prefix}{reason}");
            let kept = format!("{prefix}{}", cut(reason));
            assert!(
                told == (&state, "-1", &whole) || told == (&state, "-1", &kept),
                "{told:?}: {whole}"
            );
            return;
        }
        let (state, told_id, text) = told;
        assert_eq!(told_id, id);
        if state == "1" {
            let known = match &task.accepted {
                Some(reply) => text == reply || text == cut(reply),
                None => text == undecided,
            };
            assert!(known, "{told:?}");
        } else {
            assert!(wish && task.state.is_final(), "{told:?}");
            self.assert_end(task, state, text);
        }
    }

    fn assert_never_seen(
        &mut self,
        now: Instant,
        place: usize,
        (client, number): (ClientId, u64),
        told: Told<'_>,
    ) {
        let (state, id, text) = told;
        assert_eq!((state, id), ("2", "0"));
        if text == NO_CLIENTS {
            return self.assert_no_place(now, place);
        }
        assert_eq!(text, format!("never seen since boot {BOOT}"));
        let until = Some(now + KEEP_INIT);
        let void = LastInit {
            number,
            received: false,
            of: Default::default(),
            first: First::Void,
            until,
        };
        self.remember(client, void);
    }

    fn assert_status(&mut self, place: usize, early: bool, told: Told<'_>) {
        let held = self.asks.iter().filter(|ask| !ask.answered).count();
        let task = &self.tasks[place];
        let (state, id, text) = told;
        assert_eq!(id, task.id.to_string());
        let unknown = (state, text) == ("2", &format!("Invalid ID '{id}'"));
        // If the handler rejected the task with this very text, the reply proves nothing.
        let ambiguous = task.state == State::Rejected && task.text == text;
        if task.state.is_final() && unknown && !ambiguous {
            return self.on_forgotten(place);
        }
        assert_eq!(state, task.state.code().to_string());
        assert_eq!(text, task.text);
        if early && !task.state.is_final() {
            assert_eq!(held, self.limits.held, "it could have waited");
        }
    }

    fn assert_abort(&mut self, place: usize, ended: bool, told: Told<'_>) {
        let task = &self.tasks[place];
        let (state, id, text) = told;
        assert_eq!(id, task.id.to_string());
        if ended && (state, text) == ("2", &format!("Invalid ID '{id}'")) {
            return self.on_forgotten(place);
        }
        if !task.state.is_final() {
            let refused = self.refusing == Some(place)
                && state == task.state.code().to_string()
                && text == "False";
            assert!(refused || (state, text) == ("1", "aborting"), "{told:?}");
        } else if ended {
            assert_eq!(text, "False");
            assert_eq!(state, task.state.code().to_string());
        } else if task.state == State::Aborted {
            assert_eq!((state, text), ("4", "True"));
        } else {
            self.assert_end(task, state, text);
        }
    }

    /// An ended task is unknown: its slot must have been needed.
    fn on_forgotten(&mut self, place: usize) {
        let task = &mut self.tasks[place];
        task.forgotten = true;
        let before = task.ended.expect("an end");
        let needed = self.new_inits > before && self.new_inits > self.limits.tasks;
        assert!(needed || task.nameless, "forgotten too early");
    }

    fn assert_end(&self, task: &Task, state: &str, text: &str) {
        assert_eq!(state, task.state.code().to_string());
        assert_eq!(text, task.text);
    }

    fn assert_probe(&self, told: Told<'_>) {
        let (state, id, text) = told;
        assert_eq!((state, id), ("5", "0"));
        let (_, listed) = text.split_once("running: {").expect("a list");
        let listed = listed.strip_suffix("}}").expect("its end");
        let mut listed: Vec<&str> = listed.split(", ").filter(|item| !item.is_empty()).collect();
        let mut running: Vec<String> = self
            .running()
            .map(|task| format!("{}: {:?}", task.id, task.scope))
            .collect();
        listed.sort_unstable();
        running.sort_unstable();
        assert_eq!(listed, running);
    }
}
