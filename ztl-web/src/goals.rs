//! Runs goals, each on a thread of its own, so that neither a cancel nor another goal waits for it.

use std::sync::Arc;
use std::thread;
use std::time::Duration;

use ztl_std::{RemoteId, RemoteTask, RequestError, TriggerError, Triggered, encoded};

use crate::aborts::AbortRequest;
use crate::board::Board;
use crate::cut;
use crate::goal::Goal;
use crate::outcome::{GoalState, Outcome};
use crate::robots::Target;

/// Most goals of all clients at a time; each has a thread.
const MOST: usize = 128;
/// Between two questions what became of a goal.
pub(crate) const ASK_AGAIN: Duration = Duration::from_millis(200);

/// Why a goal was not sent.
pub(crate) const TOO_LATE: &str = "too late, not sent";

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
    let fits = board.check(goal);
    fits.map_err(|why| cut::text(&why, 2 * cut::LINE))?;
    let Some(number) = board.add_goal(goal, MOST) else {
        return Err(format!("{MOST} goals are open: wait for one to end"));
    };
    // After the goal is known: a Stop that begins now cancels it.
    if board.stops.are_under_way() {
        board.remove_goal(number);
        return Err("a Stop is under way: send the goal again when it has ended".to_owned());
    }
    let (goal, on) = (Arc::clone(goal), Arc::clone(board));
    let spawned = thread::Builder::new()
        .name("ztl-web-goal".to_owned())
        .spawn(move || {
            let outcome = run(&goal, &on, &tell);
            // Before it is settled: a Stop that sees that counts it.
            if outcome.state == GoalState::Unknown && goal.id().is_none() {
                on.lose_without_id(goal.target.server);
            }
            goal.settle();
            goal.end();
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
/// If too many aborts are under way.
pub(crate) fn cancel(goal: &Arc<Goal>, board: &Board) -> Result<(), String> {
    goal.give_up();
    // Without an id, the goal's thread aborts as soon as it knows one.
    match goal.id() {
        Some(id) => abort(goal, id, board),
        None => Ok(()),
    }
}

/// Aborts its task.
///
/// # Errors
/// If too many aborts are under way.
pub(crate) fn abort(goal: &Arc<Goal>, id: &RemoteId, board: &Board) -> Result<(), String> {
    let request = AbortRequest::of_goal(goal, id);
    board.abort(goal.target.server, request)
}

fn run(goal: &Arc<Goal>, board: &Board, tell: &Tell) -> Outcome {
    let Target { server, scope, .. } = &goal.target;
    let Some(server) = board.servers.get(*server) else {
        return Outcome::not_started("no such server".to_owned());
    };
    let mut remote = match server.remote(scope) {
        Ok(remote) => remote,
        Err(why) => return Outcome::not_started(why),
    };
    let id = match init(goal, &mut remote, tell) {
        Ok(task) => task.id,
        Err(TriggerError::GivenUp) if goal.is_late() => {
            return Outcome::not_started(format!("{TOO_LATE}: the robot was not reached in time"));
        }
        Err(error) => return Outcome::of_init(error),
    };
    goal.set_id(id.clone());
    board.forget_lost(goal.target.server, scope, &id);
    board.publish();
    if goal.is_cancelled()
        && let Err(why) = abort(goal, &id, board)
    {
        tracing::error!("task {id} was not aborted: {why}");
    }
    let mut told = None;
    let ended = remote.wait_with(&id, None, |answer| {
        if let Ok(status) = answer
            && !status.state.is_final()
            && told.as_ref() != Some(&status.text)
        {
            tell(News::Progress(cut::text(&status.text, cut::PROGRESS)));
            told = Some(status.text.clone());
        }
        answer.is_ok() || !goal.is_left()
    });
    match ended {
        Ok(status) => Outcome {
            state: GoalState::Task(status.state),
            text: cut::text(&status.text, cut::RESULT),
            id,
        },
        Err(error) => {
            if !matches!(error.last, Err(RequestError::UnknownTask { .. })) {
                goal.lose();
            }
            Outcome::unknown(error.to_string(), id)
        }
    }
}

/// Sends the INIT, unless it is too late or not wanted any more. If it is not answered, asks what became of it until that
/// is certain or cannot be learnt, and gives it up, so that what has started is aborted.
fn init(goal: &Goal, remote: &mut RemoteTask, tell: &Tell) -> Result<Triggered, TriggerError> {
    let Target {
        handler, component, ..
    } = &goal.target;
    let payload = encoded(handler, component, &goal.goal);
    let may_be_sent = || !goal.is_cancelled() && !goal.is_late();
    let wanted = || !goal.is_cancelled() && !goal.is_answer_late();
    let mut started = remote.trigger_before(&payload, may_be_sent, wanted);
    while let Err(TriggerError::Request(error)) = &started
        && !error.nothing_was_sent()
    {
        let why = "no answer: asking what became of it; if it has started, it is aborted";
        if !goal.is_cancelled() {
            goal.give_up();
            tell(News::Progress(why.to_owned()));
        }
        match remote.ask_outcome() {
            Some(answer) => started = answer,
            None => break,
        }
        if started.is_err() {
            thread::sleep(ASK_AGAIN);
        }
    }
    if goal.is_answer_late() {
        goal.give_up();
    }
    started
}
