//! Handlers and lines that send without a pause do not keep others waiting.

use std::io::Write;
use std::net::TcpListener;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use ztl_std::gateway::Gateway;
use ztl_std::{
    ExecutableTask, RunError, State, TaskContext, TaskController, TaskError, TaskRequest,
    TaskServer, TriggerError,
};
use ztl_tests::lab::{LIMIT, PATIENCE, SCOPE, busy, connect, serve, until};

struct Talkative;

impl TaskController for Talkative {
    fn assign(&self, _request: &TaskRequest) -> Result<Box<dyn ExecutableTask>, TaskError> {
        let task = |context: &TaskContext| {
            while !context.is_aborted() {
                context.progress("still here");
            }
            Err(TaskError::aborted("quiet"))
        };
        Ok(Box::new(task))
    }
}

#[test]
fn a_handler_that_reports_constantly_delays_no_reply() {
    let _busy = busy();
    let server = serve(Talkative);
    let mut one = connect(server.endpoint());
    let task = one.trigger("h", "c", "g").unwrap();
    let mut other = connect(server.endpoint());
    // The original's client gives up after 2 s. A busy machine delays some answers, a defect some of every hundred.
    until("100 answers within 2 s each", PATIENCE, || {
        let answers = (0..100).map(|_| {
            let asked = Instant::now();
            let status = other.status(&task.id).unwrap();
            assert_eq!(status.state, State::Accepted);
            asked.elapsed()
        });
        (answers.max() < Some(Duration::from_secs(2))).then_some(())
    });
    one.abort(&task.id).unwrap();
    let end = one.wait(&task.id, LIMIT).unwrap();
    assert_eq!(end.state, State::Aborted);
}

/// Rejects a task of a device whose line sends this without a pause, and ends the server. Returns how long that took.
fn time_to_exit(noise: [u8; 4096]) -> Duration {
    let line = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = line.local_addr().unwrap();
    let stop = Arc::new(AtomicBool::new(false));
    let stopped = Arc::clone(&stop);
    let flood = std::thread::spawn(move || {
        let (mut stream, _) = line.accept().unwrap();
        stream
            .set_write_timeout(Some(Duration::from_millis(100)))
            .unwrap();
        // A timeout means that the gateway accepts no more for now, as expected.
        while !stopped.load(Ordering::SeqCst) {
            let _ = stream.write(&noise);
        }
    });
    let mut gateway = Gateway::new();
    gateway
        .add("noise", format!("tcp:{address}").parse().unwrap())
        .unwrap();
    let mut server = TaskServer::bind("tcp://127.0.0.1:*").unwrap();
    server.register_handler(SCOPE, gateway);
    let server = server.spawn().unwrap();
    let mut remote = connect(server.endpoint());
    let ran = remote.run("noise", "c", "g", Some(PATIENCE));
    let rejected = match &ran {
        Err(RunError::NotStarted(TriggerError::Rejected { .. })) => true,
        // On a busy machine the INIT may be answered before.
        Ok(status) => status.state == State::Rejected,
        _ => false,
    };
    assert!(rejected, "{ran:?}");
    let ended = Instant::now();
    drop(server);
    let took = ended.elapsed();
    stop.store(true, Ordering::SeqCst);
    flood.join().unwrap();
    took
}

#[test]
fn a_constantly_busy_line_gets_rejections_and_the_gateway_exits() {
    let _busy = busy();
    for noise in [[0u8; 4096], [0xa7; 4096]] {
        until("the gateway exits within 5 s", PATIENCE, || {
            (time_to_exit(noise) < Duration::from_secs(5)).then_some(())
        });
    }
}
