//! What a shared line's thread does: runs the line and its bus, and adds the nodes that it finds.

use std::collections::BTreeMap;
use std::io::{self, Write};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::time::Duration;

use ztl_core::Instant;
use ztl_core::time::earliest;
use ztl_link::bus::{Bus, BusEvent, Found};

use super::nodes::{Node, Nodes, joined};
use super::port::Ports;
use super::{AddNode, Input, LineStatus};
use crate::gateway::device::{LineEvent, run_line};
use crate::gateway::endpoint::{Line, READ_TIMEOUT};
use crate::gateway::opener::Opener;
use crate::gateway::rate_limited_log::{RateLimitedLog, Severity};
use crate::gateway::seat::Seat;
use crate::time::now;

/// Pause before the line is opened again.
const RETRY: Duration = Duration::from_millis(500);
/// Pause between two searches: after one that no node has answered, and after others.
const SEARCH: (Duration, Duration) = (Duration::from_millis(500), Duration::from_secs(3));
/// Searches without an answer after which a line that may be half open is opened again.
const SEARCHES: u32 = 5;
/// Searches without an answer after which no node is said to answer.
const TELL: u32 = 3;
/// Inputs handled before deadlines are checked.
const BATCH: usize = 64;
/// How long a device waits for its port.
const PORT: Duration = Duration::from_secs(1);

/// What is wrong with a line without nodes.
const NOTHING: &str = "no node answers";
const NOISE: &str = "no node answers, and what is received is noise: check the wires, the resistors at both ends and the baud rate";

enum LineState {
    Closed { retry: Instant },
    Opening,
    Open(Box<dyn Write + Send>),
}

/// A shared line's thread.
pub(super) struct Worker {
    name: String,
    opener: Opener,
    bus: Bus,
    line: LineState,
    /// Ends the thread that reads the line.
    stop: Arc<AtomicBool>,
    /// Number of the current line.
    number: u64,
    ports: Ports,
    nodes: Nodes,
    /// When the next search begins, unless one is under way.
    search: Option<Instant>,
    /// How many searches in a row no node has answered.
    unanswered: u32,
    /// The nodes whose answers are said to be damaged, by their addresses.
    damaged: BTreeMap<u8, String>,
    retired: bool,
    /// What is logged of the addresses, and whether the line is logged as ready since.
    mistakes: Vec<String>,
    told_ready: bool,
    status: LineStatus,
    add_node: Box<AddNode>,
    log: RateLimitedLog,
}

impl Worker {
    pub(super) fn new(
        name: &str,
        opener: Opener,
        bus: Bus,
        ports: Ports,
        status: LineStatus,
        add_node: Box<AddNode>,
    ) -> Self {
        Self {
            name: name.to_owned(),
            opener,
            bus,
            line: LineState::Closed { retry: now() },
            stop: Arc::default(),
            number: 0,
            ports,
            nodes: Nodes::default(),
            search: None,
            unanswered: 0,
            damaged: BTreeMap::new(),
            retired: false,
            mistakes: Vec::new(),
            told_ready: false,
            status,
            add_node,
            log: RateLimitedLog::new(name, now()),
        }
    }

    /// Runs until the line is retired and no port is open.
    pub(super) fn run(&mut self, inbox: &Receiver<Input>) {
        while !self.retired || !self.ports.is_empty() {
            if let LineState::Closed { retry } = self.line
                && now() >= retry
                && !self.retired
            {
                self.open();
            }
            match inbox.recv_timeout(self.until_wake()) {
                Ok(input) => self.on_input(input),
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => break,
            }
            // Bounded, so that a busy line does not delay deadlines.
            for input in inbox.try_iter().take(BATCH) {
                self.on_input(input);
            }
            if matches!(self.line, LineState::Open(_)) {
                self.drive();
            }
            self.log.handle_timeout(now());
        }
        self.stop.store(true, Ordering::Release);
    }

    fn until_wake(&self) -> Duration {
        let wake = match &self.line {
            LineState::Closed { retry } => Some(*retry).filter(|_| !self.retired),
            LineState::Opening => None,
            LineState::Open(_) => earliest(self.bus.poll_timeout(), self.search),
        };
        let wake = earliest(wake, self.log.poll_timeout());
        wake.map_or(Duration::from_secs(60), |wake| wake.since(now()))
    }

    fn open(&mut self) {
        self.number += 1;
        self.stop = Arc::default();
        self.line = LineState::Opening;
        let (number, inputs) = (self.number, self.ports.inputs.clone());
        let (opener, stop) = (self.opener.clone(), Arc::clone(&self.stop));
        let spawned = std::thread::Builder::new()
            .name(format!("ztl-line-{}", self.name))
            .spawn(move || {
                run_line(&opener, &stop, |event| {
                    inputs.send(Input::Line(number, event)).is_ok()
                });
            });
        if let Err(error) = spawned {
            self.on_closed(&error);
        }
    }

