//! Services in libqi, as processes, and our client.

use std::path::Path;
use std::process::Command;
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::time::Duration;

use ztl_naoqi::{Call, CallError, Client, Endpoint, Event, Limits, Options, Value};
use ztl_tests::lab::{PATIENCE, Process, installed};

/// The services that the examples use.
pub(crate) const EXAMPLES_USE: [&str; 13] = [
    "ALAnimatedSpeech",
    "ALAnimationPlayer",
    "ALAutonomousLife",
    "ALBehaviorManager",
    "ALLeds",
    "ALMemory",
    "ALMotion",
    "ALPeoplePerception",
    "ALRobotPosture",
    "ALSonar",
    "ALSpeechRecognition",
    "ALTabletService",
    "ALTextToSpeech",
];

/// A process with services, and where it listens.
pub(crate) struct Robot {
    pub(crate) process: Process,
    pub(crate) endpoint: String,
}

impl Robot {
    /// A service directory with these services, in one process.
    #[track_caller]
    pub(crate) fn start(services: &[&str]) -> Self {
        Self::start_at("tcp://127.0.0.1:0", services)
    }

    /// As [`start`](Self::start), at this endpoint.
    #[track_caller]
    pub(crate) fn start_at(endpoint: &str, services: &[&str]) -> Self {
        Self::run("directory", endpoint, services)
    }

    /// Another process with services of this directory.
    #[track_caller]
    pub(crate) fn beside(&self, services: &[&str]) -> Self {
        Self::run("process", &self.endpoint, services)
    }

    #[track_caller]
    fn run(mode: &str, endpoint: &str, services: &[&str]) -> Self {
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("naoqi/robot.py");
        let mut command = Command::new(installed("ZTL_NAOQI", "naoqi/bin/python"));
        command.arg(script).args([mode, endpoint]).args(services);
        let process = Process::start(&mut command);
        let ready = process.wait_for("ready tcp://");
        let endpoint = ready.trim().trim_start_matches("ready ").to_owned();
        Self { process, endpoint }
    }

    /// Has the process do something, and waits until that is done.
    #[track_caller]
    pub(crate) fn tell(&mut self, line: &str) {
        self.process.write_line(line);
        let command = line.split(' ').next().unwrap_or_default();
        self.line_with(&format!("done {command}"));
    }

    /// Waits for a line of its output.
    #[track_caller]
    pub(crate) fn line_with(&mut self, part: &str) -> String {
        loop {
            let line = self.process.next_line(PATIENCE);
            if line.contains(part) {
                return line;
            }
        }
    }
}

/// How this test connects.
pub(crate) fn options(endpoint: &str) -> Options {
    Options {
        directory: Endpoint::parse(endpoint).expect("an endpoint"),
        credentials: None,
        limits: Limits::default(),
    }
}

/// A client, and what it is told of the robot.
pub(crate) struct Connected {
    pub(crate) client: Client,
    pub(crate) events: Receiver<Event>,
}

impl Connected {
    /// Connects to a robot.
    #[track_caller]
    pub(crate) fn to(robot: &Robot) -> Self {
        let connected = Self::with(options(&robot.endpoint));
        connected.wait_for(|event| *event == Event::Connected);
        connected
    }

    #[track_caller]
    pub(crate) fn with(options: Options) -> Self {
        let (sender, events) = channel();
        let client = Client::start(options, move |event| drop(sender.send(event)));
        let client = client.expect("a client");
        Self { client, events }
    }

    /// Waits for an event.
    #[track_caller]
    pub(crate) fn wait_for(&self, is_it: impl Fn(&Event) -> bool) -> Event {
        wait_for(&self.events, is_it)
    }

    /// Calls a method, and waits for its result.
    pub(crate) fn call(
        &self,
        service: &str,
        method: &str,
        arguments: &str,
    ) -> Result<Value, CallError> {
        let call = Call::new(service, method, values(arguments));
        self.client.call_and_wait(call, PATIENCE)
    }

    /// Begins a call; its result comes later.
    pub(crate) fn begin(
        &self,
        service: &str,
        method: &str,
        arguments: &str,
    ) -> (ztl_naoqi::CallHandle, Receiver<Result<Value, CallError>>) {
        let (sender, result) = channel();
        let call = Call::new(service, method, values(arguments));
        let done = move |result| drop(sender.send(result));
        (self.client.call(call, PATIENCE, done), result)
    }
}

/// Waits for something that is sent.
#[track_caller]
pub(crate) fn wait_for<T: std::fmt::Debug>(events: &Receiver<T>, is_it: impl Fn(&T) -> bool) -> T {
    let mut others = Vec::new();
    loop {
        match events.recv_timeout(PATIENCE) {
            Ok(event) if is_it(&event) => return event,
            Ok(event) => others.push(event),
            Err(RecvTimeoutError::Timeout | RecvTimeoutError::Disconnected) => {
                panic!("it did not come, but: {others:?}")
            }
        }
    }
}

/// Waits for the next thing that is sent.
#[track_caller]
pub(crate) fn next<T: std::fmt::Debug>(events: &Receiver<T>) -> T {
    wait_for(events, |_| true)
}

/// Nothing is sent for some time.
#[track_caller]
pub(crate) fn nothing<T: std::fmt::Debug>(events: &Receiver<T>) {
    let sent = events.recv_timeout(Duration::from_millis(300));
    assert!(sent.is_err(), "{sent:?}");
}

/// A list of values, as a goal is written.
#[track_caller]
pub(crate) fn values(goal: &str) -> Vec<Value> {
    let mut scratch = vec![0; goal.len() * 2];
    ztl_core::goal::from_str_with(goal, &mut scratch).expect(goal)
}
