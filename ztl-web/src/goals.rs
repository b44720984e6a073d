//! Goals of clients: each runs on a thread of its own, so that neither a cancel nor another goal waits for it.

use std::io;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, OnceLock};
use std::thread;

use serde::Serialize;
use ztl_std::{RemoteId, State, TriggerError, encoded};

use crate::board::{Board, Task};
use crate::robots::Target;
use crate::watcher::PATIENCE;

/// Most goals of all clients at a time; each has a thread.
const MOST: usize = 128;

/// A goal that was asked for.
pub(crate) struct Goal {
    pub(crate) target: Target,
    pub(crate) goal: String,
    /// Who asked for it.
    pub(crate) by: String,
    id: OnceLock<RemoteId>,
    cancelled: AtomicBool,
    /// Whether an ABORT is on its way.
    aborting: AtomicBool,
    /// Whether its client has gone.
    left: AtomicBool,
}

/// The result of a goal.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub(crate) struct Outcome {
    /// A final state, `UNKNOWN` if nobody can tell it, or `NOT_STARTED` if nothing runs.
    pub(crate) state: &'static str,
    pub(crate) text: String,
    /// The task's id; 0 without one.
    pub(crate) id: RemoteId,
}

/// What a client is told of its goal.
pub(crate) enum News {
    Progress(String),
    Ended(Outcome),
}

/// Tells the client.
pub(crate) type Tell = Box<dyn Fn(News) + Send + Sync>;

impl Goal {
    pub(crate) fn new(target: Target, goal: String, by: String) -> Arc<Self> {
        Arc::new(Self {
            target,
            goal,
            by,
            id: OnceLock::new(),
            cancelled: AtomicBool::new(false),
            aborting: AtomicBool::new(false),
            left: AtomicBool::new(false),
        })
    }

    /// The id of its task, once the server has told it.
    pub(crate) fn id(&self) -> Option<&RemoteId> {
        self.id.get()
    }

    /// Starts the goal. `tell` is called from another thread; its last news is the outcome.
    ///
    /// # Errors
    /// Why nothing was started.
    pub(crate) fn start(self: &Arc<Self>, board: &Arc<Board>, tell: Tell) -> Result<(), String> {
        let Some(number) = board.add_goal(self, MOST) else {
            return Err(format!("{MOST} goals are open: wait for one to end"));
        };
        // After the goal is known: a Stop that begins now cancels it.
        if board.is_stopping() {
            board.remove_goal(number);
            return Err("a Stop is under way: send the goal again when it has ended".to_owned());
        }
        let (goal, on) = (Arc::clone(self), Arc::clone(board));
        let spawned = thread::Builder::new()
            .name("ztl-web-goal".to_owned())
            .spawn(move || {
                let outcome = goal.run(&on, &tell);
                on.remove_goal(number);
                tell(News::Ended(outcome));
            });
        spawned.map(drop).map_err(|error| {
            board.remove_goal(number);
            format!("no thread for the goal: {error}")
        })
    }

    /// Aborts the task, or keeps it from starting. The outcome follows from the goal's own thread.
    ///
    /// # Errors
    /// If the system has no more threads.
    pub(crate) fn cancel(self: &Arc<Self>, board: &Arc<Board>) -> io::Result<()> {
        self.give_up();
        // Without an id, the goal's thread aborts as soon as it knows one.
        if self.id().is_none() || self.aborting.swap(true, Ordering::SeqCst) {
            return Ok(());
        }
        let (goal, board) = (Arc::clone(self), Arc::clone(board));
        let thread = thread::Builder::new().name("ztl-web-cancel".to_owned());
        let spawned = thread.spawn(move || goal.abort(&board)).map(drop);
        if spawned.is_err() {
            self.aborting.store(false, Ordering::SeqCst);
        }
        spawned
    }

    /// Keeps it from being sent, or lets its thread abort it when it is accepted.
    pub(crate) fn give_up(&self) {
        self.cancelled.store(true, Ordering::SeqCst);
    }

    /// Notes that its client has gone, so that its thread does not wait for a server that is gone, too.
    pub(crate) fn leave(&self) {
        self.left.store(true, Ordering::SeqCst);
    }

    fn is_cancelled(&self) -> bool {
        self.cancelled.load(Ordering::SeqCst)
    }