    fn on_input(&mut self, input: Input) {
        match input {
            Input::Line(number, event) if number == self.number => match event {
                LineEvent::Opened(writer) => {
                    self.line = LineState::Open(writer);
                    self.bus.reopen();
                    self.search = Some(now());
                    self.unanswered = 0;
                }
                LineEvent::Bytes(bytes, _permit) => self.bus.handle_bytes(now(), &bytes),
                LineEvent::Closed(error) => self.on_closed(&error),
            },
            Input::Line(..) => {}
            Input::Open(seat, answer) => {
                let _ = answer.send(self.open_port(seat));
            }
            Input::Frames(number, bytes) => {
                if let Some(address) = self.ports.address(number) {
                    self.bus.queue(now(), address, &bytes);
                }
            }
            Input::Close(number) => {
                if let Some(address) = self.ports.address(number) {
                    self.close_port(address, "");
                }
            }
            Input::Retire => (self.retired, self.search) = (true, None),
        }
    }

    fn open_port(&mut self, seat: Arc<Seat>) -> io::Result<Line> {
        let fail = |kind, text: &str| Err(io::Error::new(kind, text.to_owned()));
        if self.retired {
            return fail(io::ErrorKind::NotFound, "the line is not served any more");
        }
        if !matches!(self.line, LineState::Open(_)) {
            let problem = self.status.lock().problem.clone();
            let text = problem.as_deref().unwrap_or("the line is not open yet");
            return fail(io::ErrorKind::NotConnected, text);
        }
        let node = self.nodes.of_seat(&seat);
        if let Some(problem) = node.and_then(|node| node.problem.as_ref()) {
            return fail(io::ErrorKind::AddrInUse, problem);
        }
        let address = seat.address();
        self.bus.add(now(), address);
        if self.damaged.contains_key(&address) {
            self.bus.set_damaged(address);
        }
        Ok(self.ports.open(seat))
    }

    fn close_port(&mut self, address: u8, why: &str) {
        self.ports.close(address, why);
        self.bus.remove(address);
    }

    fn on_closed(&mut self, error: &io::Error) {
        let why = self.opener.why_closed(error);
        self.close(&why);
        self.fail(why);
    }

    /// Closes the line, to open it again.
    fn close(&mut self, why: &str) {
        self.stop.store(true, Ordering::Release);
        // Ignores further inputs of the line.
        self.number += 1;
        self.ports.close_all(why);
        self.search = None;
        // The reading thread still holds the line for a moment.
        let retry = now() + RETRY.max(READ_TIMEOUT * 2);
        self.line = LineState::Closed { retry };
    }

    /// Sets what is wrong now. Returns whether it has changed.
    fn set_problem(&self, problem: Option<String>) -> bool {
        let mut status = self.status.lock();
        status.ready = problem.is_none();
        let before = std::mem::replace(&mut status.problem, problem);
        before != status.problem
    }

    fn warn(&mut self, problem: &str) {
        let text = format!(": {}: {problem}", self.opener.label);
        self.log.log(now(), Severity::Warn, text);
        self.told_ready = false;
    }

    /// The line is not open, or no node answers.
    fn fail(&mut self, problem: String) {
        self.mistakes.clear();
        if self.set_problem(Some(problem.clone())) {
            self.warn(&problem);
        }
    }

    /// Nodes answer. Logs each mistake in their addresses once while it lasts.
    fn on_answered(&mut self) {
        let mistakes = self.nodes.mistakes().to_vec();
        self.set_problem(joined(&mistakes));
        let before = std::mem::replace(&mut self.mistakes, mistakes);
        let new: Vec<String> = self
            .mistakes
            .iter()
            .filter(|it| !before.contains(it))
            .cloned()
            .collect();
        if let Some(new) = joined(&new) {
            self.warn(&new);
        } else if self.mistakes.is_empty() && !std::mem::replace(&mut self.told_ready, true) {
            let text = format!(" is ready at {}: a shared line", self.opener.label);
            self.log.log(now(), Severity::Info, text);
        }
    }

    /// Runs the bus until it waits.
    fn drive(&mut self) {
        self.bus.handle_timeout(now());
        while let Some((address, frame)) = self.bus.poll_frame() {
            self.ports.put(address, frame);
        }
        while let Some(event) = self.bus.poll_event() {
            self.on_event(event);
        }
        for (address, seat) in self.ports.seats() {
            self.bus.set_needs(address, seat.needs());
            seat.set_doubt(self.bus.doubts(address));
        }
        if let Some(at) = self.search
            && (now() >= at || self.ports.want_search())
        {
            self.search = None;
            self.nodes.begun = now();
            self.bus.search(now());
        }
        if let Some(bytes) = self.bus.poll_transmit(now())
            && let LineState::Open(writer) = &mut self.line
            && let Err(error) = writer.write_all(&bytes)
        {
            self.on_closed(&error);
        }
    }

