//! The thread of the server that keeps a watchdog running and tells it of programs.

use std::collections::BTreeMap;
use std::fmt;
use std::io::{self, Read, Write};
use std::os::fd::OwnedFd;
use std::os::unix::net::UnixStream;
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::Sender;
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use tracing::{error, warn};

use super::super::LOG;
use super::super::group::Group;
use super::super::link::Inbox;
use super::{Charge, Ending, Message};

/// How long a new watchdog may take until it is ready.
pub(super) const STARTING: Duration = Duration::from_secs(5);
/// How long a watchdog may take to confirm. One that is slower, or stopped, is replaced.
const CONFIRMING: Duration = Duration::from_millis(500);
/// Pause before a watchdog that ended soon after its start is replaced: after the second in a row, and longest.
const PAUSE: (Duration, Duration) = (Duration::from_millis(50), Duration::from_secs(1));

/// What the thread is asked to do.
pub(super) enum Order {
    Announce(u64, Charge, Box<dyn FnOnce() + Send>),
    Runs(u64, Group),
    Over(u64),
    /// The server has stopped by itself.
    Close,
}

impl fmt::Debug for Order {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Announce(number, charge, _) => write!(f, "Announce({number}, {charge:?})"),
            Self::Runs(number, group) => write!(f, "Runs({number}, {group:?})"),
            Self::Over(number) => write!(f, "Over({number})"),
            Self::Close => write!(f, "Close"),
        }
    }
}

/// A program that was announced.
struct Announced {
    charge: Charge,
    /// To be called once a watchdog has confirmed it.
    confirmed: Option<Box<dyn FnOnce() + Send>>,
}

pub(super) struct Keeper {
    orders: Inbox<Order>,
    command: Command,
    process: Option<Process>,
    /// When the last watchdog was started.
    started: Option<Instant>,
    /// Pause before it is replaced, should it end soon.
    pause: Duration,
    /// When the next one is started, while there is none.
    due: Instant,
    announced: BTreeMap<u64, Announced>,
    /// Dropped once the first watchdog is ready, or has failed.
    first: Option<Sender<()>>,
}

impl Keeper {
    pub(super) fn new(orders: Inbox<Order>, command: Command, first: Sender<()>) -> Self {
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

    /// Until it is told to close.
    pub(super) fn run(mut self) {
        loop {
            if self.process.is_none() && self.due <= Instant::now() {
                self.start();
            }
            self.wait();
            self.orders.silence();
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

    /// Sleeps until something happens.
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
        // When a signal interrupts this, the loop goes round once more.
        let _ = poll(&mut polled, left.as_ref());
    }

    fn tell(&mut self, message: &Message) {
        if let Some(process) = &mut self.process {
            process.tell(message);
        }
    }

    /// Starts a watchdog and tells it of every program.
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
                error!(target: LOG, "The watchdog cannot be started, so no program starts: {error}");
                self.due = now + PAUSE.1;
                self.first = None;
            }
        }
        self.started = Some(now);
    }

    /// Sends to the watchdog and hears from it.
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
                warn!(target: LOG, "The watchdog is replaced, and no program starts meanwhile: {error}");
                self.first = None;
                self.replace();
            }
        }
    }

    /// Has the next watchdog started: at once, unless this one ended soon after its start.
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

    /// A watchdog that has something left to do does it as soon as its socket is closed.
    fn close(self) {
        if self.announced.is_empty()
            && let Some(process) = self.process
        {
            process.kill();
        }
    }
}

/// A watchdog that runs.
struct Process {
    child: Child,
    socket: UnixStream,
    unsent: Vec<u8>,
    /// A line that has not ended.
    heard: Vec<u8>,
    /// Lines that it is still to say.
    unsaid: usize,
    /// When it must have said the next one.
    deadline: Option<Instant>,
}

impl Process {
    fn start(command: &mut Command) -> io::Result<Self> {
        let (socket, stdin) = UnixStream::pair()?;
        socket.set_nonblocking(true)?;
        let child = command.stdin(OwnedFd::from(stdin)).spawn();
        // The command has kept the watchdog's end of the socket.
        command.stdin(Stdio::null());
        Ok(Self {
            child: child?,
            socket,
            unsent: Vec::new(),
            heard: Vec::new(),
            // That it is ready.
            unsaid: 1,
            deadline: Some(Instant::now() + STARTING),
        })
    }

    fn tell(&mut self, message: &Message) {
        let line = serde_json::to_vec(message).or_else(|_| lossy(message));
        // Only what `lossy` replaces cannot be written.
        self.unsent.extend(line.unwrap_or_default());
        self.unsent.push(b'\n');
        if let Message::Begins(..) = message {
            self.unsaid += 1;
            self.deadline
                .get_or_insert_with(|| Instant::now() + CONFIRMING);
        }
    }

    /// Sends and hears as much as goes without waiting. Returns the numbers that it has confirmed.
    ///
    /// # Errors
    /// It has ended, or is too slow.
    fn exchange(&mut self) -> io::Result<Vec<u64>> {
        while !self.unsent.is_empty() {
            match self.socket.write(&self.unsent) {
                Ok(count) => drop(self.unsent.drain(..count)),
                // Reading tells whether it has ended.
                Err(_) => break,
            }
        }
        let mut buffer = [0; 1024];
        loop {
            match self.socket.read(&mut buffer) {
                Err(error) if is_for_now(&error) => break,
                Ok(0) | Err(_) => return Err(io::Error::other("it has ended")),
                Ok(count) => self.heard.extend(buffer.get(..count).unwrap_or_default()),
            }
        }
        let mut confirmed = Vec::new();
        while let Some(end) = self.heard.iter().position(|byte| *byte == b'\n') {
            let line: Vec<u8> = self.heard.drain(..=end).collect();
            let number = std::str::from_utf8(&line)
                .ok()
                .and_then(|line| line.trim_end().parse().ok());
            confirmed.push(number.ok_or_else(|| io::Error::other("it says what it should not"))?);
            self.unsaid = self.unsaid.saturating_sub(1);
        }
        let now = Instant::now();
        if !confirmed.is_empty() {
            self.deadline = (self.unsaid > 0).then_some(now + CONFIRMING);
        }
        match self.deadline.is_some_and(|deadline| deadline <= now) {
            true => Err(io::Error::other("it does not answer")),
            false => Ok(confirmed),
        }
    }

    /// Before its socket is closed: a slow one would take that for the server's end.
    fn kill(mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Whether nothing goes just now.
fn is_for_now(error: &io::Error) -> bool {
    matches!(
        error.kind(),
        io::ErrorKind::WouldBlock | io::ErrorKind::Interrupted
    )
}

/// JSON cannot hold a path that is not UTF-8: a signal has to do.
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