    fn abort(&self, board: &Board) {
        let (Some(server), Some(id)) = (board.servers.get(self.target.server), self.id()) else {
            return;
        };
        let remote = (server.connect)(&self.target.scope);
        let sent = remote.map(|remote| remote.with_timeout(PATIENCE).send_abort(id));
        match sent {
            Ok(Ok(_)) => {}
            Ok(Err(error)) => tracing::warn!("abort of task {id} not confirmed: {error}"),
            Err(error) => tracing::warn!("abort of task {id} not sent: {error}"),
        }
        self.aborting.store(false, Ordering::SeqCst);
    }

    fn run(&self, board: &Board, tell: &Tell) -> Outcome {
        let Target {
            server,
            scope,
            handler,
            component,
        } = &self.target;
        let Some(server) = board.servers.get(*server) else {
            return Outcome::not_started("no such server".to_owned());
        };
        let mut remote = match (server.connect)(scope) {
            Ok(remote) => remote,
            Err(why) => return Outcome::not_started(why),
        };
        let payload = encoded(handler, component, &self.goal);
        let id = match remote.trigger_while(&payload, || !self.is_cancelled()) {
            Ok(task) => task.id,
            Err(error) => return Outcome::of_init(error),
        };
        let id = self.id.get_or_init(|| id).clone();
        board.publish();
        if self.is_cancelled() {
            self.abort(board);
        }
        let mut told = None;
        let ended = remote.wait_with(&id, None, |answer| {
            if let Ok(status) = answer
                && !status.state.is_final()
                && told.as_ref() != Some(&status.text)
            {
                tell(News::Progress(status.text.clone()));
                told = Some(status.text.clone());
            }
            answer.is_ok() || !self.left.load(Ordering::SeqCst)
        });
        match ended {
            Ok(status) => Outcome {
                state: status.state.name(),
                text: status.text,
                id,
            },
            Err(error) => Outcome::unknown(error.to_string(), id),
        }
    }

    /// The goal as a task, for a server that lists none.
    pub(crate) fn as_task(&self, robot: &str) -> Option<Task> {
        let Target {
            scope,
            handler,
            component,
            ..
        } = &self.target;
        Some(Task {
            robot: robot.to_owned(),
            scope: scope.clone(),
            id: self.id()?.clone(),
            task: format!("{handler}:{component}:{}", self.goal),
            state: State::Accepted.name().to_owned(),
            text: String::new(),
            runs: true,
            started_ms: None,
            by: Some(self.by.clone()),
        })
    }
}

impl Outcome {
    fn not_started(text: String) -> Self {
        Self {
            state: "NOT_STARTED",
            text,
            id: RemoteId::from(0_i64),
        }
    }

    fn unknown(text: String, id: RemoteId) -> Self {
        Self {
            state: "UNKNOWN",
            text,
            id,
        }
    }

    /// What an INIT without an accepted task means.
    fn of_init(error: TriggerError) -> Self {
        match error {
            TriggerError::Rejected { id, reason } => Self {
                state: State::Rejected.name(),
                text: reason,
                id,
            },
            TriggerError::NeverCame | TriggerError::GivenUp => Self::not_started(error.to_string()),
            TriggerError::Request(error) if error.nothing_was_sent() => {
                Self::not_started(error.to_string())
            }
            TriggerError::Request(error) => Self::unknown(error.to_string(), RemoteId::from(0_i64)),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use ztl_std::RequestError;

    use super::*;

    #[test]
    fn a_lost_answer_is_unknown_and_never_failed() {
        let endpoint = || "tcp://robot:1".to_owned();
        let waited = Duration::from_secs(2);
        let lost = RequestError::NoAnswer {
            endpoint: endpoint(),
            waited,
        };
        let unsent = RequestError::NotConnected {
            endpoint: endpoint(),
            waited,
            obstacle: None,
        };
        let state = |error| Outcome::of_init(error).state;
        assert_eq!(state(TriggerError::Request(lost)), "UNKNOWN");
        assert_eq!(state(TriggerError::Request(unsent)), "NOT_STARTED");
        assert_eq!(state(TriggerError::GivenUp), "NOT_STARTED");
        assert_eq!(state(TriggerError::NeverCame), "NOT_STARTED");
    }
}
