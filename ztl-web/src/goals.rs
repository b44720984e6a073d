//! Runs goals, each on a thread of its own, so that neither a cancel nor another goal waits for it.

use std::io;
use std::sync::Arc;
use std::thread;

use serde::Serialize;
use ztl_std::{RemoteId, State, TriggerError, encoded};

use crate::board::Board;
use crate::goal::Goal;
use crate::robots::Target;
use crate::watcher::PATIENCE;

/// Most goals of all clients at a time; each has a thread.
const MOST: usize = 128;

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

/// Starts a goal. `tell` is called from another thread; its last news is the outcome.
///
/// # Errors
/// Why nothing was started.
pub(crate) fn start(goal: &Arc<Goal>, board: &Arc<Board>, tell: Tell) -> Result<(), String> {
    let Some(number) = board.add_goal(goal, MOST) else {
        return Err(format!("{MOST} goals are open: wait for one to end"));
    };
    // After the goal is known: a Stop that begins now cancels it.
    if board.is_stopping() {
        board.remove_goal(number);
        return Err("a Stop is under way: send the goal again when it has ended".to_owned());
    }
    let (goal, on) = (Arc::clone(goal), Arc::clone(board));
    let spawned = thread::Builder::new()
        .name("ztl-web-goal".to_owned())
        .spawn(move || {
            let outcome = run(&goal, &on, &tell);
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
pub(crate) fn cancel(goal: &Arc<Goal>, board: &Arc<Board>) -> io::Result<()> {
    goal.give_up();
    // Without an id, the goal's thread aborts as soon as it knows one.
    if goal.id().is_none() || !goal.begin_abort() {
        return Ok(());
    }
    let (of, on) = (Arc::clone(goal), Arc::clone(board));
    let thread = thread::Builder::new().name("ztl-web-cancel".to_owned());
    let spawned = thread.spawn(move || {
        abort(&of, &on);
        of.end_abort();
    });
    spawned.map(drop).inspect_err(|_| goal.end_abort())
}

fn abort(goal: &Goal, board: &Board) {
    let (Some(server), Some(id)) = (board.servers.get(goal.target.server), goal.id()) else {
        return;
    };
    let remote = (server.connect)(&goal.target.scope);
    match remote.map(|remote| remote.with_timeout(PATIENCE).send_abort(id)) {
        Ok(Ok(_)) => {}
        Ok(Err(error)) => tracing::warn!("abort of task {id} not confirmed: {error}"),
        Err(error) => tracing::warn!("abort of task {id} not sent: {error}"),
    }
}

fn run(goal: &Goal, board: &Board, tell: &Tell) -> Outcome {
    let Target {
        server,
        scope,
        handler,
        component,
    } = &goal.target;
    let Some(server) = board.servers.get(*server) else {
        return Outcome::not_started("no such server".to_owned());
    };
    let mut remote = match (server.connect)(scope) {
        Ok(remote) => remote,
        Err(why) => return Outcome::not_started(why),
    };
    let payload = encoded(handler, component, &goal.goal);
    let id = match remote.trigger_while(&payload, || !goal.is_cancelled()) {
        Ok(task) => task.id,
        Err(error) => return Outcome::of_init(error),
    };
    goal.set_id(id.clone());
    board.publish();
    if goal.is_cancelled() {
        abort(goal, board);
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
        answer.is_ok() || !goal.is_left()
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
