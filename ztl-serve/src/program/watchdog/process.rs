//! The process of the watchdog: learns of programs until its server is gone, and then stops those that are left.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, BufRead, BufReader, Write};
use std::os::fd::AsFd;
use std::process::Child;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::time::{Duration, Instant};

use nix::sys::signal::SigSet;
use rustix::process::Signal;
use signal_hook::flag;
use tracing::{error, warn};

use super::protocol::{Charge, Ending, Message, READY};
use crate::log::LOG;
use crate::program::launch::{Launch, SIGNALS};
use crate::program::process_group::{self as group, ProcessGroup};

/// How long a program that was about to be started when the server ended may take to appear.
const APPEARING: Duration = Duration::from_secs(1);
/// How often to check which programs are left.
const CHECK: Duration = Duration::from_millis(20);
/// How long the watchdog waits for its log to be written at its end.
const LOGGING: Duration = Duration::from_secs(1);

/// Signals that would end or stop the watchdog before its work is done.
const SURVIVED: [Signal; 13] = [
    Signal::HUP,
    Signal::INT,
    Signal::QUIT,
    Signal::TERM,
    Signal::USR1,
    Signal::USR2,
    Signal::ALARM,
    Signal::PIPE,
    // Limits on the size of files, such as the log, and on processor time.
    Signal::XFSZ,
    Signal::XCPU,
    // From a terminal.
    Signal::TSTP,
    Signal::TTIN,
    Signal::TTOU,
];

/// Runs the watchdog, in the process that [`ProcessRegistry::watched`](crate::ProcessRegistry::watched) starts.
///
/// Reads from stdin, a socket, which programs run, and confirms each there. When stdin ends, stops each program
/// that is left as its task would be, kills it after its grace, and returns. Survives all signals that a process can
/// survive, so that it does not end before its server.
pub fn watchdog() {
    survive_signals();
    let stdin = io::stdin();
    let Ok(socket) = stdin.as_fd().try_clone_to_owned() else {
        // The server notices that there are no confirmations.
        return;
    };
    let charges = listen(BufReader::new(stdin), File::from(socket));
    if charges.is_empty() {
        return;
    }
    let (log, logged) = Log::new();
    log.error("The server has ended and left programs behind. Stopping them.");
    end_all(charges, &log);
    log.warn("The programs that the server had left behind have ended.");
    drop(log);
    // The reader of the log may have stopped.
    let _ = logged.recv_timeout(LOGGING);
}

/// Handles signals by doing nothing. Abort programs would inherit ignored signals.
fn survive_signals() {
    for signal in SURVIVED {
        // Fails only for signals that no process can survive.
        let _ = flag::register(signal.as_raw(), Arc::new(AtomicBool::new(false)));
    }
    // A suspended watchdog continues as soon as its server is gone.
    #[cfg(target_os = "linux")]
    let _ = rustix::process::set_parent_process_death_signal(Some(Signal::CONT));
}

fn end_all(charges: BTreeMap<u64, Charge>, log: &Log) {
    let begun = Instant::now();
    let mut orphans: Vec<Orphan> = charges.into_values().map(Orphan::new).collect();
    while !orphans.is_empty() {
        let now = Instant::now();
        let mut helpers = Vec::new();
        orphans.retain_mut(|orphan| orphan.is_left(now, begun, &mut helpers, log));
        orphans.append(&mut helpers);
        std::thread::sleep(CHECK);
    }
}

/// Logs on a thread of its own, since writing to a full pipe blocks.
struct Log(Sender<(bool, String)>);

impl Log {
    /// A log, and a channel that closes when the log is dropped and written.
    fn new() -> (Self, Receiver<()>) {
        let (log, lines) = channel();
        let (done, logged) = channel();
        // Without a thread, nothing is logged.
        let _ = std::thread::Builder::new().spawn(move || {
            // Otherwise a terminal under `stty tostop` interrupts each write.
            let mut stopping = SigSet::empty();
            stopping.add(nix::sys::signal::Signal::SIGTTOU);
            let _ = stopping.thread_block();
            for (is_error, line) in lines {
                match is_error {
                    true => error!(target: LOG, "{line}"),
                    false => warn!(target: LOG, "{line}"),
                }
            }
            drop(done);
        });
        (Self(log), logged)
    }

    fn error(&self, line: impl Into<String>) {
        let _ = self.0.send((true, line.into()));
    }

    fn warn(&self, line: impl Into<String>) {
        let _ = self.0.send((false, line.into()));
    }
}

/// Reads until the server is gone. Returns the programs that are left.
fn listen(lines: impl BufRead, mut answers: impl Write) -> BTreeMap<u64, Charge> {
    let mut charges: BTreeMap<u64, Charge> = BTreeMap::new();
    // If the server is gone, the rest of its messages still counts.
    let mut confirm = |number: u64| drop(answers.write_all(format!("{number}\n").as_bytes()));
    confirm(READY);
    // An incomplete line was the last.
    for line in lines.lines().map_while(Result::ok) {
        match serde_json::from_str(&line) {
            Ok(Message::Begins(number, charge)) => {
                charges.insert(number, charge);
                confirm(number);
            }
            Ok(Message::Runs(number, group)) => {
                if let Some(charge) = charges.get_mut(&number) {
                    charge.group = Some(group);
                }
            }
            Ok(Message::Over(number)) => {
                charges.remove(&number);
            }
            Err(_) => break,
        }
    }
    charges
}

/// A program without a server.
struct Orphan {
    charge: Charge,
    /// When it was asked to end.
    asked: Option<Instant>,
}

