//! A program under test: its output is collected, and it is killed when its [`Process`] is dropped.

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

/// The output so far.
#[derive(Debug, Default)]
struct Output {
    lines: Vec<(Stream, String)>,
    /// Streams that have ended.
    closed: u8,
}

impl Output {
    fn text(&self, of: Stream) -> String {
        let lines = self.lines.iter().filter(|(stream, _)| *stream == of);
        lines.map(|(_, line)| line.as_str()).collect()
    }
}

type SharedOutput = Arc<(Mutex<Output>, Condvar)>;

/// A running program. It is killed when this is dropped.
#[derive(Debug)]
pub struct Process {
    name: String,
    child: Child,
    stdin: Option<ChildStdin>,
    output: SharedOutput,
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
        let output = SharedOutput::default();
        collect(child.stdout.take(), Stream::Out, &output);
        collect(child.stderr.take(), Stream::Err, &output);
        Self {
            name,
            stdin: child.stdin.take(),
            child,
            output,
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
        line.unwrap_or_else(|| panic!("no '{part}' from {}", self.transcript()))
    }

    /// As [`wait_for`](Self::wait_for), for a program with a given port: `None` if it ends because the
    /// port is in use.
    #[track_caller]
    pub fn wait_for_unless_taken(&self, part: &str) -> Option<String> {
        let line = self.line_with(part);
        let taken = self.stderr().contains("in use");
        assert!(
            line.is_some() || taken,
            "no '{part}' from {}",
            self.transcript()
        );
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
        line.unwrap_or_else(|| panic!("no further line from {}", self.transcript()))
    }

    /// Writes a line to its stdin.
    #[track_caller]
    pub fn write_line(&mut self, line: &str) {
        let stdin = self.stdin.as_mut().expect("stdin is open");
        let written = writeln!(stdin, "{line}").and_then(|()| stdin.flush());
        written.unwrap_or_else(|error| panic!("{error}: writing to {}", self.transcript()));
    }

    /// Ends its stdin.
    pub fn close_stdin(&mut self) {
        self.stdin = None;
    }

    /// Its stdout so far.
    pub fn stdout(&self) -> String {
        self.output.0.lock().unwrap().text(Stream::Out)
    }

    /// Its stderr so far.
    pub fn stderr(&self) -> String {
        self.output.0.lock().unwrap().text(Stream::Err)
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
            panic!("not ended within {limit:?}: {}", self.transcript());
        };
        // Its last output may still be in the pipes.
        self.wait_for_end_of_output();
        let heard = self.output.0.lock().unwrap();
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

    /// Waits until neither it nor its child processes hold its output open.
    #[track_caller]
    pub fn wait_for_end_of_output(&self) {
        until("the end of its output", PATIENCE, || {
            (self.output.0.lock().unwrap().closed == 2).then_some(())
        });
    }

    /// Sends a signal by name: `INT`, `STOP`, `CONT`.
    #[track_caller]
    pub fn signal(&self, name: &str) {
        signal(self.child.id(), name);
    }

    /// Repeats a signal until the program has ended. A signal that follows another at once is merged with it.
    #[track_caller]
    pub fn signal_until_end(mut self, name: &str, limit: Duration) -> Ended {
        until("its end", limit, || {
            self.signal(name);
            self.child.try_wait().expect("its status").map(drop)
        });
        self.end(limit)
    }

    /// Its process id.
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// Its memory, in KiB.
    #[track_caller]
    pub fn resident_kib(&self) -> u64 {
        process_status(self.id(), "VmRSS:")
    }

    /// The most memory that it had, in KiB.
    #[track_caller]
    pub fn peak_kib(&self) -> u64 {
        process_status(self.id(), "VmHWM:")
    }

    /// How many files it has open.
    #[track_caller]
    pub fn open_files(&self) -> usize {
        let files = std::fs::read_dir(format!("/proc/{}/fd", self.id()));
        files.expect("it lives").count()
    }

    /// The processor time that it took, to 10 ms.
    #[track_caller]
    pub fn processor_time(&self) -> Duration {
        processor_time(self.id())
    }

    /// The command and its output, for a failure's message.
    fn transcript(&self) -> String {
        let heard = self.output.0.lock().unwrap();
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

    /// Waits until the output suffices; stops early when no more can arrive.
    fn wait<T>(&self, limit: Duration, mut look: impl FnMut(&Output) -> Option<T>) -> Option<T> {
        let deadline = Instant::now() + limit;
        let (heard, changed) = &*self.output;
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

/// Sends a process a signal by name. After `STOP`, waits until all its threads have stopped: on a busy machine some still run
/// for a while.
#[track_caller]
pub fn signal(process: u32, name: &str) {
    // The shell's built-in: a small system has no program `kill`.
    let mut kill = Command::new("sh");
    kill.args(["-c", "kill -$0 $1", name])
        .arg(process.to_string());
    assert!(kill.status().expect("`sh`").success(), "{kill:?}");
    if name == "STOP" {
        until("all threads have stopped", PATIENCE, || {
            has_stopped(process).then_some(())
        });
    }
}

/// Whether all threads of a process are stopped, or it has ended.
fn has_stopped(process: u32) -> bool {
    let threads = std::fs::read_dir(format!("/proc/{process}/task"));
    threads.into_iter().flatten().flatten().all(|thread| {
        let stat = std::fs::read_to_string(thread.path().join("stat")).unwrap_or_default();
        let state = stat.rsplit_once(") ").map_or("", |(_, fields)| fields);
        !state.starts_with(['R', 'S', 'D'])
    })
}

/// The processor time that a process has used, in steps of 10 ms.
#[track_caller]
pub fn processor_time(process: u32) -> Duration {
    let stat = std::fs::read_to_string(format!("/proc/{process}/stat")).expect("it lives");
    // The name, in parentheses, may contain anything.
    let (_, fields) = stat.rsplit_once(')').expect("its name");
    let ticks = fields.split_whitespace().skip(11).take(2);
    let ticks: u64 = ticks
        .map(|ticks| ticks.parse::<u64>().expect("a number"))
        .sum();
    Duration::from_millis(ticks * 10)
}

/// A number in a process's `/proc/PID/status`, by its name there, such as `VmRSS:`.
#[track_caller]
pub fn process_status(process: u32, name: &str) -> u64 {
    let status = std::fs::read_to_string(format!("/proc/{process}/status")).expect("it lives");
    let line = status.lines().find_map(|line| line.strip_prefix(name));
    let number = line.and_then(|line| line.split_whitespace().next()?.parse().ok());
    number.unwrap_or_else(|| panic!("no {name} in {status}"))
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Collects the lines of a stream on a thread that ends with the stream.
fn collect(stream: Option<impl Read + Send + 'static>, name: Stream, output: &SharedOutput) {
    let output = Arc::clone(output);
    let stream = stream.expect("a pipe");
    std::thread::spawn(move || {
        let mut stream = BufReader::new(stream);
        loop {
            let mut line = Vec::new();
            let count = stream.read_until(b'\n', &mut line).unwrap_or(0);
            let mut collected = output.0.lock().unwrap();
            if count == 0 {
                collected.closed += 1;
            } else {
                let line = String::from_utf8_lossy(&line).into_owned();
                collected.lines.push((name, line));
            }
            output.1.notify_all();
            if count == 0 {
                return;
            }
        }
    });
}
