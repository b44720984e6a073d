//! Clients and their goals. A client that has named itself finds its goals again over another socket.

use std::collections::{BTreeMap, HashMap, VecDeque};
use std::sync::{Arc, Mutex};

use serde_json::{Value, json};
use tokio::sync::mpsc;

use crate::clock::now_ms;
use crate::cut;
use crate::goal::Goal;
use crate::lock::locked;
use crate::outcome::Outcome;
use crate::rosbridge;
use crate::streams::Wanted;
use crate::topics::Topic;

/// Longest id of a client's goal.
pub(crate) const ID: usize = 256;
/// Most open goals of a client.
const GOALS: usize = 32;
/// Most ended goals of a client that are remembered.
const ENDED: usize = 64;
/// Most refused goals of a client that are remembered.
const REFUSED: usize = 64;
/// Most clients that are remembered by name.
const CLIENTS: usize = 256;
/// Shortest and longest name, in bytes. It has to be a secret.
const NAME: std::ops::RangeInclusive<usize> = 16..=128;

/// What is written to a client, or what it wants to hear.
pub(crate) enum Out {
    Text(String),
    Subscribe(Topic, bool),
    /// A publisher's streams, or one of them.
    Listen(Wanted, bool),
}

/// The clients that have named themselves.
#[derive(Default)]
pub(crate) struct Clients(Mutex<HashMap<String, Arc<Client>>>);

impl Clients {
    /// The client with this name, which may be a new one.
    ///
    /// # Errors
    /// What is wrong with the name, or that there are too many clients.
    pub(crate) fn named(&self, name: &str) -> Result<Arc<Client>, String> {
        if !NAME.contains(&name.len()) {
            let (least, most) = (NAME.start(), NAME.end());
            return Err(format!(
                "a client's name is a secret of {least} to {most} bytes"
            ));
        }
        let mut clients = locked(&self.0);
        if let Some(client) = clients.get(name) {
            return Ok(Arc::clone(client));
        }
        if clients.len() >= CLIENTS {
            let gone = clients
                .iter()
                .filter_map(|(name, client)| Some((client.left_ms()?, name)));
            let oldest = gone.min().map(|(_, name)| name.clone());
            let oldest =
                oldest.ok_or_else(|| format!("{CLIENTS} clients have named themselves"))?;
            clients.remove(&oldest);
        }
        let client = Arc::new(Client::default());
        clients.insert(name.to_owned(), Arc::clone(&client));
        Ok(client)
    }
}

/// A client's goals, and its present socket.
#[derive(Default)]
pub(crate) struct Client(Mutex<State>);

#[derive(Default)]
struct State {
    out: Option<mpsc::Sender<Out>>,
    open: BTreeMap<String, (Arc<Goal>, String)>,
    ended: VecDeque<Ended>,
    /// Goals that the console refused. Apart, because they keep no id from being sent again.
    refused: VecDeque<Ended>,
    left_ms: u64,
}

struct Ended {
    id: String,
    action: String,
    outcome: Outcome,
}

impl Client {
    /// The client speaks over this socket from now on. Returns its goals.
    pub(crate) fn attach(&self, out: mpsc::Sender<Out>) -> Value {
        let mut state = locked(&self.0);
        state.out = Some(out);
        let open = state.open.iter().map(|(id, (goal, action))| {
            goal.set_left(false);
            let task = goal.id();
            json!({ "id": id, "action": action, "values": { "state": "OPEN", "text": "", "id": task } })
        });
        let ended = state.ended.iter().chain(&state.refused);
        let ended =
            ended.map(|of| json!({ "id": of.id, "action": of.action, "values": of.outcome }));
        json!({ "goals": open.chain(ended).collect::<Vec<_>>() })
    }

    /// Adds a goal.
    ///
    /// # Errors
    /// Why it must not be started; above all if it was sent before.
    pub(crate) fn begin(&self, id: &str, action: &str, goal: &Arc<Goal>) -> Result<(), String> {
        let mut state = locked(&self.0);
        if state.open.contains_key(id) || state.ended.iter().any(|ended| ended.id == id) {
            return Err(format!(
                "the goal with the id '{id}' was sent before: it was not sent again"
            ));
        }
        if state.open.len() >= GOALS {
            return Err(format!(
                "{GOALS} goals of this client are open: wait for one to end"
            ));
        }
        state.refused.retain(|refused| refused.id != id);
        state
            .open
            .insert(id.to_owned(), (Arc::clone(goal), action.to_owned()));
        Ok(())
    }

    /// Remembers that a goal was refused, in case that the answer is lost.
    pub(crate) fn refuse(&self, id: &str, action: &str, why: &str) {
        let mut state = locked(&self.0);
        let is_known =
            state.open.contains_key(id) || state.ended.iter().any(|ended| ended.id == id);
        if is_known || id.len() > ID {
            return;
        }
        if state.refused.len() >= REFUSED {
            state.refused.pop_front();
        }
        state.refused.push_back(Ended {
            id: id.to_owned(),
            action: cut::text(action, cut::LINE),
            outcome: Outcome::not_started(cut::text(why, cut::PROGRESS)),
        });
    }

    /// Forgets a goal that was not started.
    pub(crate) fn forget(&self, id: &str) {
        locked(&self.0).open.remove(id);
    }

    /// The open goal with this id.
    pub(crate) fn goal(&self, id: &str) -> Option<Arc<Goal>> {
        let state = locked(&self.0);
        state.open.get(id).map(|(goal, _)| Arc::clone(goal))
    }

    /// Tells the progress of a goal. A client that does not keep up misses it.
    pub(crate) fn progress(&self, id: &str, action: &str, text: &str) {
        let out = locked(&self.0).out.clone();
        if let Some(out) = out {
            let _ = out.try_send(Out::Text(rosbridge::action_feedback(id, action, text)));
        }
    }

    /// Tells the outcome of a goal, and remembers it. Waits for a slow client.
    pub(crate) fn end(&self, id: &str, outcome: &Outcome) {
        let mut state = locked(&self.0);
        let Some((_, action)) = state.open.remove(id) else {
            return;
        };
        let text = rosbridge::action_result(id, &action, outcome);
        if state.ended.len() >= ENDED {
            state.ended.pop_front();
        }
        state.ended.push_back(Ended {
            id: id.to_owned(),
            action,
            outcome: Outcome {
                text: cut::text(&outcome.text, cut::PROGRESS),
                ..outcome.clone()
            },
        });
        let out = state.out.clone();
        drop(state);
        if let Some(out) = out {
            // Fails if the client is gone.
            let _ = out.blocking_send(Out::Text(text));
        }
    }

    /// A socket is gone. Returns the open goals, unless the client has another socket by now.
    pub(crate) fn leave(&self, out: &mpsc::Sender<Out>) -> Vec<Arc<Goal>> {
        let mut state = locked(&self.0);
        if !state.out.as_ref().is_some_and(|now| now.same_channel(out)) {
            return Vec::new();
        }
        state.out = None;
        state.left_ms = now_ms();
        let open = state.open.values();
        open.map(|(goal, _)| {
            goal.set_left(true);
            Arc::clone(goal)
        })
        .collect()
    }

    /// Since when it has neither a socket nor open goals.
    fn left_ms(&self) -> Option<u64> {
        let state = locked(&self.0);
        (state.out.is_none() && state.open.is_empty()).then_some(state.left_ms)
    }
}
