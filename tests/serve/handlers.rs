//! Controllers that panic, block, hang or ignore an abort do not keep other clients waiting.

use std::time::{Duration, Instant};

use ztl_std::{
    ExecutableTask, RemoteTask, RunningServer, State, TaskContext, TaskController, TaskError,
    TaskId, TaskRequest, TriggerError,
};
use ztl_tests::lab::{
    ABORTED, ACCEPTED, COMPLETED, FAILED, LIMIT, OriginalClient, PATIENCE, SCOPE, connect, in_time,
    port_of, serve, start, status, until,
};

use crate::gate::Gate;
use crate::rig::{CLIENT_LIMIT, abort_originally};

/// The component selects the fault.
struct Unruly(Gate);

impl TaskController for Unruly {
    fn assign(&self, request: &TaskRequest) -> Result<Box<dyn ExecutableTask>, TaskError> {
        let goal = request.goal.clone();
        let gate = self.0.clone();
        match request.component.as_str() {
            "panic-in-assign" => panic!("assign has {goal}"),
            "block-in-assign" => std::thread::sleep(Duration::from_secs(3)),
            "hang-in-assign" => gate.wait(),
            _ => {}
        }
        let component = request.component.clone();
        Ok(Box::new(move |context: &TaskContext| {
            match component.as_str() {
                "panic-in-execute" => panic!("execute has {goal}"),
                "hang" => {
                    context.progress("hanging");
                    gate.wait();
                }
                "sleep" => context.sleep(Duration::from_secs(60))?,
                _ => {}
            }
            Ok(goal)
        }))
    }
}

/// A server of faulty tasks. Its gate is opened at the end, so that no thread is left behind.
struct Rig {
    server: RunningServer,
    gate: Gate,
}

impl Rig {
    fn new() -> Self {
        let gate = Gate::default();
        let server = serve(Unruly(gate.clone()));
        Self { server, gate }
    }

    fn connect(&self) -> RemoteTask {
        connect(self.server.endpoint())
    }

    fn original_client(&self) -> OriginalClient {
        OriginalClient::connect(port_of(self.server.endpoint()), SCOPE)
    }
}

impl Drop for Rig {
    fn drop(&mut self) {
        self.gate.open();
    }
}

/// Starts a task with the original's client.
#[track_caller]
fn start_originally(client: &mut OriginalClient, component: &str, goal: &str) -> i64 {
    let answer = client.trigger("any", component, goal);
    assert!(answer.number > 0, "{component}: {answer:?}");
    answer.number
}

/// Asks about a task for this long, and returns the longest response time.
#[track_caller]
fn slowest_status(remote: &mut RemoteTask, id: TaskId, time: Duration) -> Duration {
    let start = Instant::now();
    let mut slowest = Duration::ZERO;
    while start.elapsed() < time {
        let asked = Instant::now();
        let answer = remote.status(id).expect("an answer");
        slowest = slowest.max(asked.elapsed());
        assert_eq!(answer.state, State::Accepted, "{answer:?}");
        std::thread::sleep(Duration::from_millis(5));
    }
    slowest
}

#[test]
fn a_panic_fails_only_its_own_task() {
    let rig = Rig::new();
    let mut remote = rig.connect();
    let bystander = start(&mut remote, "any", "sleep", "");
    for round in 0..3 {
        let reason = match remote.trigger("any", "panic-in-assign", &round.to_string()) {
            Err(TriggerError::Rejected { reason, .. }) => reason,
            // On a busy machine, printing the panic takes longer than a reply is held.
            taken => {
                let late = remote.wait(taken.expect("an answer").id, LIMIT);
                let late = late.expect("its end");
                assert_eq!(late.state, State::Rejected, "{late:?}");
                late.text
            }
        };
        let panicked = format!("the handler panicked: assign has {round}");
        assert!(reason.ends_with(&panicked), "{reason}");

        let id = start(&mut remote, "any", "panic-in-execute", &round.to_string());
        let reason = format!("the handler panicked: execute has {round}");
        let end = status(State::Failed, &reason);
        assert_eq!(remote.wait(id, LIMIT), Ok(end));
    }
    assert_eq!(remote.status(bystander).unwrap().state, State::Accepted);
    let id = start(&mut remote, "any", "echo", "still here");
    let end = status(State::Completed, "still here");
    assert_eq!(remote.wait(id, LIMIT), Ok(end));
    assert!(rig.server.is_running());
}

