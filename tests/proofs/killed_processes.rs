//! Servers and clients are stopped, killed and restarted at each point of a task: no task runs twice, and no outcome is
//! invented.

use std::process::Command;
use std::time::{Duration, Instant};

use ztl_std::{RemoteTask, RequestError, RunError, State, TriggerError, WaitError};
use ztl_tests::lab::{PATIENCE, Process, SCOPE, Server, our_client, reserve_port, until, ztl};

/// When the fault occurs, in microseconds after the client's start: from before its INIT arrives until after the
/// task has ended.
const POINTS: [u64; 10] = [0, 50, 100, 200, 300, 450, 700, 1000, 1500, 5000];

/// `ztl task-server` at this port; a killed one may hold the port for a moment.
#[track_caller]
fn serve(port: u16) -> Process {
    until("the port", PATIENCE, || {
        let mut command: Command = ztl();
        command.args(["task-server", "-p", &port.to_string(), "-s", SCOPE]);
        let server = Process::start(&mut command);
        let said = server.wait_for_unless_taken("Registering controller");
        said.map(|_| server)
    })
}

/// How often a server has run the task with this goal: it prints the goal.
fn done(server: &Process, goal: &str) -> usize {
    let line = format!("goal: {goal}");
    server
        .stdout()
        .lines()
        .filter(|said| **said == line)
        .count()
}

fn wait_until(moment: Instant) {
    // The point itself is what is tried, so there is no condition to wait for.
    std::thread::sleep(moment.saturating_duration_since(Instant::now()));
}

/// Runs a task that prints its goal, with `fault` at this moment.
fn run(port: u16, goal: &str, point: u64, fault: impl FnOnce()) -> Result<State, RunError> {
    let remote = RemoteTask::connect(&format!("tcp://127.0.0.1:{port}"), SCOPE);
    let mut remote = remote.expect("an address").with_timeout(PATIENCE);
    // The client connects first, so the moment falls within the task.
    let before = remote.run("test", "echo", "hi", Some(PATIENCE));
    before.expect("its end");
    let mut remote = remote.with_timeout(Duration::from_millis(500));
    let goal = goal.to_owned();
    let start = Instant::now();
    let client = std::thread::spawn(move || {
        let outcome = remote.run("test", "print", &goal, Some(Duration::from_secs(3)));
        outcome.map(|status| status.state)
    });
    wait_until(start + Duration::from_micros(point));
    fault();
    client.join().expect("no panic")
}

#[test]
fn a_suspended_server_runs_each_task_once() {
    let port = reserve_port();
    let server = serve(port);
    // A running shell reacts faster than a program that has to start.
    let mut shell = Process::start(&mut Command::new("sh"));
    let mut outcomes = Vec::new();
    for point in POINTS {
        let goal = format!("stopped at {point}");
        let outcome = run(port, &goal, point, || {
            shell.write_line(&format!("kill -STOP {}", server.id()));
            std::thread::sleep(Duration::from_millis(700));
            server.signal("CONT");
        });
        println!(
            "stopped after {point} µs: {outcome:?}, done {}",
            done(&server, &goal)
        );
        match outcome {
            Ok(State::Completed) => until("its line", PATIENCE, || {
                (done(&server, &goal) > 0).then_some(())
            }),
            // Either the outcome is unknown, or the INIT is known not to have arrived.
            Err(
                RunError::NotEnded(WaitError { last: Err(_) })
                | RunError::NotStarted(TriggerError::Request(_) | TriggerError::NeverCame),
            ) => {}
            other => panic!("{point}: {other:?}"),
        }
        outcomes.push((goal, outcome));
    }
    // Every request in flight has been accepted by now.
    let last = run(port, "last", 0, || {});
    assert_eq!(last, Ok(State::Completed));
    until("its line", PATIENCE, || {
        (done(&server, "last") > 0).then_some(())
    });
    for (goal, outcome) in outcomes {
        let most = usize::from(outcome != Err(RunError::NotStarted(TriggerError::NeverCame)));
        assert!(done(&server, &goal) <= most, "{goal}: {outcome:?}");
    }
}

#[test]
fn a_killed_and_restarted_server_repeats_no_task_and_invents_no_outcome() {
    for point in POINTS {
        let port = reserve_port();
        let mut server = serve(port);
        let mut next = None;
        let goal = format!("killed at {point}");
        let outcome = run(port, &goal, point, || {
            server.kill();
            next = Some(serve(port));
        });
        let mut next = next.expect("it was started");
        next.kill();
        let line = format!("goal: {goal}");
        // An unsent INIT goes to the next server, which then runs it once.
        let [first, second] = [server, next].map(|server| {
            let said = server.end(PATIENCE).stdout;
            said.lines().filter(|said| **said == line).count()
        });
        println!("killed after {point} µs: {outcome:?}, done {first} and {second}");
        let count = first + second;
        match outcome {
            Ok(State::Completed) => assert_eq!(count, 1, "{point}"),
            Err(RunError::NotStarted(TriggerError::NeverCame)) => assert_eq!(count, 0, "{point}"),
            Err(
                RunError::NotEnded(WaitError { last: Err(_) })
                | RunError::NotStarted(TriggerError::Request(_)),
            ) => {
                assert!(count <= 1, "{point}: {count}");
            }
            other => panic!("{point}: {other:?}"),
        }
    }
}

#[test]
fn a_task_running_when_its_server_is_killed_has_an_unknown_outcome() {
    let port = reserve_port();
    let mut server = serve(port);
    let endpoint = format!("tcp://127.0.0.1:{port}");
    let remote = RemoteTask::connect(&endpoint, SCOPE).expect("an address");
    let mut remote = remote.with_timeout(PATIENCE);
    let task = remote.trigger("test", "sleep", "60").expect("taken");
    server.kill();
    let _next = serve(port);
    // A STATUS that the killed server took is repeated.
    let mut remote = remote.with_timeout(Duration::from_secs(2));
    let error = remote
        .wait(&task.id, Some(PATIENCE))
        .expect_err("nobody knows");
    let text = format!("Invalid ID '{}'", task.id);
    let unknown = RequestError::UnknownTask { id: task.id, text };
    assert_eq!(error.last, Err(unknown));
}

#[test]
fn a_client_killed_or_stopped_anywhere_runs_its_task_at_most_once() {
    let server = Server::ours();
    for point in POINTS {
        let goal = format!("client killed at {point}");
        let client =
            |goal: &str| server.start_client(our_client(), &[&format!("test:print:{goal}")]);
        // Starting the program takes some milliseconds more.
        let mut killed = client(&goal);
        wait_until(Instant::now() + Duration::from_micros(point * 4));
        killed.kill();
        let told = killed.stdout().contains("'COMPLETED'");

        let stopped_goal = format!("client stopped at {point}");
        let stopped = client(&stopped_goal);
        wait_until(Instant::now() + Duration::from_micros(point * 4));
        stopped.signal("STOP");
        stopped.signal("CONT");
        let ended = stopped.end(PATIENCE);
        assert!(ended.stdout.contains("'COMPLETED'"), "{point}: {ended:?}");
        until("its line", PATIENCE, || {
            (done(&server.process, &stopped_goal) == 1).then_some(())
        });
        let count = done(&server.process, &goal);
        assert!(
            count == 1 || (count == 0 && !told),
            "{point}: {count}, told {told}"
        );
    }
}
