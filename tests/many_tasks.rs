//! A great many tasks through one server: nothing is lost, and what it remembers is bounded.
//!
//! `cargo xtask soak` runs it with a million tasks; the figure is printed.

use std::time::{Duration, Instant};

use ztl_std::{RemoteTask, State};
use ztl_tests::lab::{PATIENCE, SCOPE, Server};

/// Clients side by side.
const CLIENTS: u32 = 8;
/// As many tasks as a server remembers: until then it grows.
const REMEMBERED: u32 = 10_000;

/// It is looked so many times what the server has in memory.
const PARTS: u32 = 10;

fn number(name: &str, usual: u32) -> u32 {
    let given = std::env::var(name).ok();
    given.map_or(usual, |text| text.parse().expect("a whole number"))
}

/// What a process has in memory, in KiB.
fn resident(server: &Server) -> u64 {
    let path = format!("/proc/{}/status", server.process.id());
    let status = std::fs::read_to_string(path).expect("its status");
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"));
    let kib = line.and_then(|line| line.split_whitespace().next());
    kib.and_then(|kib| kib.parse().ok()).expect("a number")
}

/// Runs so many tasks, shared by all clients, each of which has to complete with its own goal.
fn run(server: &Server, tasks: u32) {
    let remote = RemoteTask::connect(&server.endpoint(), SCOPE).expect("an address");
    let threads: Vec<_> = (0..CLIENTS)
        .map(|client| {
            let mut remote = remote.clone();
            std::thread::spawn(move || {
                for round in 0..tasks.div_ceil(CLIENTS) {
                    let goal = format!("{client}.{round}");
                    let end = remote.run("test", "echo", &goal, Some(PATIENCE));
                    let end = end.expect("taken").expect("its end");
                    assert_eq!((end.state, end.text), (State::Completed, goal));
                }
            })
        })
        .collect();
    for thread in threads {
        thread.join().expect("every task completes");
    }
}

#[cfg(target_os = "linux")]
#[test]
fn a_server_stays_as_large_as_it_was_when_its_memory_was_full() {
    let tasks = number("ZTL_MANY_TASKS", 5_000);
    let server = Server::ours();
    let at_start = resident(&server);
    run(&server, REMEMBERED.min(tasks));
    let full = resident(&server);
    let start = Instant::now();
    let parts: Vec<u64> = (0..PARTS)
        .map(|_| {
            run(&server, tasks.div_ceil(PARTS));
            resident(&server)
        })
        .collect();
    let (took, end) = (start.elapsed(), parts.last().copied().unwrap_or(full));
    println!(
        "{tasks} tasks by {CLIENTS} clients in {took:.1?} ({:.0} a second); resident {at_start} KiB at the start, {full} with {} tasks, then {parts:?}",
        f64::from(tasks) / took.as_secs_f64(),
        REMEMBERED.min(tasks),
    );
    // Threads come and go, and the allocator keeps some room; a task takes 0.4 KiB or more.
    let room = 4 << 10;
    if tasks >= REMEMBERED {
        assert!(end < full + room, "{full} KiB became {end}");
    }
    assert!(took < Duration::from_secs(3600));
}

/// More at once than the limit: all that were taken end, the others are refused with the reason.
#[test]
fn tasks_at_once_beyond_the_limit_are_refused_and_none_is_lost() {
    use std::sync::{Arc, Condvar, Mutex};
    use ztl_std::{
        Access, ExecutableTask, Limits, TaskContext, TaskController, TaskError, TaskRequest,
        TaskServer, TriggerError,
    };

    type Door = Arc<(Mutex<bool>, Condvar)>;
    struct Gate(Door);
    impl TaskController for Gate {
        fn assign(&self, request: &TaskRequest) -> Result<Box<dyn ExecutableTask>, TaskError> {
            let (door, goal) = (Arc::clone(&self.0), request.goal.clone());
            Ok(Box::new(move |_: &TaskContext| {
                let open = door.0.lock().expect("no panic");
                drop(door.1.wait_while(open, |open| !*open));
                Ok(goal)
            }))
        }
    }

    let most = 200;
    let mut limits = Limits::default();
    limits.running = most;
    let door = Door::default();
    let server = TaskServer::bind_with("tcp://127.0.0.1:*", Access::everybody(), limits);
    let mut server = server.expect("a port");
    server.register(SCOPE, Gate(Arc::clone(&door)));
    let server = server.spawn().expect("a thread");
    let remote = RemoteTask::connect(server.endpoint(), SCOPE).expect("an address");
    let threads: Vec<_> = (0..CLIENTS)
        .map(|client| {
            let mut remote = remote.clone();
            std::thread::spawn(move || {
                let ask = |round| {
                    let goal = format!("{client}.{round}");
                    match remote.trigger("h", "c", &goal) {
                        Ok(task) => Some((task.id, goal)),
                        Err(TriggerError::Refused { reason, .. }) => {
                            let expected = "too many tasks are running, wait for one to end";
                            assert_eq!(reason, expected);
                            None
                        }
                        Err(error) => panic!("{error}"),
                    }
                };
                (0..most / 4).filter_map(ask).collect::<Vec<_>>()
            })
        })
        .collect();
    let taken: Vec<_> = threads
        .into_iter()
        .flat_map(|thread| thread.join().expect("no panic"))
        .collect();
    assert_eq!(taken.len(), most);
    *door.0.lock().expect("no panic") = true;
    door.1.notify_all();
    let mut remote = remote;
    for (id, goal) in taken {
        let end = remote.wait(id, Some(PATIENCE)).expect("its end");
        assert_eq!((end.state, end.text), (State::Completed, goal));
    }
}
