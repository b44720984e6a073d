//! What the model remembers, and the settings of the server that it describes.

use std::collections::BTreeMap;

use ztl_core::dispatcher::Config;
use ztl_core::envelope::{ClientId, Envelope};
use ztl_core::{Instant, State, TaskId};

use super::places::Places;

/// The registered scopes.
pub(in crate::dispatcher) const SCOPES: [&str; 2] = ["/lab", "/s"];

/// Longest stored text, in bytes.
pub(in crate::dispatcher) const TEXT: usize = 16;

/// The boot id that `$ztl` reports.
pub(in crate::dispatcher) const BOOT: u32 = 4711;

/// The server's capacities.
pub(in crate::dispatcher) struct Limits {
    pub(in crate::dispatcher) tasks: usize,
    pub(in crate::dispatcher) held: usize,
    pub(in crate::dispatcher) first: TaskId,
}

/// A task that was started, as its handler sees it.
pub(in crate::dispatcher) struct Task {
    pub(in crate::dispatcher) id: TaskId,
    pub(super) scope: &'static str,
    pub(super) state: State,
    /// Progress, result or reason, as stored.
    pub(super) text: String,
    /// The reply to its INIT: once accepted, and once rejected with the state.
    pub(super) accepted: Option<String>,
    pub(super) refused: Option<(State, String)>,
    /// How many INITs had arrived when it ended.
    pub(super) ended: Option<usize>,
    /// Rejected while its INIT still waited: the client never had an id to ask about.
    pub(super) nameless: bool,
    /// A reply said that the task is unknown.
    pub(super) forgotten: bool,
}

/// What a request asks for, and therefore which replies are valid.
#[derive(Debug, Clone)]
pub(super) enum Asked {
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
pub(super) struct Ask {
    pub(super) due: Instant,
    pub(super) envelope: Option<Envelope>,
    pub(super) scope: String,
    pub(super) payload: String,
    pub(super) asked: Asked,
    /// The INIT's record may have been evicted: its client has the reply, or the INIT can no longer have an effect.
    pub(super) forgettable: bool,
    /// What the client said earlier shows that the INIT has not arrived before.
    pub(super) surely_new: bool,
    pub(super) answered: bool,
}

/// The state of a client's last INIT.
#[derive(Debug, Clone)]
pub(super) enum First {
    Started(usize),
    Refused(String),
    Void,
}

pub(super) struct LastInit {
    pub(super) number: u64,
    /// Its client has asked about its task.
    pub(super) received: bool,
    /// Its scope and payload, which no other INIT with this number shares.
    pub(super) of: (String, String),
    pub(super) first: First,
    /// How long the server must keep the record; `None` while the INIT is undecided.
    pub(super) until: Option<Instant>,
}

pub(in crate::dispatcher) struct Model {
    pub(super) limits: Limits,
    pub(super) asks: Vec<Ask>,
    pub(super) tasks: Vec<Task>,
    pub(super) inits: BTreeMap<ClientId, LastInit>,
    pub(super) places: Places,
    /// Number of INITs that had not arrived before.
    pub(super) new_inits: usize,
    /// The task whose handler is just refusing to abort it.
    pub(super) refusing: Option<usize>,
}

impl Model {
    pub(in crate::dispatcher) fn new(limits: Limits) -> Self {
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

    pub(super) fn running(&self) -> impl Iterator<Item = &Task> {
        self.tasks.iter().filter(|task| !task.state.is_final())
    }
}

pub(super) fn config() -> Config {
    Config::new(TaskId::new(1).expect("not 0"), BOOT)
}

/// A text as a memory of [`TEXT`] bytes stores it.
pub(super) fn cut(text: &str) -> String {
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
