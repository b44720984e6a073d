//! The watchdog itself: it hears of programs until its server is gone, and then ends those that are left.

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

use super::super::LOG;
use super::super::group::{self, Group};
use super::super::program::{Launch, SIGNALS};
use super::{Charge, Ending, Message, READY};

/// How long a program that was about to be started when the server ended may take to appear.
const APPEARING: Duration = Duration::from_secs(1);
/// How often it is looked who is left.
const LOOK: Duration = Duration::from_millis(20);
/// How long the watchdog waits for its log to be written, once its work is done.
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
    // A limit on the size of files, as of the log, and on processor time.
    Signal::XFSZ,
    Signal::XCPU,
    // From a terminal.
    Signal::TSTP,
    Signal::TTIN,
    Signal::TTOU,
];

/// What the process does that [`Groups::watched`](super::super::Groups::watched) starts: it reads on stdin, a
/// socket, which programs run, and confirms there that it knows of them. When stdin ends and some are left, each
/// is asked to end as its task would be, and killed after its grace. Returns when that is done.
///
/// It heeds no signal that a process can ignore: it ends with its server, and not before.
pub fn watchdog() {
    survive_signals();
    let stdin = io::stdin();
    let Ok(socket) = stdin.as_fd().try_clone_to_owned() else {
        // The server notices that nobody confirms.
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
    // Whoever reads the log may have been stopped.
    let _ = logged.recv_timeout(LOGGING);
}

/// By handlers that do nothing: abort programs would inherit that a signal is ignored.
fn survive_signals() {
    for signal in SURVIVED {
        // Fails only for signals that no process can survive.
        let _ = flag::register(signal.as_raw(), Arc::new(AtomicBool::new(false)));
    }
    // Should the watchdog be stopped, it goes on as soon as its server is gone.
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
        std::thread::sleep(LOOK);
    }
}

/// Logs on a thread of its own: nobody may read what is logged, and a full pipe blocks whoever writes to it.
struct Log(Sender<(bool, String)>);

impl Log {
    /// The log, and what says that all of it is written, once it was dropped.
    fn new() -> (Self, Receiver<()>) {
        let (log, lines) = channel();
        let (done, logged) = channel();
        // Without a thread nothing is logged.
        let _ = std::thread::Builder::new().spawn(move || {
            // Otherwise a terminal under `stty tostop` interrupts each write again and again.
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

/// What is left when the server has gone.
fn listen(lines: impl BufRead, mut answers: impl Write) -> BTreeMap<u64, Charge> {
    let mut charges: BTreeMap<u64, Charge> = BTreeMap::new();
    // A server that is gone needs no answer; what it sent before is still read.
    let mut confirm = |number: u64| drop(answers.write_all(format!("{number}\n").as_bytes()));
    confirm(READY);
    // A line that breaks off was its last.
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
    /// Since when it knows that it is to end.
    asked: Option<Instant>,
}

impl Orphan {
    fn new(charge: Charge) -> Self {
        Self {
            charge,
            asked: None,
        }
    }

    /// Does what is due; says whether something of it is left. `helpers`: what was started to end it.
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
                    "Task {} was killed: it did not end within its grace.",
                    self.charge.task
                ));
                false
            }
            Some(_) => true,
        }
    }

    fn group(&mut self) -> Option<Group> {
        let found = self.charge.group.or_else(|| {
            // The server has ended while it was starting this.
            group::with_variable("ZTL_ID", &self.charge.task.to_string())
        });
        self.charge.group = found;
        found
    }

    /// Asks it to end. The program that does so, if it takes one, has its time as well.
    fn ask(&self, group: Group, log: &Log) -> Option<Self> {
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
                    let mut helper = Charge::new(charge.task, Ending::Wait, charge.grace);
                    helper.group = Some(Group::of(group::of(&child)));
                    return Some(Self::new(helper));
                }
                Err(reason) => {
                    log.warn(format!(
                        "Task {} is stopped by SIGTERM, for its abort program cannot be started: {reason}",
                        charge.task
                    ));
                }
            },
        }
        group::signal(group.number, wanted);
        None
    }
}

fn spawn(launch: &Launch) -> Result<Child, String> {
    // On a thread of its own: it may become another user.
    std::thread::scope(|scope| {
        let spawned = scope.spawn(|| launch.spawn(false)).join();
        spawned.unwrap_or_else(|_| Err("it cannot be started".to_owned()))
    })
}

#[cfg(test)]
#[cfg(target_os = "linux")]
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
    fn only_what_is_not_over_is_ended_also_when_its_group_was_never_told() {
        let grace = Duration::from_secs(10);
        // No server of another test gives such numbers.
        let [told, untold, over] = [3, 2, 1].map(|less| TaskId::new(u32::MAX - less).expect("one"));
        let mut children = [told, untold, over].map(sleeper);
        let group = |child: &Child| Group::of(group::of(child));
        let [of_told, _, of_over] = [0, 1, 2].map(|place| group(&children[place]));
        let charge =
            |task: TaskId| Charge::new(task.get(), Ending::Signal("USR1".to_owned()), grace);
        let lines = [
            Message::Begins(1, charge(told)),
            Message::Begins(3, charge(over)),
            Message::Runs(3, of_over),
            Message::Runs(1, of_told),
            Message::Over(3),
            Message::Begins(2, charge(untold)),
        ];
        let mut lines = lines.map(|line| message(&line)).concat();
        // The server died within a word.
        lines.push_str("{\"Ov");
        let mut answers = Vec::new();
        end_all(listen(lines.as_bytes(), &mut answers), &Log::new().0);
        // It is ready, and knows of each.
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
    fn a_group_whose_number_is_anothers_by_now_is_left_alone() {
        let task = TaskId::new(u32::MAX - 9).expect("one");
        let mut child = sleeper(task);
        let mut charge = Charge::new(task.get(), Ending::Signal("INT".to_owned()), Duration::ZERO);
        let stale = format!("{{\"number\":{},\"began\":1}}", child.id());
        charge.group = Some(serde_json::from_str(&stale).expect("a group"));
        end_all(BTreeMap::from([(1, charge)]), &Log::new().0);
        assert_eq!(child.try_wait().expect("its status"), None);
        child.kill().expect("to kill");
        child.wait().expect("its end");
    }
}
