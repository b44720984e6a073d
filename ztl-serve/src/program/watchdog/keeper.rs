//! The server's thread that keeps a watchdog running and announces programs to it.

use std::collections::BTreeMap;
use std::io::{self, Read, Write};
use std::os::fd::OwnedFd;
use std::os::unix::net::UnixStream;
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::Sender;
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use tracing::{error, warn};

use super::protocol::{Charge, Ending, Message};
use crate::log::LOG;
use crate::mailbox::Inbox;
use crate::program::process_group::ProcessGroup;

/// How long a new watchdog may take to be ready.
pub(crate) const STARTING: Duration = Duration::from_secs(5);
/// How long a watchdog may take to confirm. A slower one is replaced.
const CONFIRMING: Duration = Duration::from_millis(500);
/// Shortest and longest pause before a watchdog is replaced that ended soon after its start. The first is replaced
/// at once.
const PAUSE: (Duration, Duration) = (Duration::from_millis(50), Duration::from_secs(1));

/// What the thread does.
pub(crate) enum Order {
    Announce(u64, Charge, Box<dyn FnOnce() + Send>),
    Runs(u64, ProcessGroup),
    Over(u64),
    /// The server has stopped regularly.
    Close,
}

/// An announced program.
struct Announced {
    charge: Charge,
    /// Called once a watchdog has confirmed it.
    confirmed: Option<Box<dyn FnOnce() + Send>>,
}

pub(crate) struct Keeper {
    orders: Inbox<Order>,
    command: Command,
    process: Option<Process>,
    /// When the latest watchdog was started.
    started: Option<Instant>,
    /// Pause before it is replaced if it ends soon.
    pause: Duration,
    /// When to start the next one while there is none.
    due: Instant,
    announced: BTreeMap<u64, Announced>,
    /// Dropped once the first watchdog is ready or has failed.
    first: Option<Sender<()>>,
}

impl Keeper {
    pub(crate) fn new(orders: Inbox<Order>, command: Command, first: Sender<()>) -> Self {
        Self {
            orders,
            command,
            first: Some(first),
            process: None,
            started: None,
            pause: Duration::ZERO,
            due: Instant::now(),
            announced: BTreeMap::new(),
        }
    }

    /// Runs until it receives the request to close.
    pub(crate) fn run(mut self) {
        loop {
            if self.process.is_none() && self.due <= Instant::now() {
                self.start();
            }
            self.wait();
            self.orders.clear();
            while let Some(order) = self.orders.next() {
                match order {
                    Order::Announce(number, charge, confirmed) => {
                        self.tell(&Message::Begins(number, charge.clone()));
                        let confirmed = Some(confirmed);
                        let announced = Announced { charge, confirmed };
                        self.announced.insert(number, announced);
                    }
                    Order::Runs(number, group) => {
                        if let Some(announced) = self.announced.get_mut(&number) {
                            announced.charge.group = Some(group);
                        }
                        self.tell(&Message::Runs(number, group));
                    }
                    Order::Over(number) => {
                        self.announced.remove(&number);
                        self.tell(&Message::Over(number));
                    }
                    Order::Close => return self.close(),
                }
            }
            self.exchange();
        }
    }

    /// Waits until something happens.
    fn wait(&self) {
        let mut polled = vec![PollFd::new(&self.orders, PollFlags::IN)];
        let until = match &self.process {
            Some(process) => {
                let mut flags = PollFlags::IN;
                flags.set(PollFlags::OUT, !process.unsent.is_empty());
                polled.push(PollFd::new(&process.socket, flags));
                process.deadline
            }
            None => Some(self.due),
        };
        let left = until.map(|until| until.saturating_duration_since(Instant::now()));
        let left = left.and_then(|left| Timespec::try_from(left).ok());
        // A signal may interrupt this. Then the loop goes round once more.
        let _ = poll(&mut polled, left.as_ref());
    }

    fn tell(&mut self, message: &Message) {
        if let Some(process) = &mut self.process {
            process.tell(message);
        }
    }

    /// Starts a watchdog and announces every program to it.
    fn start(&mut self) {
        let now = Instant::now();
        match Process::start(&mut self.command) {
            Ok(mut process) => {
                if self.started.is_some() {
                    warn!(target: LOG, "The watchdog has been restarted.");
                }
                for (number, announced) in &self.announced {
                    process.tell(&Message::Begins(*number, announced.charge.clone()));
                }
                self.process = Some(process);
            }
            Err(error) => {
                error!(target: LOG, "Cannot start the watchdog, so no program starts: {error}");
                self.due = now + PAUSE.1;
                self.first = None;
            }
        }
        self.started = Some(now);
    }