#[test]
fn an_assign_that_blocks_for_3_s_delays_no_other_client() {
    let rig = Rig::new();
    let mut remote = rig.connect();
    let bystander = start(&mut remote, "any", "sleep", "");
    let mut slowest_answers = || {
        std::thread::scope(|scope| {
            let (asked, rig) = (Instant::now(), &rig);
            let blocked = scope.spawn(move || {
                let task = rig.connect().trigger("any", "block-in-assign", "done");
                (task, asked.elapsed())
            });
            let slowest = slowest_status(&mut remote, bystander, Duration::from_secs(2));

            let (task, took) = blocked.join().unwrap();
            let task = task.expect("an id");
            assert_ne!(task.id, bystander);
            let end = status(State::Completed, "done");
            assert_eq!(remote.wait(task.id, LIMIT), Ok(end));
            assert!(asked.elapsed() > Duration::from_secs(3));
            (slowest, took)
        })
    };
    // A busy machine delays some requests, a blocked server all of them. Its own client gets a reply with an id before the
    // original's gives up.
    until("quick answers", PATIENCE, || {
        let (others, own) = slowest_answers();
        (others < Duration::from_secs(1) && own < Duration::from_secs(2)).then_some(())
    });
}

#[test]
fn the_originals_client_gets_an_id_of_an_assign_that_hangs() {
    let rig = Rig::new();
    let mut client = rig.original_client();
    // The original's client times out after 2 s and would take its task for rejected.
    let id = start_originally(&mut client, "hang-in-assign", "done");
    assert_eq!(client.status(id), (0, "None"));
    rig.gate.open();
    // The original's wait does not treat INITIATED as an end either.
    assert_eq!(client.end(id), (COMPLETED, "done"));
}

#[test]
fn status_reports_a_rejection_by_an_assign_that_hung() {
    struct Late(Gate);
    impl TaskController for Late {
        fn assign(&self, _: &TaskRequest) -> Result<Box<dyn ExecutableTask>, TaskError> {
            self.0.wait();
            Err("not today".into())
        }
    }
    let gate = Gate::default();
    let server = serve(Late(gate.clone()));
    let mut remote = connect(server.endpoint());
    let id = start(&mut remote, "any", "any", "");
    gate.open();
    let end = status(State::Rejected, "not today");
    assert_eq!(remote.wait(id, LIMIT), Ok(end));
}

#[test]
fn an_ignored_abort_is_still_answered() {
    let rig = Rig::new();
    let mut client = rig.original_client();
    let mut remote = rig.connect();
    for component in ["hang", "hang-in-assign"] {
        until("an answer before the client gives up", PATIENCE, || {
            let id = start_originally(&mut client, component, "late");
            let asked = Instant::now();
            let answer = client.abort(id);
            if asked.elapsed() >= CLIENT_LIMIT {
                return None;
            }
            assert_eq!(answer, (ACCEPTED, "aborting"), "{component}");
            assert!(asked.elapsed() > Duration::from_secs(1));
            Some(())
        });

        // Meanwhile other clients are served.
        let aborted = in_time(Duration::from_secs(1), || {
            let other = start(&mut remote, "any", "sleep", "");
            remote.abort(other)
        });
        assert_eq!(aborted.map(|end| end.state), Ok(State::Aborted));
    }
}

#[test]
fn a_task_that_completes_despite_an_abort_reports_its_true_outcome() {
    // A busy machine may answer the ABORT before the end.
    until("the answer to the ABORT tells the end", PATIENCE, || {
        let rig = Rig::new();
        let mut client = rig.original_client();
        let id = start_originally(&mut client, "hang", "done after all");
        until("its progress", PATIENCE, || {
            (client.status(id) == (ACCEPTED, "hanging")).then_some(())
        });
        let told = std::thread::scope(|scope| {
            let abort = scope.spawn(|| {
                let id = TaskId::new(u32::try_from(id).unwrap()).unwrap();
                rig.connect().abort(id)
            });
            rig.gate.open();
            abort.join().unwrap().expect("an answer")
        });
        let end = client.end(id);
        assert_eq!(end, (COMPLETED, "done after all"));
        assert_eq!(client.abort(id), (COMPLETED, "False"));
        if told == status(State::Accepted, "aborting") {
            return None;
        }
        // `False` if it ended before the ABORT arrived.
        assert_eq!(told.state, State::Completed);
        assert!(["done after all", "False"].contains(&told.text.as_str()));
        Some(())
    });
}

#[test]
fn an_abort_wakes_a_task_and_its_final_state_never_changes() {
    let rig = Rig::new();
    let mut client = rig.original_client();
    let id = abort_originally(&mut client, &mut rig.connect(), ["any", "sleep", ""]);
    for _ in 0..20 {
        assert_eq!(client.status(id), (ABORTED, "aborted"));
    }
    assert_eq!(client.abort(id), (ABORTED, "False"));
    let id = start_originally(&mut client, "panic-in-execute", "bad luck");
    let reason = "the handler panicked: execute has bad luck";
    assert_eq!(client.end(id), (FAILED, reason));
    assert_eq!(client.abort(id), (FAILED, "False"));
    assert_eq!(client.status(id), (FAILED, reason));
}
