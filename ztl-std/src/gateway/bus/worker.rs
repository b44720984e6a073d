//! What a shared line's thread does: runs the line and its bus, and adds the nodes that it finds.

use std::io::{self, Write};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::time::Duration;

use ztl_core::Instant;
use ztl_core::time::earliest;
use ztl_link::bus::{Bus, BusEvent, Found};

use super::nodes::{Node, Nodes};
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
    /// A bus without nodes, for each opened line.
    empty: Bus,
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
    retired: bool,
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
            empty: bus.clone(),
            bus,
            line: LineState::Closed { retry: now() },
            stop: Arc::default(),
            number: 0,
            ports,
            nodes: Nodes::default(),
            search: None,
            unanswered: 0,
            retired: false,
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
                    self.bus = self.empty.clone();
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
                    self.close_port(address);
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
        self.bus.add(now(), seat.address());
        Ok(self.ports.open(seat))
    }

    fn close_port(&mut self, address: u8) {
        self.ports.close(address);
        self.bus.remove(address);
    }

    fn on_closed(&mut self, error: &io::Error) {
        self.close();
        self.set_problem(Some(error.to_string()));
    }

    /// Closes the line, to open it again.
    fn close(&mut self) {
        self.stop.store(true, Ordering::Release);
        self.ports.close_all();
        self.search = None;
        // The reading thread still holds the line for a moment.
        let retry = now() + RETRY.max(READ_TIMEOUT * 2);
        self.line = LineState::Closed { retry };
    }

    fn set_problem(&mut self, problem: Option<String>) {
        let mut status = self.status.lock();
        let changed = status.problem != problem;
        let was_ready = status.ready;
        status.ready = problem.is_none();
        status.problem.clone_from(&problem);
        drop(status);
        let url = &self.opener.label;
        match problem {
            Some(problem) if changed => {
                let text = format!(": {url}: {problem}");
                self.log.log(now(), Severity::Warn, text);
            }
            None if !was_ready => {
                let text = format!(" is ready at {url}: a shared line");
                self.log.log(now(), Severity::Info, text);
            }
            _ => {}
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
                let name = self.nodes.at(address).map_or("a node", |node| &node.name);
                let text = format!(
                    ": the answers of '{name}' at address {address} are damaged: noise, or two nodes with this address"
                );
                self.log.log(now(), Severity::Warn, text);
                self.search = self.search.map(|at| at.min(now()));
            }
            BusEvent::Found(found) => self.on_found(&found, NOTHING),
            BusEvent::Noise => self.on_found(&[], NOISE),
        }
    }

    /// `nothing` says what there is instead of nodes.
    fn on_found(&mut self, found: &[Found], nothing: &str) {
        let changes = self.nodes.update(found);
        for address in changes.closed {
            self.close_port(address);
        }
        for address in changes.shared {
            if !self.ports.is_busy(address) {
                self.close_port(address);
            }
        }
        for index in changes.new {
            if let Some(node) = self.nodes.get(index) {
                self.serve(node);
            }
        }
        let problem = match found.is_empty() {
            true => Some(nothing.to_owned()),
            false => self.nodes.problem().cloned(),
        };
        self.set_problem(problem);
        if !found.is_empty() {
            self.unanswered = 0;
        } else {
            self.unanswered += 1;
            if self.opener.may_be_half_open && self.unanswered >= SEARCHES {
                return self.close();
            }
        }
        let pause = if found.is_empty() { SEARCH.0 } else { SEARCH.1 };
        self.search = Some(now() + pause).filter(|_| !self.retired);
    }

    /// Serves a new node as a device.
    fn serve(&self, node: &Node) {
        let name = format!("{}.{}", self.name, node.name);
        let (seat, inputs) = (Arc::clone(&node.seat), self.ports.inputs.clone());
        let wanted = Arc::clone(&seat);
        let opener = Opener {
            label: format!("{}, address {}", self.opener.label, seat.address()),
            seat: Some(seat),
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
