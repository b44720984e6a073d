//! A model of a server's promises: every request, every task, and the last INIT of each of our clients,
//! stored without limit.

mod answers;
mod places;
mod questions;
mod records;
pub(super) mod state;

use ztl_core::dispatcher::{Body, KEEP_INIT, TaskEvent};
use ztl_core::envelope::{ClientId, Envelope};
use ztl_core::{Instant, Message, State, TaskId};

use questions::only;
use records::is_init;
use state::{Ask, Asked, First, LastInit, Model, Task, cut};

impl Model {
    pub(super) fn tasks(&self) -> &[Task] {
        &self.tasks
    }

    /// Registers a request that is about to arrive; returns its number.
    pub(super) fn ask(
        &mut self,
        now: Instant,
        ours: Option<(Envelope, u64)>,
        body: Body<'_>,
    ) -> usize {
        let envelope = ours.map(|(envelope, _)| envelope);
        let bytes = match body {
            Body::One(bytes) => bytes,
            Body::Several => b"",
        };
        let message = Message::parse(bytes);
        let scope = message.map_or_else(|error| error.scope(), |message| message.scope);
        let payload = message.map_or("", |message| message.payload);
        let (asked, hold) = match message {
            Ok(message) => self.asked(envelope, message),
            Err(_) => only(format!("{scope};2;-1;Unknown protocol")),
        };
        let about = message.ok().zip(envelope);
        let about = about.and_then(|(message, envelope)| self.about(envelope, message));
        let surely_new = about.is_some_and(|(client, number)| self.places.is_new(client, number));
        let forgettable = about.is_some_and(|(client, number)| {
            let last = self.inits.get(&client);
            last.is_some_and(|last| last.number >= number && self.is_released(last))
        });
        if let Some((envelope, place)) = ours
            && let Ok(message) = message
        {
            self.places.hear(envelope, place, is_init(message));
            self.on_asked_about(envelope, message);
        }
        self.new_inits += usize::from(matches!(asked, Asked::Init(None)));
        self.asks.push(Ask {
            due: now + hold,
            envelope,
            scope: scope.to_owned(),
            payload: payload.to_owned(),
            asked,
            forgettable,
            surely_new,
            answered: false,
        });
        self.asks.len() - 1
    }

    pub(super) fn on_start(&mut self, ask: usize, id: TaskId, scope: &'static str, payload: &str) {
        let place = self.tasks.len();
        let expected = match self.tasks.last() {
            Some(last) => last.id.get() + 1,
            None => self.limits.first.get(),
        };
        // A rejected INIT may consume an id, but no id is reused.
        assert!(id.get() >= expected, "{id} is reused");
        let ask = &mut self.asks[ask];
        assert!(
            matches!(ask.asked, Asked::Init(None)),
            "it must not start: {ask:?}"
        );
        assert!(!ask.answered, "answered before its handler has decided");
        assert_eq!(ask.scope, scope);
        assert!(payload.len() < 1 << 20);
        ask.asked = Asked::Init(Some(place));
        if let Some(Envelope { client, number, .. }) = ask.envelope {
            let first = First::Started(place);
            let of = (ask.scope.clone(), ask.payload.clone());
            self.remember(
                client,
                LastInit {
                    number,
                    received: false,
                    of,
                    first,
                    until: None,
                },
            );
        }
        self.tasks.push(Task {
            id,
            scope,
            state: State::Initiated,
            text: "None".to_owned(),
            accepted: None,
            refused: None,
            ended: None,
            nameless: false,
            forgotten: false,
        });
        assert!(self.running().count() <= self.limits.tasks);
    }

    fn remember(&mut self, client: ClientId, init: LastInit) {
        self.make_room(client);
        self.inits.insert(client, init);
    }

    pub(super) fn on_abort(&mut self, ask: usize, id: TaskId, scope: &str) {
        let Asked::Abort { task, ended: false } = self.asks[ask].asked else {
            panic!("no client asked to abort {id}");
        };
        assert_eq!((self.tasks[task].id, self.tasks[task].scope), (id, scope));
    }

    pub(super) fn on_no_action(&mut self, now: Instant, ask: usize) {
        let ask = &self.asks[ask];
        match ask.asked {
            Asked::Abort { ended, .. } => assert!(ended, "the handler is not told: {ask:?}"),
            Asked::Init(None) => assert!(ask.answered, "neither started nor answered"),
            _ => {}
        }
        assert!(ask.answered || ask.due >= now);
    }

    /// Registers a handler's report.
    pub(super) fn on_event(&mut self, now: Instant, id: TaskId, event: TaskEvent<'_>) {
        let place = self
            .tasks
            .iter()
            .position(|task| task.id == id)
            .expect("it was picked");
        let waits = |ask: &&Ask| match ask.asked {
            Asked::Init(task) => task == Some(place),
            Asked::Again { task, .. } => task == place,
            _ => false,
        };
        let nameless = self.asks.iter().filter(waits).any(|ask| !ask.answered);
        let task = &mut self.tasks[place];
        let was = task.state;
        let (state, text) = match event {
            TaskEvent::Accepted { reply } if was == State::Initiated => {
                task.accepted = Some(reply.to_owned());
                (State::Accepted, None)
            }
            TaskEvent::Rejected { reason } if was == State::Initiated => {
                task.refused = Some((State::Rejected, reason.to_owned()));
                (State::Rejected, Some(reason))
            }
            TaskEvent::Threw { message } if was == State::Initiated => {
                task.refused = Some((State::Failed, message.to_owned()));
                (State::Rejected, Some(message))
            }
            TaskEvent::Progress { text } => (was, Some(text)),
            TaskEvent::Completed { result } => (State::Completed, Some(result)),
            TaskEvent::Failed { reason } => (State::Failed, Some(reason)),
            TaskEvent::Aborted { result } => (State::Aborted, Some(result)),
            TaskEvent::AbortRejected => {
                self.refusing = Some(place);
                return;
            }
            _ => return,
        };
        if was.is_final() {
            return;
        }
        task.state = state;
        task.nameless = nameless && state == State::Rejected;
        task.ended = state.is_final().then_some(self.new_inits);
        if let Some(text) = text {
            task.text = cut(text);
        }
        let decided = was == State::Initiated && state != State::Initiated;
        if decided && state.is_final() && state != State::Rejected {
            // A task that reports a final state has been accepted.
            task.accepted = text.map(str::to_owned);
        }
        for init in self.inits.values_mut() {
            if decided && matches!(init.first, First::Started(task) if task == place) {
                init.until = Some(now + KEEP_INIT);
            }
        }
    }

    pub(super) fn after_event(&mut self) {
        self.refusing = None;
    }

    /// Time has passed: drops the records that the server need not keep any longer.
    pub(super) fn forget(&mut self, now: Instant) {
        self.inits
            .retain(|_, init| init.until.is_none_or(|until| now < until));
    }

    /// The server sleeps longer than it asked for.
    pub(super) fn oversleep(&mut self, until: Instant) {
        for ask in &mut self.asks {
            ask.due = ask.due.max(until);
        }
    }

    pub(super) fn assert_in_time(&self, now: Instant) {
        for ask in &self.asks {
            assert!(
                ask.answered || ask.due > now,
                "not answered in time: {ask:?}"
            );
        }
    }

    pub(super) fn assert_all_answered(&self) {
        for ask in &self.asks {
            assert!(ask.answered, "never answered: {ask:?}");
        }
    }
}
