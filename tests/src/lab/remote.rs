//! Our client and server in Rust.

use std::time::Duration;

use ztl_std::{
    RemoteTask, RequestError, RunningServer, State, Status, TaskController, TaskId, TaskServer,
    Transport, TriggerError, WaitError,
};

use super::{PATIENCE, SCOPE};

/// The limit of a wait that is not itself measured.
pub const LIMIT: Option<Duration> = Some(PATIENCE);

/// A client of [`SCOPE`] at this ZeroMQ address. It waits for each answer, which a busy machine may delay.
#[track_caller]
pub fn connect(endpoint: &str) -> RemoteTask {
    connect_to(endpoint, SCOPE)
}

/// The same, of another scope.
#[track_caller]
pub fn connect_to(endpoint: &str, scope: &str) -> RemoteTask {
    let remote = RemoteTask::connect(endpoint, scope).expect("an address");
    let remote = remote.with_timeout(PATIENCE);
    remote.with_transport(transport()).expect("a socket")
}

/// Who speaks ZMTP in this process's clients and servers; `ZTL_TRANSPORT` says the same to the command.
fn transport() -> Transport {
    let named = std::env::var("ZTL_TRANSPORT").ok();
    let named = named.and_then(|named| Transport::ALL.iter().find(|(name, _)| *name == named));
    named.map_or_else(Transport::default, |(_, transport)| *transport)
}

/// Starts a task, which must be accepted.
#[track_caller]
pub fn start(remote: &mut RemoteTask, handler: &str, component: &str, goal: &str) -> TaskId {
    let task = remote.trigger(handler, component, goal);
    let task = task.unwrap_or_else(|error| panic!("{handler}:{component}:{goal}: {error}"));
    task.id.number().expect("a number")
}

/// Runs a task to its end: its final state and text. If it is rejected, the text is the reason.
#[track_caller]
pub fn outcome(
    remote: &mut RemoteTask,
    handler: &str,
    component: &str,
    goal: &str,
) -> (State, String) {
    match remote.trigger(handler, component, goal) {
        Ok(started) => end(remote, started.id.number().expect("a number")),
        Err(TriggerError::Rejected { reason, .. }) => (State::Rejected, reason),
        Err(error) => panic!("{handler}:{component}:{goal}: {error}"),
    }
}

/// Waits for the end of a task: its final state and text. A task of unknown outcome is FAILED on the wire.
#[track_caller]
pub fn end(remote: &mut RemoteTask, task: TaskId) -> (State, String) {
    match remote.wait(task, LIMIT) {
        Ok(end) => (end.state, end.text),
        Err(WaitError {
            last: Err(RequestError::UnknownOutcome { text }),
            ..
        }) => (State::Failed, text),
        Err(error) => panic!("{error:?}"),
    }
}

/// A status to compare with.
pub fn status(state: State, text: &str) -> Status {
    Status {
        state,
        text: text.to_owned(),
    }
}

/// A server in this process with a controller for [`SCOPE`].
#[track_caller]
pub fn serve(controller: impl TaskController + 'static) -> RunningServer {
    let server = TaskServer::builder().transport(transport());
    let mut server = server.bind("tcp://127.0.0.1:*").expect("a port");
    server.register(SCOPE, controller);
    server.spawn().expect("a thread")
}

/// The port of an address such as `tcp://127.0.0.1:4242`.
#[track_caller]
pub fn port_of(endpoint: &str) -> u16 {
    let port = endpoint.rsplit(':').next();
    port.and_then(|port| port.parse().ok()).expect("a port")
}
