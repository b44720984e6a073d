//! A model of a server's promises: every request, every task, and the last INIT of each of our clients,
//! stored without limit.

mod answers;
mod places;
mod questions;

use std::collections::BTreeMap;

use ztl_core::dispatcher::{Body, Config, KEEP_INIT, TaskEvent};
use ztl_core::envelope::{ClientId, Envelope};
use ztl_core::{Instant, Message, State, TaskId};

use super::{BOOT, TEXT};
use places::{Places, is_init};
use questions::only;

/// The server's capacities.
pub(super) struct Limits {
    pub(super) tasks: usize,
    pub(super) held: usize,
    pub(super) first: TaskId,
}

/// A task that was started, as its handler sees it.
pub(super) struct Task {
    pub(super) id: TaskId,
    scope: &'static str,
    state: State,
    /// Progress, result or reason, as stored.
    text: String,
    /// The reply to its INIT: once accepted, and once rejected with the state.
    accepted: Option<String>,
    refused: Option<(State, String)>,
    /// How many INITs had arrived when it ended.
    ended: Option<usize>,
    /// Rejected while its INIT still waited: the client never had an id to ask about.
    nameless: bool,
    /// A reply said that the task is unknown.
    forgotten: bool,
}

/// What a request asks for, and therefore which replies are valid.
#[derive(Debug, Clone)]
enum Asked {
    /// Exactly this reply.
    Only(String),
    /// A new task; `None` until it is started.
    Init(Option<usize>),
    /// The reply to a client's last INIT, which was rejected without being started.
    Refusal {
        scope: &'static str,
        text: String,
    },
    /// The reply to a repeated INIT, or its outcome.
    Again {
        scope: &'static str,
        task: usize,
    },
    NeverSeen(ClientId, u64),
    Status {
        task: usize,
        wait: bool,
    },
    Abort {
        task: usize,
        ended: bool,
    },
    Probe,
}

#[derive(Debug)]
struct Ask {
    due: Instant,
    envelope: Option<Envelope>,
    scope: String,
    payload: String,
    asked: Asked,
    /// The INIT's record may have been evicted: its client has the reply, or the INIT can no longer have an effect.
    forgettable: bool,
    /// What the client said earlier shows that the INIT has not arrived before.
    surely_new: bool,
    answered: bool,
}

/// The state of a client's last INIT.
#[derive(Debug, Clone)]
enum First {
    Started(usize),
    Refused(String),
    Void,
}

struct LastInit {
    number: u64,
    /// Its client has asked about its task.
    received: bool,
    /// Its scope and payload, which no other INIT with this number shares.
    of: (String, String),
    first: First,
    /// How long the server must keep the record; `None` while the INIT is undecided.
    until: Option<Instant>,
}

pub(super) struct Model {
    limits: Limits,
    asks: Vec<Ask>,
    tasks: Vec<Task>,
    inits: BTreeMap<ClientId, LastInit>,
    places: Places,
    /// Number of INITs that had not arrived before.
    new_inits: usize,
    /// The task whose handler is just refusing to abort it.
    refusing: Option<usize>,
}

impl Model {
    pub(super) fn new(limits: Limits) -> Self {
        Self {
            places: Places::new(limits.held),
            limits,
            asks: Vec::new(),
            tasks: Vec::new(),
            inits: BTreeMap::new(),
            new_inits: 0,
            refusing: None,
        }
    }

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
            panic!("nobody asked to abort {id}");
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
            TaskEvent::AbortRefused => {
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

    fn running(&self) -> impl Iterator<Item = &Task> {
        self.tasks.iter().filter(|task| !task.state.is_final())
    }
}

fn config() -> Config {
    Config::new(TaskId::new(1).expect("not 0"), BOOT)
}

/// A text as a memory of [`TEXT`] bytes stores it.
fn cut(text: &str) -> String {
    if text.len() <= TEXT {
        return text.to_owned();
    }
    let mut kept = String::new();
    for c in text.chars() {
        if kept.len() + c.len_utf8() > TEXT - "…".len() {
            break;
        }
        kept.push(c);
    }
    kept + "…"
}
