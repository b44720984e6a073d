//! A shared line: the wire, the gateway's bus, and when each node has its turn.

use std::time::Duration;

use ztl_core::Instant;
use ztl_core::link::{ADDR_ALL, ADDR_NONE, NO_SEQ, Turn};
use ztl_core::time::earliest;
use ztl_link::BusNeeds;
use ztl_link::bus::TURNAROUND;
use ztl_sim::line::HalfDuplex;

use super::device::Device;
use super::gateway::{BAUD, Gateway, address};
use super::master::Master;
use super::some_node::{id, second_id};

/// Pause between two searches, as the gateway's.
const SEARCH: Duration = Duration::from_secs(3);
/// A node that does not answer this often in a row is asked less often, also for an `Abort`.
const SILENCE: u32 = 3;
/// Bytes are heard in pieces of about this duration.
const BURST: Duration = Duration::from_millis(1);
/// The gateway's end of the wire; the nodes have the next ones.
const GATEWAY: usize = 0;
/// The tags of `Start` and `Abort`.
const URGENT: [u8; 2] = [2, 3];

/// A command that waits for the line.
struct Waiting {
    bytes: Vec<u8>,
    urgent: bool,
    since: Instant,
}

/// What the line has done for one node.
struct Turns {
    /// When it was polled last, or since when that counts.
    polled: Instant,
    needs: BusNeeds,
    waiting: Option<Waiting>,
    /// The command of the last question.
    sent: Vec<u8>,
    /// Questions since its last undamaged answer.
    unanswered: u32,
    /// Longest time between two polls while it was busy.
    longest: Duration,
}

pub(super) struct SharedLine {
    pub(super) wire: HalfDuplex,
    /// `None` while the line is closed or the gateway is killed.
    master: Option<Master>,
    /// When the next search begins, and when the last one did.
    search: Option<Instant>,
    begun: Instant,
    /// Whether one is to begin as soon as possible.
    wanted: bool,
    nodes: Vec<Turns>,
    /// Whom the last question was for, and what the gateway has heard since.
    asked: Option<usize>,
    heard: Vec<u8>,
    /// Until when an answer may begin, and whether it has.
    until: Instant,
    in_turn: bool,
    /// What the last search found, by id and address.
    pub(super) found: Vec<(u64, u8)>,
    /// The longest time until a `Start` or an `Abort` was sent.
    urgent: Duration,
}

impl SharedLine {
    pub(super) fn new(now: Instant, nodes: usize, seed: u64) -> Self {
        let turns = || Turns {
            polled: now,
            needs: BusNeeds::default(),
            waiting: None,
            sent: Vec::new(),
            unanswered: 0,
            longest: Duration::ZERO,
        };
        Self {
            wire: HalfDuplex::new(BAUD, seed),
            master: None,
            search: None,
            begun: now,
            wanted: false,
            nodes: std::iter::repeat_with(turns).take(nodes).collect(),
            asked: None,
            heard: Vec::new(),
            until: now,
            in_turn: false,
            found: Vec::new(),
            urgent: Duration::ZERO,
        }
    }

    /// The gateway opens the line.
    pub(super) fn open(&mut self, now: Instant) {
        self.master = Some(Master::new(now, self.nodes.len() as u8));
        (self.search, self.wanted) = (Some(now), false);
        for node in &mut self.nodes {
            (node.waiting, node.unanswered, node.polled) = (None, 0, now);
            node.sent.clear();
            node.needs = BusNeeds::default();
        }
    }

    /// The line is closed, and loses what is on it.
    pub(super) fn close(&mut self) {
        self.wire.clear();
        self.abandon();
    }

    /// The gateway is killed.
    pub(super) fn abandon(&mut self) {
        self.master = None;
        self.search = None;
        self.asked = None;
    }

    pub(super) fn poll_timeout(&self) -> Option<Instant> {
        let master = self.master.as_ref().and_then(Master::poll_timeout);
        [self.wire.poll_timeout(BURST), self.search]
            .into_iter()
            .fold(master, earliest)
    }

