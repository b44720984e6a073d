//! Our client in many threads, in the background, as a future, and with tasks that are aborted on drop.

use std::future::Future;
use std::pin::pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::{Context, Poll, Wake, Waker};
use std::thread::Thread;
use std::time::Duration;

use ztl_std::{
    ExecutableTask, RemoteTask, RunningServer, State, TaskContext, TaskController, TaskError,
    TaskRequest, TaskServer, TriggerError,
};
use ztl_tests::lab::{PATIENCE, SCOPE, connect, reserve_port, serve, until};

/// `slow` lasts until a client has seen its progress.
#[derive(Default)]
struct Robot {
    is_seen: Arc<AtomicBool>,
}

impl TaskController for Robot {
    fn assign(&self, request: &TaskRequest) -> Result<Box<dyn ExecutableTask>, TaskError> {
        let TaskRequest {
            component, goal, ..
        } = request.clone();
        let is_seen = Arc::clone(&self.is_seen);
        Ok(Box::new(move |context: &TaskContext| {
            context.progress("on the way");
            match component.as_str() {
                "wait" => context.sleep(Duration::MAX)?,
                "slow" => until("a client sees the progress", PATIENCE, || {
                    is_seen.load(Ordering::SeqCst).then_some(())
                }),
                _ => {}
            }
            Ok(goal)
        }))
    }
}

fn robot() -> (RunningServer, RemoteTask) {
    serve_robot(Robot::default())
}

fn serve_robot(robot: Robot) -> (RunningServer, RemoteTask) {
    let server = serve(robot);
    let remote = connect(server.endpoint());
    (server, remote)
}

/// The tasks of a server that have not ended.
fn running(remote: &mut RemoteTask) -> usize {
    let told = remote.ask_server("tasks").expect("an answer");
    let told = told.expect("it knows the question");
    let told: serde_json::Value = serde_json::from_str(&told).expect("JSON");
    let tasks = told["tasks"].as_array().expect("a list");
    tasks
        .iter()
        .filter(|task| task["ended_ms"].is_null())
        .count()
}

#[test]
fn many_threads_use_clones_concurrently() {
    let (_server, remote) = robot();
    let threads: Vec<_> = (0..8)
        .map(|thread| {
            let mut remote = remote.clone();
            std::thread::spawn(move || {
                for round in 0..20 {
                    let goal = format!("{thread}.{round}");
                    let end = remote.run("h", "echo", &goal, Some(PATIENCE));
                    let end = end.expect("its end");
                    assert_eq!((end.state, end.text), (State::Completed, goal));
                }
            })
        })
        .collect();
    for thread in threads {
        thread.join().expect("no panic");
    }
}

#[test]
fn abort_on_drop_aborts_its_task_unless_released() {
    let (_server, mut remote) = robot();
    let one = remote.trigger("h", "wait", "g").expect("taken").id;
    let two = remote.trigger("h", "wait", "g").expect("taken").id;
    let guards = [&one, &two].map(|id| remote.abort_on_drop(id));
    assert_eq!(running(&mut remote), 2);
    let [guard, other] = guards;
    drop(guard);
    other.release();
    // A busy machine may answer the ABORT before the end.
    until("it is aborted", PATIENCE, || {
        let state = remote.status(&one).expect("told").state;
        (state == State::Aborted).then_some(())
    });
    assert_eq!(remote.status(two).expect("told").state, State::Accepted);
}

/// The smallest runtime: one future, on this thread.
fn block_on<F: Future>(future: F) -> F::Output {
    struct Unpark(Thread);
    impl Wake for Unpark {
        fn wake(self: Arc<Self>) {
            self.0.unpark();
        }
    }
    let mut future = pin!(future);
    let waker = Waker::from(Arc::new(Unpark(std::thread::current())));
    loop {
        match future.as_mut().poll(&mut Context::from_waker(&waker)) {
            Poll::Ready(output) => return output,
            Poll::Pending => std::thread::park(),
        }
    }
}

#[test]
fn tasks_run_in_the_background_and_report_progress() {
    let robot = Robot::default();
    let is_seen = Arc::clone(&robot.is_seen);
    let (_server, remote) = serve_robot(robot);
    let note = Arc::clone(&is_seen);
    let one = remote.start("h", "slow", "1", None, move |answer| {
        let status = answer.as_ref();
        let is_progress = status.is_ok_and(|status| status.text == "on the way");
        note.fetch_or(is_progress, Ordering::SeqCst);
    });
    let two = remote.start("h", "slow", "2", None, |_| {});
    let (one, two) = block_on(async { (one.await, two.await) });
    for (outcome, goal) in [(one, "1"), (two, "2")] {
        let end = outcome.expect("its end");
        assert_eq!((end.state, end.text.as_str()), (State::Completed, goal));
    }
    assert!(is_seen.load(Ordering::SeqCst));
    let end = remote
        .start("h", "echo", "3", Some(PATIENCE), |_| {})
        .wait();
    assert_eq!(end.expect("its end").text, "3");
}

#[test]
fn dropping_the_future_aborts_its_task() {
    let (_server, mut remote) = robot();
    let task = remote.start("h", "wait", "g", None, |_| {});
    until("it runs", PATIENCE, || {
        (running(&mut remote) == 1).then_some(())
    });
    drop(task);
    until("it is aborted", PATIENCE, || {
        (running(&mut remote) == 0).then_some(())
    });
}

#[test]
fn a_client_connects_to_a_server_that_starts_late() {
    let port = reserve_port();
    let endpoint = format!("tcp://127.0.0.1:{port}");
    let remote = connect(&endpoint);
    let mut remote = remote.with_timeout(Duration::from_millis(300));
    for _ in 0..3 {
        let error = remote
            .trigger("h", "echo", "g")
            .expect_err("nobody is there");
        let error = error.to_string();
        assert!(error.contains("nothing was sent"), "{error}");
    }
    let mut server = TaskServer::bind(&endpoint).expect("the port is free");
    server.register(SCOPE, Robot::default());
    let _server = server.spawn().expect("a thread");
    let task = until("it is met", PATIENCE, || {
        match remote.trigger("h", "echo", "late") {
            Ok(task) => Some(task),
            Err(TriggerError::Request(_) | TriggerError::NeverCame) => None,
            Err(error) => panic!("{error}"),
        }
    });
    let end = remote.wait(task.id, Some(PATIENCE)).expect("its end");
    assert_eq!(end.text, "late");
}