impl Orphan {
    fn new(charge: Charge) -> Self {
        Self {
            charge,
            asked: None,
        }
    }

    /// Does what is due and returns whether the program is left. Adds the program that stops it to `helpers`.
    fn is_left(
        &mut self,
        now: Instant,
        begun: Instant,
        helpers: &mut Vec<Self>,
        log: &Log,
    ) -> bool {
        let Some(group) = self.group() else {
            return now < begun + APPEARING;
        };
        if !group.is_same() || !group::is_alive(group.number) {
            return false;
        }
        match self.asked {
            None => {
                self.asked = Some(now);
                helpers.extend(self.ask(group, log));
                true
            }
            Some(asked) if now >= asked + self.charge.grace => {
                group::signal(group.number, Signal::KILL);
                log.warn(format!(
                    "The program of {} was killed: it did not end within its grace.",
                    self.charge.name
                ));
                false
            }
            Some(_) => true,
        }
    }

    fn group(&mut self) -> Option<ProcessGroup> {
        let found = self.charge.group.or_else(|| {
            // The server has ended while it started the program.
            group::with_variable("ZTL_ID", &self.charge.id)
        });
        self.charge.group = found;
        found
    }

    /// Asks the program to end. Returns the abort program, if it has one.
    fn ask(&self, group: ProcessGroup, log: &Log) -> Option<Self> {
        let charge = &self.charge;
        let mut wanted = Signal::TERM;
        match &charge.end {
            Ending::Wait => return None,
            Ending::Signal(name) => {
                let known = SIGNALS.iter().find(|(known, _)| known == name);
                wanted = known.map_or(wanted, |(_, signal)| *signal);
            }
            Ending::Run(launch) => match spawn(launch) {
                Ok(child) => {
                    let mut helper =
                        Charge::new(&charge.name, &charge.id, Ending::Wait, charge.grace);
                    helper.group = Some(ProcessGroup::of(group::led_by(&child)));
                    return Some(Self::new(helper));
                }
                Err(reason) => {
                    log.warn(format!(
                        "Cannot start the abort program of {}, sent SIGTERM instead: {reason}",
                        charge.name
                    ));
                }
            },
        }
        group::signal(group.number, wanted);
        None
    }
}

fn spawn(launch: &Launch) -> Result<Child, String> {
    // On a thread of its own, which may become another user.
    std::thread::scope(|scope| {
        let spawned = scope.spawn(|| launch.spawn(false)).join();
        spawned.unwrap_or_else(|_| Err("it cannot be started".to_owned()))
    })
}

#[cfg(target_os = "linux")]
#[cfg(test)]
mod tests {
    use std::os::unix::process::{CommandExt, ExitStatusExt};
    use std::process::Command;

    use ztl_core::TaskId;

    use super::*;

    fn sleeper(task: TaskId) -> Child {
        let mut command = Command::new("sleep");
        command.arg("60").env("ZTL_ID", task.to_string());
        command.process_group(0).spawn().expect("`sleep`")
    }

    fn message(message: &Message) -> String {
        serde_json::to_string(message).expect("JSON") + "\n"
    }

    #[test]
    fn running_programs_are_stopped_even_if_their_group_is_unknown() {
        let grace = Duration::from_secs(10);
        // No server of another test gives such numbers.
        let [told, untold, over] = [3, 2, 1].map(|less| TaskId::new(u32::MAX - less).expect("one"));
        let mut children = [told, untold, over].map(sleeper);
        let group = |child: &Child| ProcessGroup::of(group::led_by(child));
        let [of_told, _, of_over] = [0, 1, 2].map(|place| group(&children[place]));
        let charge = |task: TaskId| {
            let end = Ending::Signal("USR1".to_owned());
            Charge::new("a task", &task.to_string(), end, grace)
        };
        let lines = [
            Message::Begins(1, charge(told)),
            Message::Begins(3, charge(over)),
            Message::Runs(3, of_over),
            Message::Runs(1, of_told),
            Message::Over(3),
            Message::Begins(2, charge(untold)),
        ];
        let mut lines = lines.map(|line| message(&line)).concat();
        // The server has died in the middle of a word.
        lines.push_str("{\"Ov");
        let mut answers = Vec::new();
        end_all(listen(lines.as_bytes(), &mut answers), &Log::new().0);
        // Ready, and a confirmation for each.
        assert_eq!(answers, b"0\n1\n3\n2\n");
        let mut signal = |place: usize| children[place].try_wait().expect("its status");
        // A shell that starts the tests in the background has the programs ignore INT.
        let usr1 = Some(Signal::USR1.as_raw());
        assert_eq!(signal(0).expect("it has ended").signal(), usr1);
        assert_eq!(signal(1).expect("it has ended").signal(), usr1);
        assert_eq!(signal(2), None);
        children[2].kill().expect("to kill");
        children[2].wait().expect("its end");
    }

    #[test]
    fn a_group_whose_number_was_reused_is_left_alone() {
        let task = TaskId::new(u32::MAX - 9).expect("one");
        let mut child = sleeper(task);
        let end = Ending::Signal("INT".to_owned());
        let mut charge = Charge::new("a task", &task.to_string(), end, Duration::ZERO);
        let stale = format!("{{\"number\":{},\"began\":1}}", child.id());
        charge.group = Some(serde_json::from_str(&stale).expect("a group"));
        end_all(BTreeMap::from([(1, charge)]), &Log::new().0);
        assert_eq!(child.try_wait().expect("its status"), None);
        child.kill().expect("to kill");
        child.wait().expect("its end");
    }
}