    /// Sends to the watchdog and reads its answers.
    fn exchange(&mut self) {
        let Some(process) = &mut self.process else {
            return;
        };
        match process.exchange() {
            Ok(confirmed) => {
                if !confirmed.is_empty() {
                    self.first = None;
                }
                for number in confirmed {
                    let announced = self.announced.get_mut(&number);
                    if let Some(confirmed) = announced.and_then(|it| it.confirmed.take()) {
                        confirmed();
                    }
                }
            }
            Err(error) => {
                warn!(target: LOG, "Replacing the watchdog; no program starts until then: {error}");
                self.first = None;
                self.replace();
            }
        }
    }

    /// Kills the watchdog and schedules the next one.
    fn replace(&mut self) {
        if let Some(process) = self.process.take() {
            process.kill();
        }
        let now = Instant::now();
        let is_new = |started| now.saturating_duration_since(started) < PAUSE.1;
        if !self.started.is_some_and(is_new) {
            self.pause = Duration::ZERO;
        }
        self.due = now + self.pause;
        self.pause = (self.pause * 2).clamp(PAUSE.0, PAUSE.1);
    }

    /// A watchdog that still knows of programs stops them once its socket is closed.
    fn close(self) {
        if self.announced.is_empty()
            && let Some(process) = self.process
        {
            process.kill();
        }
    }
}

/// A running watchdog.
struct Process {
    child: Child,
    socket: UnixStream,
    unsent: Vec<u8>,
    /// An incomplete line.
    received: Vec<u8>,
    /// Lines that it has yet to send.
    expected: usize,
    /// When the next one is due.
    deadline: Option<Instant>,
}

impl Process {
    fn start(command: &mut Command) -> io::Result<Self> {
        let (socket, stdin) = UnixStream::pair()?;
        socket.set_nonblocking(true)?;
        let child = command.stdin(OwnedFd::from(stdin)).spawn();
        // Closes the watchdog's end of the socket, which the command has kept.
        command.stdin(Stdio::null());
        Ok(Self {
            child: child?,
            socket,
            unsent: Vec::new(),
            received: Vec::new(),
            // `READY`.
            expected: 1,
            deadline: Some(Instant::now() + STARTING),
        })
    }

    fn tell(&mut self, message: &Message) {
        let line = serde_json::to_vec(message).or_else(|_| lossy(message));
        // `lossy` replaces all that JSON cannot hold.
        self.unsent.extend(line.unwrap_or_default());
        self.unsent.push(b'\n');
        if let Message::Begins(..) = message {
            self.expected += 1;
            self.deadline
                .get_or_insert_with(|| Instant::now() + CONFIRMING);
        }
    }

    /// Sends and reads without waiting. Returns the confirmed numbers; an error if the watchdog has ended or is too
    /// slow.
    fn exchange(&mut self) -> io::Result<Vec<u64>> {
        while !self.unsent.is_empty() {
            match self.socket.write(&self.unsent) {
                Ok(count) => drop(self.unsent.drain(..count)),
                // Reading shows whether the watchdog has ended.
                Err(_) => break,
            }
        }
        let mut buffer = [0; 1024];
        loop {
            match self.socket.read(&mut buffer) {
                Err(error) if is_temporary(&error) => break,
                Ok(0) | Err(_) => return Err(io::Error::other("it has ended")),
                Ok(count) => self
                    .received
                    .extend(buffer.get(..count).unwrap_or_default()),
            }
        }
        let mut confirmed = Vec::new();
        while let Some(end) = self.received.iter().position(|byte| *byte == b'\n') {
            let line: Vec<u8> = self.received.drain(..=end).collect();
            let number = std::str::from_utf8(&line)
                .ok()
                .and_then(|line| line.trim_end().parse().ok());
            confirmed.push(number.ok_or_else(|| io::Error::other("invalid answer"))?);
            self.expected = self.expected.saturating_sub(1);
        }
        let now = Instant::now();
        if !confirmed.is_empty() {
            self.deadline = (self.expected > 0).then_some(now + CONFIRMING);
        }
        match self.deadline.is_some_and(|deadline| deadline <= now) {
            true => Err(io::Error::other("no answer in time")),
            false => Ok(confirmed),
        }
    }

    /// Kills it before its socket is closed: a slow watchdog would take that for the server's end.
    fn kill(mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Whether to try again later.
fn is_temporary(error: &io::Error) -> bool {
    matches!(
        error.kind(),
        io::ErrorKind::WouldBlock | io::ErrorKind::Interrupted
    )
}

/// JSON cannot hold a path that is not UTF-8. Stops such a program by a signal.
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