    /// From now on, turns are measured.
    pub(super) fn watch(&mut self, now: Instant) {
        self.urgent = Duration::ZERO;
        for node in &mut self.nodes {
            (node.polled, node.longest) = (now, Duration::ZERO);
        }
    }

    /// The longest time until a `Start` or an `Abort` was sent.
    pub(super) const fn urgent(&self) -> Duration {
        self.urgent
    }

    /// The longest time without a turn of these nodes while they were busy.
    pub(super) fn longest(&self, now: Instant, of: impl Fn(&usize) -> bool) -> Duration {
        let nodes = self.nodes.iter().enumerate().filter(|(node, _)| of(node));
        let pauses = nodes.map(|(_, node)| {
            let open = if node.needs.busy {
                now.since(node.polled)
            } else {
                Duration::ZERO
            };
            node.longest.max(open)
        });
        pauses.max().unwrap_or_default()
    }

    /// Carries bytes from the nodes to the wire, from there to the nodes and the bus, and its frames to the sessions.
    pub(super) fn receive(
        &mut self,
        now: Instant,
        mut devices: Vec<&mut Device>,
        gateway: Option<&mut Gateway>,
    ) {
        for (number, device) in devices.iter_mut().enumerate() {
            if device.is_due(now) {
                let sent = device.arrived(now);
                self.wire.send(now, number + 1, &sent);
            }
        }
        let due = self.wire.poll_timeout(BURST).is_some_and(|at| at <= now);
        for piece in due.then(|| self.wire.poll(now)).into_iter().flatten() {
            for (number, device) in devices.iter_mut().enumerate() {
                if !piece.senders.contains(&(number + 1)) {
                    device.send(now, &piece.bytes);
                }
            }
            if let (Some(master), false) = (&mut self.master, piece.senders.contains(&GATEWAY)) {
                master.handle_bytes(now, &piece.bytes);
                self.on_heard(now, &piece.bytes);
            }
        }
        let (Some(master), Some(gateway)) = (&mut self.master, gateway) else {
            return;
        };
        master.handle_timeout(now);
        while let Some((from, frame)) = master.poll_frame() {
            let from = usize::from(from).wrapping_sub(1);
            // Noise may be from any address.
            let Some(session) = gateway.sessions.get_mut(from) else {
                continue;
            };
            session.handle_bytes(now, &frame);
            if self.in_turn && self.asked == Some(from) {
                self.nodes[from].unanswered = 0;
            }
        }
    }

    /// Carries what the sessions transmit to the bus, and its questions to the wire.
    ///
    /// # Errors
    /// A question that must not be asked yet.
    pub(super) fn transmit(
        &mut self,
        now: Instant,
        gateway: Option<&mut Gateway>,
    ) -> Result<(), String> {
        let (Some(master), Some(gateway)) = (&mut self.master, gateway) else {
            return Ok(());
        };
        if let Some(found) = master.poll_found() {
            self.search = Some(now + SEARCH);
            let wrong = |(known, at): &&(u64, u8)| {
                *at != ADDR_NONE && *known != id(*at) && *known != second_id(*at)
            };
            if let Some((known, at)) = found.iter().find(wrong) {
                return Err(format!("a search finds {known:x} at {at}"));
            }
            gateway.on_search((self.begun, now), &found);
            self.found = found;
        }
        // Another boot answers.
        self.wanted |= gateway.check_boards(now);
        if let Some(at) = &mut self.search
            && std::mem::take(&mut self.wanted)
        {
            *at = now;
        }
        for (number, session) in gateway.sessions.iter_mut().enumerate() {
            let bytes = session.poll_transmit();
            let needs = session.bus_needs();
            let node = &mut self.nodes[number];
            if !bytes.is_empty() || node.needs != needs {
                master.queue(now, address(number), &bytes);
                master.set_needs(address(number), needs);
                node.queue(now, &bytes, needs);
            }
        }
        if self.search.is_some_and(|at| now >= at) {
            (self.search, self.begun) = (None, now);
            master.search(now);
        }
        match master.poll_transmit(now) {
            Some(bytes) => {
                self.wire.send(now, GATEWAY, &bytes);
                self.on_question(now, &bytes)
            }
            None => Ok(()),
        }
    }

