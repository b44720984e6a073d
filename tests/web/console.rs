//! A console and its robots.

use std::fs;
use std::process::Command;

use ztl_tests::lab::{
    PATIENCE, Process, SCOPE, Scratch, Server, node_packages, reserve_port, until, ztl,
};

/// A robot whose tasks can be aborted: `test:echo`, `test:sleep`, and `test:mark`, which leaves a mark for each start.
pub(crate) const ROBOT: &str = "\
scopes:
  /test:
    test:
      echo: echo
      sleep: sleep
      mark: {shell: 'echo started >> marks; echo begun; exec sleep 60', progress: '', at-once: 20}
";

/// A robot whose components say what they take. Each completes with its goal.
pub(crate) const DESCRIBED: &str = "\
scopes:
  /test:
    test:
      turn: {built-in: echo, goal: {type: number, least: -90, most: 90, step: 5, unit: deg}, about: turns the head, examples: [45], usually: 2 s}
      count: {built-in: echo, goal: {type: whole, least: 1, most: 123456789012}}
      say: {built-in: echo, goal: {type: text, longest: 5}}
      side: {built-in: echo, goal: {one-of: [left, straight on, right]}}
      light: {built-in: echo, goal: truth}
      home: {built-in: echo, goal: nothing}
      way: {built-in: echo, goal: {list-of: {type: number, most: 10}}}
      grasp: {built-in: echo, goal: {fields: {force: {type: number, least: 0, most: 40, unit: N}, hand: {one-of: [left, right]}, words: {type: text, default: ok}}}}
      free: echo
";

/// A console for the robot `ours`, and for `gone`, which nobody serves.
pub(crate) struct Console {
    pub(crate) files: Scratch,
    pub(crate) robot: Server,
    pub(crate) process: Process,
    pub(crate) url: String,
    port: u16,
    gone: u16,
}

/// Serves this configuration in a directory.
pub(crate) fn robot(files: &Scratch, configuration: &str, port: u16) -> Server {
    fs::write(files.path("robot.yaml"), configuration).expect("a file");
    let mut command = ztl();
    command.current_dir(files.path(""));
    command.args(["serve", "robot.yaml", "-p", &port.to_string()]);
    let process = Process::start(&mut command);
    process.wait_for("Serving");
    Server { process, port }
}

/// A console for these robots at a port.
pub(crate) fn web(port: u16, robots: &[(&str, u16)], options: &[&str]) -> (Process, String) {
    let mut command = ztl();
    command.args(["web", "-c", "/dev/null", "-p", &port.to_string()]);
    for (name, port) in robots {
        command.args(["--task", name, "127.0.0.1", &port.to_string(), SCOPE]);
    }
    let process = Process::start(command.args(options));
    let line = process.wait_for("://");
    let link = line.split(' ').next_back().expect("a link").trim();
    let url = link.to_owned();
    (process, url)
}

/// The files of a certificate for localhost and its key, `NAME-certificate.pem` and `NAME.pem`.
pub(crate) fn certificate_and_key(files: &Scratch, name: &str) -> (String, String) {
    let certificate = files.path(format!("{name}-certificate.pem"));
    let key = files.path(format!("{name}.pem"));
    let mut openssl = Command::new("openssl");
    let words = "req -x509 -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes -days 2 -subj /CN=localhost";
    openssl.args(words.split(' '));
    openssl
        .arg("-keyout")
        .arg(&key)
        .arg("-out")
        .arg(&certificate);
    let made = openssl
        .output()
        .expect("openssl, of the Debian package of that name");
    assert!(made.status.success(), "{made:?}");
    (certificate.display().to_string(), key.display().to_string())
}

impl Console {
    pub(crate) fn new() -> Self {
        let files = Scratch::new();
        let [port, gone, at] = [(); 3].map(|()| reserve_port());
        let robot = robot(&files, ROBOT, at);
        let (process, url) = web(port, &[("ours", at), ("gone", gone)], &[]);
        Self {
            files,
            robot,
            process,
            url,
            port,
            gone,
        }
    }

    /// The console for one robot.
    pub(crate) fn of_one() -> Self {
        Self::of(ROBOT)
    }

    /// The console for one robot with this configuration.
    pub(crate) fn of(configuration: &str) -> Self {
        let files = Scratch::new();
        let robot = robot(&files, configuration, reserve_port());
        let [port, gone] = [(); 2].map(|()| reserve_port());
        let (process, url) = web(port, &[("ours", robot.port)], &[]);
        Self {
            files,
            robot,
            process,
            url,
            port,
            gone,
        }
    }

    pub(crate) fn start_again(&mut self) {
        let robots = [("ours", self.robot.port), ("gone", self.gone)];
        self.process = web(self.port, &robots, &[]).0;
    }

    pub(crate) fn start_robot_again(&mut self) {
        self.robot = robot(&self.files, ROBOT, self.robot.port);
    }

    /// Checks how often `test:mark` was started.
    #[track_caller]
    pub(crate) fn has_marks(&self, expected: usize) {
        has_marks(&self.files, expected);
    }

    /// The address of its socket.
    pub(crate) fn socket(&self) -> String {
        format!("{}rosbridge", self.url.replace("http", "ws"))
    }
}

/// The port in a console's link.
#[track_caller]
pub(crate) fn port(url: &str) -> u16 {
    let digits = from_port(url);
    let digits = digits.trim_matches(|c: char| !c.is_ascii_digit());
    digits.parse().expect("a number")
}

/// Checks how often the `test:mark` of a robot was started. A task that runs may not have left its mark yet.
#[track_caller]
pub(crate) fn has_marks(files: &Scratch, expected: usize) {
    let marks = until("the marks", PATIENCE, || {
        let marks = fs::read_to_string(files.path("marks"));
        let marks = marks.unwrap_or_default().lines().count();
        (marks >= expected).then_some(marks)
    });
    assert_eq!(marks, expected);
}

/// The part of a printed link from its port on.
pub(crate) fn from_port(line: &str) -> String {
    let (_, link) = line.split_once("://").expect("a link");
    let (_, rest) = link.trim().split_once(':').expect("a port");
    format!(":{rest}")
}

/// Node with the installed packages.
pub(crate) fn node(script: &str) -> Command {
    let mut command = Command::new("node");
    let path = format!("{}/web/{script}", env!("CARGO_MANIFEST_DIR"));
    command
        .arg(path)
        .env("ZTL_CLIENTS", node_packages("roslib"));
    command
}

/// Starts a scenario of `driver.mjs`.
pub(crate) fn drive(scenario: &str, url: &str, console: &Console) -> Process {
    let directory = console.files.path("");
    let mut command = node("driver.mjs");
    Process::start(command.args([scenario, url]).arg(directory))
}

/// Plays a scenario to its end.
#[track_caller]
pub(crate) fn passes(scenario: &str, url: &str, console: &Console) {
    let ended = drive(scenario, url, console).end(PATIENCE * 3);
    assert!(ended.stdout.contains("passed"), "{ended:?}");
}
