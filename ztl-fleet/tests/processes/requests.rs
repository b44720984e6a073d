//! Requests through an endpoint, repeated where they do nothing twice.
//!
//! If a robot does not answer within 1.9 s, the endpoint does not answer either, and an INIT does not act after that. On a
//! busy machine, this happens at times.

use std::time::Duration;

use ztl_std::{RemoteTask, RequestError, Status, TaskId, TriggerError, Triggered};
use ztl_tests::lab::{PATIENCE, connect_to, until};

/// A client's timeout: an endpoint answers within it or never.
pub(crate) const TIMEOUT: Duration = Duration::from_secs(2);

/// A client of a scope of the endpoint at this port.
#[track_caller]
pub(crate) fn client(port: u16, scope: &str) -> RemoteTask {
    connect_to(&format!("tcp://127.0.0.1:{port}"), scope).with_timeout(TIMEOUT)
}

/// Sends an INIT. Repeats one that did nothing because nobody was reached in time, and asks what became of one that was not
/// answered.
#[track_caller]
pub(crate) fn trigger(
    remote: &mut RemoteTask,
    handler: &str,
    component: &str,
    goal: &str,
) -> Result<Triggered, TriggerError> {
    let mut may_run = false;
    until("an answer to an INIT", PATIENCE, || {
        let told = match may_run {
            false => remote.trigger(handler, component, goal),
            true => remote.ask_outcome().expect("its outcome can be learned"),
        };
        may_run = matches!(
            told,
            Err(TriggerError::Request(RequestError::NoAnswer { .. }))
        );
        (!may_run && !came_too_late(&told)).then_some(told)
    })
}

/// Whether an INIT did nothing because the endpoint or the robot was not reached in time.
fn came_too_late(told: &Result<Triggered, TriggerError>) -> bool {
    match told {
        Err(TriggerError::NeverCame) => true,
        Err(TriggerError::Request(error)) => matches!(error, RequestError::NotConnected { .. }),
        Err(TriggerError::Rejected { reason, .. }) => {
            let is_cut_off =
                reason.starts_with("robot '") && reason.ends_with("' is not connected");
            is_cut_off || reason.ends_with("or it came too late there; try again")
        }
        _ => false,
    }
}

/// Starts a task, which must be accepted.
#[track_caller]
pub(crate) fn start(remote: &mut RemoteTask, handler: &str, component: &str, goal: &str) -> TaskId {
    let task = trigger(remote, handler, component, goal);
    assert!(task.is_ok(), "{handler}:{component}:{goal}: {task:?}");
    task.unwrap().id.number().expect("a number")
}

/// A task's status.
#[track_caller]
pub(crate) fn status(remote: &mut RemoteTask, id: TaskId) -> Status {
    answered("its status", || remote.status(id))
}

/// Sends ABORTs until one is answered.
#[track_caller]
pub(crate) fn abort(remote: &mut RemoteTask, id: TaskId) -> Status {
    answered("an answer to an ABORT", || remote.abort(id))
}

#[track_caller]
fn answered(what: &str, mut ask: impl FnMut() -> Result<Status, RequestError>) -> Status {
    until(what, PATIENCE, || match ask() {
        Err(RequestError::NotConnected { .. } | RequestError::NoAnswer { .. }) => None,
        told => Some(told.unwrap()),
    })
}
