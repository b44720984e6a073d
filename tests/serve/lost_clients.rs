//! A task whose client is gone: the owner of the task chooses whether it continues.

use std::time::Duration;

use ztl_std::{ExecutableTask, State, TaskContext, TaskController, TaskError, TaskId, TaskRequest};
use ztl_tests::lab::{
    ACCEPTED, OriginalClient, PATIENCE, Process, SCOPE, connect, our_client_at, port_of, serve,
    start, until,
};

/// How long a client may be silent here. A busy machine may hold up a live one for seconds.
const SILENCE: Duration = Duration::from_secs(6);

/// Runs until it is aborted; the component decides whether it continues without its client.
struct Drive {
    needs_client: bool,
}

impl ExecutableTask for Drive {
    fn execute(self: Box<Self>, context: &TaskContext) -> Result<String, TaskError> {
        context.sleep(Duration::MAX)?;
        Ok(String::new())
    }

    fn needs_client(&self) -> Option<Duration> {
        self.needs_client.then_some(SILENCE)
    }
}

struct Base;

impl TaskController for Base {
    fn assign(&self, request: &TaskRequest) -> Result<Box<dyn ExecutableTask>, TaskError> {
        Ok(Box::new(Drive {
            needs_client: request.component == "needs",
        }))
    }
}

/// `ztl task-client`, which waits for this task; and the task's id.
#[track_caller]
fn client(port: u16, component: &str) -> (Process, TaskId) {
    let client = Process::start(our_client_at(port).arg(format!("base:{component}:x")));
    let line = client.wait_for("Initialised task with ID");
    let id = line.split('\'').nth(1).and_then(|id| id.parse().ok());
    (client, id.and_then(TaskId::new).expect("an id"))
}

#[test]
fn a_task_tied_to_its_client_is_aborted_when_that_is_killed() {
    let server = serve(Base);
    let port = port_of(server.endpoint());
    let (mut killed, one) = client(port, "needs");
    let (stopped, two) = client(port, "needs");
    let (mut careless, three) = client(port, "carries-on");
    let (_alive, four) = client(port, "needs");
    let mut original = OriginalClient::connect(port, SCOPE);
    let five = original.trigger("base", "needs", "x").number;

    let mut witness = connect(server.endpoint());
    let mut state = |id| witness.status(id).expect("an answer").state;
    // Each client sends requests, so its task continues while it is alive.
    std::thread::sleep(SILENCE * 2);
    for id in [one, two, three, four] {
        assert_eq!(state(id), State::Accepted);
    }
    killed.kill();
    stopped.signal("STOP");
    careless.kill();
    for id in [one, two] {
        until("the task of a client that is gone", PATIENCE, || {
            (state(id) == State::Aborted).then_some(())
        });
    }
    // As if it had been killed before its first question.
    let mut silent = connect(server.endpoint());
    let six = start(&mut silent, "base", "needs", "x");
    assert_eq!(state(six), State::Accepted);
    until("the task of a client that never asks", PATIENCE, || {
        (state(six) == State::Aborted).then_some(())
    });
    for id in [three, four] {
        assert_eq!(state(id), State::Accepted);
    }
    assert_eq!(original.status(five).number, ACCEPTED);
}
