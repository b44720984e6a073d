//! What looks after the programs when their server is gone: a second process, which hears of each
//! program before it is started. It does nothing until the server's end of the pipe closes, and that
//! is for the system to do, however the server ended.

mod watch;

use std::collections::BTreeMap;
use std::io::{self, Write};
use std::os::fd::OwnedFd;
use std::os::unix::net::UnixStream;
use std::os::unix::process::CommandExt;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};
use tracing::warn;
use ztl_core::TaskId;

use super::LOG;
use super::group::Group;
use super::program::{AbortBy, Launch, Program};
use super::template::Call;

pub use watch::guard;

/// How long the guard may be too busy to listen; then it is replaced.
const PATIENCE: Duration = Duration::from_secs(1);
/// Pause before one that ended soon after its start is replaced: after the second one in a row, and at most.
const PAUSE: (Duration, Duration) = (Duration::from_millis(50), Duration::from_secs(1));

/// A program that somebody has to look after.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct Charge {
    /// `ZTL_ID` in its environment, by which it is found while its group is not known.
    task: u32,
    group: Option<Group>,
    end: Ending,
    grace: Duration,
}

/// How it is asked to end.
#[derive(Debug, Clone, Serialize, Deserialize)]
enum Ending {
    /// By a signal, as `TERM`.
    Signal(String),
    /// By another program.
    Run(Box<Launch>),
    /// Not at all: it ends another one.
    Wait,
}

impl Charge {
    /// A task's program.
    pub(super) fn of(program: &Program, call: &Call) -> Self {
        let end = match &program.abort.by {
            AbortBy::Signal(name, _) => Ending::Signal((*name).to_owned()),
            AbortBy::Program(run) => match run.launch(call) {
                Ok(launch) => Ending::Run(Box::new(launch)),
                // The server has no other way either.
                Err(_) => Ending::Signal("TERM".to_owned()),
            },
        };
        Self::new(call.id.get(), end, program.abort.grace)
    }

    /// A program that aborts a task's.
    pub(super) fn of_helper(task: TaskId, grace: Duration) -> Self {
        Self::new(task.get(), Ending::Wait, grace)
    }

    fn new(task: u32, end: Ending, grace: Duration) -> Self {
        Self {
            task,
            group: None,
            end,
            grace,
        }
    }
}

/// What the guard is told, one line of JSON each.
#[derive(Debug, Serialize, Deserialize)]
enum Message {
    /// A program may be started from now on.
    Begins(u64, Charge),
    /// It has been.
    Runs(u64, Group),
    /// Nobody needs to look after it any more.
    Over(u64),
}

/// The server's side of it.
#[derive(Debug)]
pub(super) struct Guard {
    command: Command,
    process: Option<Process>,
    /// When the last one was started.
    started: Instant,
    /// Pause before it is replaced, should it end soon.
    pause: Duration,
    /// When the next one is started, while there is none.
    due: Option<Instant>,
    charges: BTreeMap<u64, Charge>,
    last: u64,
}

#[derive(Debug)]
struct Process {
    child: Child,
    ear: UnixStream,
}

impl Guard {
    /// Starts it by this command, which is to call [`guard`].
    ///
    /// # Errors
    /// As the system says.
    pub(super) fn start(mut command: Command) -> io::Result<Self> {
        // Of a group of its own: Ctrl-C in a terminal is for the server.
        command.stdout(Stdio::null()).process_group(0);
        let process = start(&mut command)?;
        Ok(Self {
            command,
            process: Some(process),
            started: Instant::now(),
            pause: Duration::ZERO,
            due: None,
            charges: BTreeMap::new(),
            last: 0,
        })
    }

    /// A program is about to be started; the number is for what follows.
    pub(super) fn begins(&mut self, charge: Charge) -> u64 {
        self.last += 1;
        self.charges.insert(self.last, charge.clone());
        self.tell(&Message::Begins(self.last, charge));
        self.last
    }

    pub(super) fn runs(&mut self, number: u64, leader: i32) {
        let group = Group::of(leader);
        if let Some(charge) = self.charges.get_mut(&number) {
            charge.group = Some(group);
        }
        self.tell(&Message::Runs(number, group));
    }

    pub(super) fn over(&mut self, number: u64) {
        self.charges.remove(&number);
        self.tell(&Message::Over(number));
    }

    /// Replaces a guard that has ended, and says when to look again if that has to wait.
    pub(super) fn look(&mut self) -> Option<Instant> {
        let ended = |process: &mut Process| !matches!(process.child.try_wait(), Ok(None));
        if self.process.as_mut().is_none_or(ended) {
            self.replace();
        }
        self.due
    }

    fn tell(&mut self, message: &Message) {
        let told = match &mut self.process {
            Some(process) => process.tell(message),
            None => Err(io::ErrorKind::NotConnected.into()),
        };
        if told.is_err() {
            self.replace();
        }
    }

    /// Starts another, which is told everything anew.
    fn replace(&mut self) {
        if let Some(process) = self.process.take() {
            process.kill();
        }
        let now = Instant::now();
        let lived = now.saturating_duration_since(self.started);
        let due = *self.due.get_or_insert_with(|| {
            let pause = if lived < PAUSE.1 {
                self.pause
            } else {
                Duration::ZERO
            };
            self.pause = (pause * 2).clamp(PAUSE.0, PAUSE.1);
            now + pause
        });
        if now < due {
            return;
        }
        self.started = now;
        self.due = None;
        let mut started = start(&mut self.command);
        if let Ok(process) = &mut started {
            let mut charges = self.charges.iter();
            let told = charges.try_for_each(|(number, charge)| {
                process.tell(&Message::Begins(*number, charge.clone()))
            });
            if let Err(error) = told {
                started = Err(error);
            }
        }
        match started {
            Ok(process) => {
                warn!(target: LOG, "The guard had ended and was started anew.");
                self.process = Some(process);
            }
            Err(error) => {
                warn!(target: LOG, "The guard has ended and cannot be started anew: {error}. Programs would survive this server.");
                self.due = Some(now + PAUSE.1);
            }
        }
    }
}

fn start(command: &mut Command) -> io::Result<Process> {
    let (ear, stdin) = UnixStream::pair()?;
    ear.set_write_timeout(Some(PATIENCE))?;
    let child = command.stdin(OwnedFd::from(stdin)).spawn();
    // The command has kept the guard's end of the pipe.
    command.stdin(Stdio::null());
    Ok(Process { child: child?, ear })
}

impl Process {
    fn tell(&mut self, message: &Message) -> io::Result<()> {
        let mut line = serde_json::to_vec(message).or_else(|_| lossy(message))?;
        line.push(b'\n');
        self.ear.write_all(&line)
    }

    /// Before its pipe is closed: one that was only slow would take that for the server's end.
    fn kill(mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// A path that is no UTF-8 cannot be told: a signal has to do.
fn lossy(message: &Message) -> serde_json::Result<Vec<u8>> {
    match message {
        Message::Begins(number, charge) => {
            let end = Ending::Signal("TERM".to_owned());
            let charge = charge.clone();
            serde_json::to_vec(&Message::Begins(*number, Charge { end, ..charge }))
        }
        other => serde_json::to_vec(other),
    }
}

impl Drop for Guard {
    fn drop(&mut self) {
        // With something left to do, it does that as soon as the pipe is closed.
        if self.charges.is_empty()
            && let Some(process) = self.process.take()
        {
            process.kill();
        }
    }
}