    fn on_event(&mut self, event: BusEvent) {
        match event {
            // Its session finds out.
            BusEvent::Silent(_) => {}
            BusEvent::Garbled(address) => {
                let seat = self.ports.seat(address);
                let node = seat.and_then(|seat| self.nodes.of_seat(seat));
                let name = node.map_or("a node", |node| &node.name).to_owned();
                let text = "damaged: noise, or two nodes with this address";
                self.log_answers(Severity::Warn, address, &name, text);
                self.damaged.insert(address, name);
                self.search = self.search.map(|at| at.min(now()));
            }
            BusEvent::Intact(address) => {
                if let Some(name) = self.damaged.remove(&address) {
                    self.log_answers(Severity::Info, address, &name, "intact again");
                }
            }
            BusEvent::Found(found) => self.on_found(&found, NOTHING),
            BusEvent::Noise => self.on_found(&[], NOISE),
        }
    }

    fn log_answers(&mut self, severity: Severity, address: u8, name: &str, what: &str) {
        let text = format!(": the answers of '{name}' at address {address} are {what}");
        self.log.log(now(), severity, text);
    }

    /// Nodes that are not served are not asked any more, so their answers do not become intact.
    fn end_damage(&mut self) {
        let nodes = &self.nodes;
        let mut over = Vec::new();
        self.damaged.retain(|&address, name| {
            let asked = self.ports.seat(address).is_some() || nodes.is_served(name);
            if !asked {
                over.push((address, std::mem::take(name)));
            }
            asked
        });
        for (address, name) in over {
            let text = "not asked for any more: the node is not served there";
            self.log_answers(Severity::Info, address, &name, text);
        }
    }

    /// `nothing` says what there is instead of nodes.
    fn on_found(&mut self, found: &[Found], nothing: &str) {
        let changes = self.nodes.update(found);
        for (id, address, why) in changes.closed {
            if self.is_open(id, address) {
                self.close_port(address, &why);
            }
        }
        for (id, address, why) in changes.shared {
            if self.is_open(id, address) && !self.ports.is_busy(address) {
                self.close_port(address, &why);
            }
        }
        for index in changes.new {
            if let Some(node) = self.nodes.get(index) {
                self.serve(node);
            }
        }
        self.end_damage();
        if !found.is_empty() || !self.nodes.mistakes().is_empty() {
            self.unanswered = 0;
            self.on_answered();
        } else if self.bus.is_answered() {
            // On a busy machine, the answers to a search may be late.
            self.unanswered = 0;
        } else {
            self.unanswered += 1;
            if self.unanswered >= TELL {
                self.fail(nothing.to_owned());
            }
            if self.opener.may_be_half_open && self.unanswered >= SEARCHES {
                return self.close(nothing);
            }
        }
        let soon = found.is_empty() || self.nodes.has_unaddressed();
        let pause = if soon { SEARCH.0 } else { SEARCH.1 };
        self.search = Some(now() + pause).filter(|_| !self.retired);
    }

    /// Whether this node is served at the address: another one may be there already.
    fn is_open(&self, id: u64, address: u8) -> bool {
        let node = self.nodes.of_id(id);
        node.is_some_and(|node| self.ports.has(address, &node.seat))
    }

    /// Serves a new node as a device.
    fn serve(&self, node: &Node) {
        let name = format!("{}.{}", self.name, node.name);
        let (seat, inputs) = (Arc::clone(&node.seat), self.ports.inputs.clone());
        let wanted = Arc::clone(&seat);
        let opener = Opener {
            seat: Some(seat),
            path: None,
            open: Arc::new(move || open(&inputs, &wanted)),
            // The line is opened again for all nodes at once.
            may_be_half_open: false,
            ..self.opener.clone()
        };
        if let Err(error) = (self.add_node)(&name, opener, &self.status) {
            tracing::warn!(target: crate::log_targets::GATEWAY, device = name, "Device '{name}' is not served: {error}");
        }
    }
}

/// Opens a node's port, on a thread of its device.
fn open(inputs: &Sender<Input>, seat: &Arc<Seat>) -> io::Result<Line> {
    let ended = || io::Error::new(io::ErrorKind::NotFound, "the line is not served any more");
    let (answer, opened) = channel();
    let sent = inputs.send(Input::Open(Arc::clone(seat), answer));
    sent.map_err(|_| ended())?;
    opened.recv_timeout(PORT).map_err(|_| ended())?
}

#[cfg(test)]
mod tests;
