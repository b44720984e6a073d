//! Robots that are as slow, silent or hostile as a test needs.

use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use ztl_std::{ExecutableTask, TaskContext, TaskController, TaskError, TaskRequest};
use ztl_tests::lab::port_of;

/// A robot whose tasks run until they are aborted, and take their time to stop.
#[derive(Clone, Default)]
pub(crate) struct Slow {
    /// How long it takes to accept a task, and to stop it.
    pub(crate) accepting: Duration,
    pub(crate) stopping: Duration,
    /// How many tasks it was given, and how many of them run.
    pub(crate) given: Arc<AtomicUsize>,
    pub(crate) running: Arc<AtomicUsize>,
    /// When the tasks heard of their ABORTs.
    pub(crate) heard: Arc<Mutex<Vec<Instant>>>,
}

impl TaskController for Slow {
    fn assign(&self, _: &TaskRequest) -> Result<Box<dyn ExecutableTask>, TaskError> {
        self.given.fetch_add(1, Ordering::SeqCst);
        std::thread::sleep(self.accepting);
        let robot = self.clone();
        Ok(Box::new(move |context: &TaskContext| {
            robot.running.fetch_add(1, Ordering::SeqCst);
            let aborted = context.sleep(Duration::from_secs(600));
            robot.heard.lock().expect("no panic").push(Instant::now());
            std::thread::sleep(robot.stopping);
            robot.running.fetch_sub(1, Ordering::SeqCst);
            aborted.map(|()| String::new()).map_err(TaskError::from)
        }))
    }
}

/// A server whose answers a test chooses; it may keep silent.
pub(crate) struct Scripted {
    pub(crate) port: u16,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Scripted {
    /// One without devices.
    pub(crate) fn start(answer: impl FnMut(&str) -> Option<String> + Send + 'static) -> Self {
        Self::with_devices("{}", answer)
    }

    /// One that gives this answer to `devices`.
    pub(crate) fn with_devices(
        devices: &str,
        mut answer: impl FnMut(&str) -> Option<String> + Send + 'static,
    ) -> Self {
        let devices = format!("$ztl;5;0;{devices}");
        let socket = zmq::Context::new().socket(zmq::ROUTER).expect("a socket");
        socket.set_linger(0).expect("an option");
        socket.set_rcvtimeo(20).expect("an option");
        socket.bind("tcp://127.0.0.1:*").expect("a free port");
        let endpoint = socket.get_last_endpoint().expect("it is bound");
        let port = port_of(&endpoint.expect("UTF-8"));
        let stop = Arc::new(AtomicBool::new(false));
        let stopped = Arc::clone(&stop);
        let serve = move || {
            while !stopped.load(Ordering::Relaxed) {
                let Ok(mut frames) = socket.recv_multipart(0) else {
                    continue;
                };
                let body = String::from_utf8(frames.pop().expect("a body")).expect("UTF-8");
                let answer = match body.as_str() {
                    // Its components say nothing of themselves.
                    body if body.starts_with("$ztl;2;-1;describe") => {
                        Some(r#"$ztl;5;0;{"components": []}"#.to_owned())
                    }
                    "$ztl;2;-1;devices" => Some(devices.clone()),
                    body => answer(body),
                };
                if let Some(answer) = answer {
                    frames.push(answer.into_bytes());
                    socket.send_multipart(frames, 0).expect("a client");
                }
            }
        };
        let thread = Some(std::thread::spawn(serve));
        Self { port, stop, thread }
    }
}

impl Drop for Scripted {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // A test that panics already has its own message.
            let _ = thread.join();
        }
    }
}

/// The answer of a scripted server to `probe`, with these running tasks of `/test`.
pub(crate) fn probed(running: &[u32]) -> String {
    let running: Vec<String> = running
        .iter()
        .map(|id| format!("{id}: \"/test\""))
        .collect();
    let running = running.join(", ");
    format!(
        "$ztl;5;0;{{ztl: 1, version: '0.1.0', boot: 7, message: 1048576, \
         scopes: {{\"/test\": {{}}}}, running: {{{running}}}}}"
    )
}

/// The answer to `tasks` of a server that has told its running tasks already.
pub(crate) fn listed() -> String {
    r#"$ztl;5;0;{"tasks": [], "more": 0}"#.to_owned()
}
