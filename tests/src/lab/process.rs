//! A program under test: what it says is collected, and it ends with its guard.

use std::io::{BufRead, BufReader, Read, Write};
use std::process::{Child, ChildStdin, Command, Stdio};
use std::sync::{Arc, Condvar, Mutex};
use std::time::{Duration, Instant};

use super::{PATIENCE, until};

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Stream {
    Out,
    Err,
}

/// What a program has said so far.
#[derive(Debug, Default)]
struct Heard {
    lines: Vec<(Stream, String)>,
    /// Streams that have ended.
    closed: u8,
}

impl Heard {
    fn text(&self, of: Stream) -> String {
        let lines = self.lines.iter().filter(|(stream, _)| *stream == of);
        lines.map(|(_, line)| line.as_str()).collect()
    }
}

type Ear = Arc<(Mutex<Heard>, Condvar)>;

/// A running program. It is killed when this is dropped.
#[derive(Debug)]
pub struct Process {
    name: String,
    child: Child,
    stdin: Option<ChildStdin>,
    heard: Ear,
    /// Lines of stdout that [`next_line`](Self::next_line) has given.
    taken: usize,
}

/// A program that has ended.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Ended {
    /// Its exit code; `None` when a signal ended it.
    pub code: Option<i32>,
    /// All that it wrote to stdout.
    pub stdout: String,
    /// All that it wrote to stderr.
    pub stderr: String,
}

impl Process {
    /// Starts a program.
    #[track_caller]
    pub fn start(command: &mut Command) -> Self {
        let name = format!("{command:?}");
        let child = command
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn();
        let mut child = child.unwrap_or_else(|error| panic!("cannot start {name}: {error}"));
        let heard = Ear::default();
        listen(child.stdout.take(), Stream::Out, &heard);
        listen(child.stderr.take(), Stream::Err, &heard);
        Self {
            name,
            stdin: child.stdin.take(),
            child,
            heard,
            taken: 0,
        }
    }

    /// Runs a program to its end.
    #[track_caller]
    pub fn run(command: &mut Command) -> Ended {
        Self::start(command).end(PATIENCE)
    }

    /// The first line, on either stream, that contains `part`; waits for it.
    #[track_caller]
    pub fn wait_for(&self, part: &str) -> String {
        let line = self.line_with(part);
        line.unwrap_or_else(|| panic!("no '{part}' from {}", self.story()))
    }

    /// As [`wait_for`](Self::wait_for), for a program that was told its port: `None` if it ends because the
    /// port is in use.
    #[track_caller]
    pub fn wait_for_unless_taken(&self, part: &str) -> Option<String> {
        let line = self.line_with(part);
        let taken = self.stderr().contains("in use");
        assert!(line.is_some() || taken, "no '{part}' from {}", self.story());
        line
    }

    /// The port in the first line that contains `part`, as in `tcp://127.0.0.1:4242`; waits for it.
    #[track_caller]
    pub fn wait_for_port(&self, part: &str) -> u16 {
        let line = self.wait_for(part);
        let port = line.split_once("tcp:").and_then(|(_, address)| {
            let (_, port) = address.split_once(':')?;
            let digits = port.split(|c: char| !c.is_ascii_digit()).next()?;
            digits.parse().ok()
        });
        port.unwrap_or_else(|| panic!("no port in '{line}'"))
    }

    /// The next line of stdout; waits for it.
    #[track_caller]
    pub fn next_line(&mut self, limit: Duration) -> String {
        let taken = self.taken;
        let line = self.wait(limit, |heard| {
            let mut lines = heard
                .lines
                .iter()
                .filter(|(stream, _)| *stream == Stream::Out);
            lines.nth(taken).map(|(_, line)| line.trim_end().to_owned())
        });
        self.taken += 1;
        line.unwrap_or_else(|| panic!("no further line from {}", self.story()))
    }

    /// Writes a line to its stdin.
    #[track_caller]
    pub fn write_line(&mut self, line: &str) {
        let stdin = self.stdin.as_mut().expect("stdin is open");
        let written = writeln!(stdin, "{line}").and_then(|()| stdin.flush());
        written.unwrap_or_else(|error| panic!("{error}: writing to {}", self.story()));
    }

