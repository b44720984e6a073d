//! The original: Python's `ztl` 0.3.3, unchanged, from its virtual environment.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;

use super::{PATIENCE, Process, installed};

/// The state in which a task runs, as the original's clients see it.
pub const ACCEPTED: i64 = 1;
/// Refused.
pub const REJECTED: i64 = 2;
/// Ended without reaching its goal.
pub const FAILED: i64 = 3;
/// Stopped on request.
pub const ABORTED: i64 = 4;
/// Reached its goal.
pub const COMPLETED: i64 = 5;

/// Python with the original package.
///
/// # Panics
/// When it is missing; a test against the original is never skipped silently.
#[track_caller]
pub fn python() -> PathBuf {
    installed("ZTL_PYTHON", "venv/bin/python")
}

/// Runs Python with these arguments and this standard input, and returns what it prints.
///
/// # Panics
/// When it fails.
#[track_caller]
pub fn run_python(args: &[&str], input: &str) -> String {
    let mut command = Command::new(python());
    command
        .args(args)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped());
    let mut process = command.spawn().expect("Python starts");
    let mut stdin = process.stdin.take().expect("a pipe");
    stdin.write_all(input.as_bytes()).expect("Python reads");
    drop(stdin);
    let output = process.wait_with_output().expect("Python ends");
    assert!(output.status.success(), "Python failed: {args:?}");
    String::from_utf8(output.stdout).expect("UTF-8")
}

/// One of the original's command-line tools by its installed name, such as `ztl_task_client`.
#[track_caller]
pub fn original_tool(name: &str) -> Command {
    let python = python();
    let script = python.with_file_name(name);
    assert!(script.exists(), "{} is not there", script.display());
    let mut command = Command::new(python);
    // Lines come when they are written, as on a terminal.
    command.arg("-u").arg(script);
    command
}

/// A reply to the original's client: an id or a state, and a text.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Answer {
    /// The id after `trigger`, the state after `status`, `abort` and `wait`.
    pub number: i64,
    /// The server's text.
    pub text: String,
}

impl PartialEq<(i64, &str)> for Answer {
    fn eq(&self, other: &(i64, &str)) -> bool {
        (self.number, self.text.as_str()) == *other
    }
}

/// The original's `RemoteTask` in a separate Python process, driven line by line. Texts go in
/// hexadecimal, so that they are unambiguous.
#[derive(Debug)]
pub struct OriginalClient {
    process: Process,
}

impl OriginalClient {
    /// A client of a scope at a port of this machine.
    #[track_caller]
    pub fn connect(port: u16, scope: &str) -> Self {
        let driver = Path::new(env!("CARGO_MANIFEST_DIR")).join("peers/driver.py");
        let mut command = Command::new(python());
        command.arg(driver);
        command.args(["127.0.0.1", &port.to_string(), scope]);
        Self::of(&mut command)
    }

    /// Any client that is driven in the same way.
    #[track_caller]
    pub(super) fn of(command: &mut Command) -> Self {
        let process = Process::start(command);
        process.wait_for("Remote task interface initialised at");
        Self { process }
    }

    /// `RemoteTask.trigger`: the task's id, and the server's text.
    #[track_caller]
    pub fn trigger(&mut self, handler: &str, component: &str, goal: &str) -> Answer {
        let [handler, component, goal] = [handler, component, goal].map(hex);
        self.ask(&format!("trigger {handler} {component} {goal}"), PATIENCE)
    }

    /// As [`trigger`](Self::trigger), for an accepted task: only its id.
    #[track_caller]
    pub fn start(&mut self, handler: &str, component: &str, goal: &str) -> i64 {
        let answer = self.trigger(handler, component, goal);
        assert!(
            answer.number > 0,
            "{handler}:{component}:{goal} was refused: {answer:?}"
        );
        answer.number
    }

    /// `RemoteTask.status`
    #[track_caller]
    pub fn status(&mut self, id: i64) -> Answer {
        self.ask(&format!("status {id}"), PATIENCE)
    }

    /// `RemoteTask.abort`
    #[track_caller]
    pub fn abort(&mut self, id: i64) -> Answer {
        self.ask(&format!("abort {id}"), PATIENCE)
    }

    /// Aborts a task and waits for its final state, which a busy machine may reach after the answer to the abort.
    #[track_caller]
    pub fn stop(&mut self, id: i64) -> i64 {
        self.abort(id);
        self.end(id).number
    }

    /// Waits until a task has ended, or makes no progress for a minute. On a busy machine, a board in QEMU can take
    /// minutes for what takes seconds elsewhere.
    #[track_caller]
    pub fn end(&mut self, id: i64) -> Answer {
        let mut last = None;
        loop {
            let answer = self.wait(id, 60.0);
            if answer.number != ACCEPTED || last.as_ref() == Some(&answer) {
                return answer;
            }
            last = Some(answer);
        }
    }

    /// `RemoteTask.wait` with its limit in seconds; 0 or less waits for ever.
    #[track_caller]
    pub fn wait(&mut self, id: i64, limit: f32) -> Answer {
        let patience = PATIENCE + Duration::from_secs_f32(limit.max(0.0));
        self.ask(&format!("wait {id} {limit}"), patience)
    }

    #[track_caller]
    fn ask(&mut self, line: &str, patience: Duration) -> Answer {
        self.process.write_line(line);
        let answer = self.process.next_line(patience);
        let (number, text) = answer.split_once(' ').unwrap_or((&answer, ""));
        Answer {
            number: number.parse().expect("a number"),
            text: String::from_utf8(unhex(text)).expect("UTF-8"),
        }
    }
}

fn hex(text: &str) -> String {
    text.bytes().map(|byte| format!("{byte:02x}")).collect()
}

fn unhex(text: &str) -> Vec<u8> {
    let pairs = text.as_bytes().chunks(2);
    let pair = |pair| u8::from_str_radix(std::str::from_utf8(pair).unwrap(), 16).unwrap();
    pairs.map(pair).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texts_reach_the_driver_unchanged() {
        for text in ["", " ", "l1\nl2", "grüße 👍"] {
            assert_eq!(unhex(&hex(text)), text.as_bytes());
        }
    }
}