    /// The gateway hears something.
    fn on_heard(&mut self, now: Instant, bytes: &[u8]) {
        self.in_turn |= self.heard.is_empty() && now <= self.until;
        self.heard.extend(bytes);
        let Some(number) = self.asked else {
            return;
        };
        let node = &mut self.nodes[number];
        let idle = Turn::Idle.encode(address(number));
        if self.in_turn && self.heard.windows(idle.len()).any(|heard| heard == idle) {
            node.unanswered = 0;
        }
    }

    fn on_question(&mut self, now: Instant, bytes: &[u8]) -> Result<(), String> {
        let mut frames = bytes.rsplit(|byte| *byte == 0);
        let Some(last) = frames.find(|frame| !frame.is_empty()) else {
            return Ok(());
        };
        if let Some(before) = self.asked.filter(|_| !self.heard.is_empty()) {
            // The bus drops a repetition of what was answered, even if that is damaged.
            let node = &mut self.nodes[before];
            node.waiting.take_if(|waiting| waiting.bytes == node.sent);
        }
        let head = unstuffed(last);
        let to = head.first().copied().unwrap_or(ADDR_ALL);
        self.heard.clear();
        self.in_turn = false;
        let bits = 10 * bytes.len() as u32;
        self.until = now + Duration::from_secs(1) * bits / BAUD + TURNAROUND;
        self.asked = (to != ADDR_ALL).then(|| usize::from(to) - 1);
        let polls = head.len() == 2;
        let asked = self.asked.and_then(|node| self.nodes.get_mut(node));
        if let Some(node) = asked {
            node.unanswered += 1;
            if polls {
                node.sent.clear();
                if node.needs.busy {
                    node.longest = node.longest.max(now.since(node.polled));
                }
                node.polled = now;
            } else {
                node.sent = last.to_vec();
                node.sent.push(0);
                if let Some(waiting) = node.waiting.take()
                    && waiting.urgent
                {
                    self.urgent = self.urgent.max(now.since(waiting.since));
                }
                return Ok(());
            }
        }
        match self.nodes.iter().position(Turns::is_urgent) {
            Some(node) => Err(format!(
                "turn: a Start or an Abort for device {node} waits, and another question is asked"
            )),
            None => Ok(()),
        }
    }
}

impl Turns {
    /// What the node's session transmits.
    fn queue(&mut self, now: Instant, bytes: &[u8], needs: BusNeeds) {
        if needs.busy && !self.needs.busy {
            self.polled = now;
        }
        self.needs = needs;
        for frame in bytes.split_inclusive(|byte| *byte == 0) {
            let head = unstuffed(frame);
            let [_, seq, tag, ..] = head[..] else {
                continue;
            };
            if seq == NO_SEQ && tag != 0 {
                continue;
            }
            let since = self.waiting.take().filter(|waiting| waiting.bytes == frame);
            self.waiting = Some(Waiting {
                bytes: frame.to_vec(),
                urgent: seq != NO_SEQ && URGENT.contains(&tag),
                since: since.map_or(now, |waiting| waiting.since),
            });
        }
    }

    /// Whether a command waits that goes before all polls.
    fn is_urgent(&self) -> bool {
        let urgent = |waiting: &Waiting| waiting.urgent || self.needs.urgent;
        self.unanswered < SILENCE && self.waiting.as_ref().is_some_and(urgent)
    }
}

/// The frame without its byte stuffing (`docs/link.md`, 1.2).
fn unstuffed(frame: &[u8]) -> Vec<u8> {
    let mut out = Vec::new();
    let mut rest = frame;
    while let Some((&count, after)) = rest.split_first() {
        let many = usize::from(count).saturating_sub(1).min(after.len());
        if count == 0 {
            break;
        }
        out.extend(&after[..many]);
        rest = &after[many..];
        if count < 0xFF && rest.first().is_some_and(|next| *next != 0) {
            out.push(0);
        }
    }
    out
}