    /// Ends its stdin.
    pub fn close_stdin(&mut self) {
        self.stdin = None;
    }

    /// What it has written to stdout so far.
    pub fn stdout(&self) -> String {
        self.heard.0.lock().unwrap().text(Stream::Out)
    }

    /// What it has written to stderr so far.
    pub fn stderr(&self) -> String {
        self.heard.0.lock().unwrap().text(Stream::Err)
    }

    /// Waits for its end.
    #[track_caller]
    pub fn end(mut self, limit: Duration) -> Ended {
        let mut status = None;
        let start = Instant::now();
        while status.is_none() && start.elapsed() < limit {
            status = self.child.try_wait().expect("its status");
            std::thread::sleep(Duration::from_millis(5));
        }
        let Some(status) = status else {
            panic!("not ended within {limit:?}: {}", self.story());
        };
        // What it has said may still be on its way.
        self.wait_for_silence();
        let heard = self.heard.0.lock().unwrap();
        Ended {
            code: status.code(),
            stdout: heard.text(Stream::Out),
            stderr: heard.text(Stream::Err),
        }
    }

    /// Ends it as a power cut would (SIGKILL), and waits until it is gone.
    #[track_caller]
    pub fn kill(&mut self) {
        self.child.kill().expect("to kill it");
        self.child.wait().expect("its end");
    }

    /// Waits until nobody holds its output open any more: neither it nor what it has started.
    #[track_caller]
    pub fn wait_for_silence(&self) {
        until("the end of its output", PATIENCE, || {
            (self.heard.0.lock().unwrap().closed == 2).then_some(())
        });
    }

    /// Sends a signal by name: `INT`, `STOP`, `CONT`.
    #[track_caller]
    pub fn signal(&self, name: &str) {
        // The shell's own: a small system has no program of that name.
        let mut kill = Command::new("sh");
        kill.args(["-c", "kill -$0 $1", name])
            .arg(self.child.id().to_string());
        assert!(kill.status().expect("`sh`").success(), "{kill:?}");
    }

    /// Sends it a signal until it has ended: one that comes at once after another is the same.
    #[track_caller]
    pub fn insist(mut self, name: &str, limit: Duration) -> Ended {
        until("its end", limit, || {
            self.signal(name);
            self.child.try_wait().expect("its status").map(drop)
        });
        self.end(limit)
    }

    /// Its number in the system.
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// What was run and what it has said, for whoever has to find out what went wrong.
    fn story(&self) -> String {
        let heard = self.heard.0.lock().unwrap();
        format!(
            "{}\n--- stdout:\n{}--- stderr:\n{}---",
            self.name,
            heard.text(Stream::Out),
            heard.text(Stream::Err)
        )
    }

    fn line_with(&self, part: &str) -> Option<String> {
        self.wait(PATIENCE, |heard| {
            let mut lines = heard.lines.iter();
            let line = lines.find(|(_, line)| line.contains(part));
            line.map(|(_, line)| line.trim_end().to_owned())
        })
    }

    /// Waits until what was heard is enough; gives up early when nothing more can come.
    fn wait<T>(&self, limit: Duration, mut look: impl FnMut(&Heard) -> Option<T>) -> Option<T> {
        let deadline = Instant::now() + limit;
        let (heard, changed) = &*self.heard;
        let mut heard = heard.lock().unwrap();
        loop {
            if let Some(found) = look(&heard) {
                return Some(found);
            }
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() || heard.closed == 2 {
                return None;
            }
            heard = changed.wait_timeout(heard, left).unwrap().0;
        }
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Collects the lines of a stream on a thread that ends with the stream.
fn listen(stream: Option<impl Read + Send + 'static>, name: Stream, ear: &Ear) {
    let ear = Arc::clone(ear);
    let stream = stream.expect("a pipe");
    std::thread::spawn(move || {
        let mut stream = BufReader::new(stream);
        loop {
            let mut line = Vec::new();
            let count = stream.read_until(b'\n', &mut line).unwrap_or(0);
            let mut heard = ear.0.lock().unwrap();
            if count == 0 {
                heard.closed += 1;
            } else {
                let line = String::from_utf8_lossy(&line).into_owned();
                heard.lines.push((name, line));
            }
            ear.1.notify_all();
            if count == 0 {
                return;
            }
        }
    });
}
