//! The gateway's end of a shared, half-duplex line, without I/O: it decides which node is asked next.
//!
//! A node sends only when it is asked, and then sends one frame. So the bus delays the frames of its nodes' sessions,
//! and may lose them like any other line, but needs no rule of its own for tasks. See `docs/link.md`, section 15.

mod boards;
mod member;
mod search;

use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

use ztl_core::Instant;
use ztl_core::link::{BusMessage, Decoder, Turn};
use ztl_core::time::earliest;

use crate::session::{BusNeeds, FRAME};
use member::Member;
use search::{Polled, Search, Seen};

pub use boards::{Boards, KnownBoard, LastSearch};
pub use search::Found;

/// How long after a question the answer may begin, by default: a node takes at most 4 ms, an adapter on USB some more.
pub const TURNAROUND: Duration = Duration::from_millis(8);
/// How long after a question a node begins its answer at the latest.
const BEGINS: Duration = Duration::from_millis(4);
/// Pause before the next question, so that the last speaker has switched its transceiver off.
const GAP: Duration = Duration::from_micros(300);
/// A search waits at most this long for other questions, if they leave time for it.
const SEARCH_WITHIN: Duration = Duration::from_millis(100);
/// Most bytes of a question of a search, and of a poll with its answer: a progress of four characters.
const SEARCH_BYTES: usize = 22;
const POLL_BYTES: usize = 20;
/// How long a node takes to answer, nearly always.
const ANSWER: Duration = Duration::from_micros(500);

/// What has happened on a bus.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum BusEvent {
    /// The node with this address has not answered for a while.
    Silent(u8),
    /// The answers from this address are damaged: by noise, or because two nodes have this address.
    Garbled(u8),
    /// They are intact again.
    Intact(u8),
    /// A search has ended: all nodes that answered, by their ids. Two may have one address.
    Found(Vec<Found>),
    /// A search has ended that no node has answered, but there was noise on the line.
    Noise,
}

/// Who was asked, and until when the answer may come.
#[derive(Debug, Clone)]
struct Question {
    /// `None` in a search, which asks all nodes.
    address: Option<u8>,
    sent: Vec<Vec<u8>>,
    /// The next byte must arrive before this.
    deadline: Instant,
    /// The answer ends before this time, even if bytes still arrive.
    limit: Instant,
}

/// A shared line with the nodes at its addresses.
///
/// *Inputs*: [`queue`](Self::queue) what each node's [`Session`](crate::Session) transmits,
/// [`handle_bytes`](Self::handle_bytes), [`handle_timeout`](Self::handle_timeout). *Outputs*, to empty after each of them:
/// [`poll_transmit`](Self::poll_transmit), [`poll_frame`](Self::poll_frame) for the sessions,
/// [`poll_event`](Self::poll_event). *Next wake-up*: [`poll_timeout`](Self::poll_timeout).
#[derive(Debug, Clone)]
pub struct Bus {
    /// Time of one byte on the line.
    byte_time: Duration,
    turnaround: Duration,
    members: BTreeMap<u8, Member>,
    search: Option<Search>,
    /// The addresses that searches have given, each with the id of the last node that took it.
    given: BTreeMap<u8, u64>,
    seen: Seen,
    rounds: u8,
    question: Option<Question>,
    /// Nothing is sent before this.
    quiet_at: Instant,
    decoder: Decoder<FRAME>,
    /// The bytes of the frame in the decoder.
    raw: Vec<u8>,
    frames: VecDeque<(u8, Vec<u8>)>,
    events: VecDeque<BusEvent>,
}

/// What is sent next.
enum Choice {
    Member { address: u8, poll: bool },
    Search,
}

impl Bus {
    /// A line without nodes. `turnaround` is how long after a question an answer may begin.
    #[must_use]
    pub fn new(baud: u32, turnaround: Duration) -> Self {
        Self {
            byte_time: Duration::from_nanos(10_000_000_000 / u64::from(baud.max(1))),
            turnaround,
            members: BTreeMap::new(),
            search: None,
            given: BTreeMap::new(),
            seen: Seen::default(),
            rounds: 0,
            question: None,
            quiet_at: Instant::ZERO,
            decoder: Decoder::new(),
            raw: Vec::new(),
            frames: VecDeque::new(),
            events: VecDeque::new(),
        }
    }

    /// Begins again without nodes, on a line that was opened again. The addresses that searches have given and found stay.
    pub fn reopen(&mut self) {
        *self = Self {
            byte_time: self.byte_time,
            given: std::mem::take(&mut self.given),
            seen: std::mem::take(&mut self.seen),
            rounds: self.rounds,
            ..Self::new(1, self.turnaround)
        };
    }

    /// Adds the node at an address, 1 to [`ADDR_MOST`](ztl_core::link::ADDR_MOST).
    pub fn add(&mut self, now: Instant, address: u8) {
        self.members.insert(address, Member::new(now));
    }

    /// The answers from this address were damaged before the node was added: the next event says that they are intact.
    pub fn set_damaged(&mut self, address: u8) {
        if let Some(member) = self.members.get_mut(&address) {
            member.damaged = true;
        }
    }

    /// Removes the node at an address: it is not asked any more.
    pub fn remove(&mut self, address: u8) {
        self.members.remove(&address);
    }

    /// Whether a node answers its questions. A search that finds none says nothing then.
    #[must_use]
    pub fn is_answered(&self) -> bool {
        self.members.values().any(Member::answers)
    }

    /// Whether a node that was found at this address has answered with another one, too, until a search has polled both.
    #[must_use]
    pub fn doubts(&self, address: u8) -> bool {
        let search = self.search.as_ref();
        search.map_or(&self.seen, Search::seen).doubts(address)
    }

    /// Queues frames for a node: what its session transmits. A newer command replaces an older one that was not sent.
    pub fn queue(&mut self, now: Instant, address: u8, bytes: &[u8]) {
        if let Some(member) = self.members.get_mut(&address) {
            for frame in bytes.split_inclusive(|&byte| byte == 0) {
                member.queue(now, frame);
            }
        }
    }

    /// What a node's session needs: a node with tasks is polled at least every 50 ms, and a command goes before all polls
    /// if a `Start` or an `Abort` waits for its answer.
    pub fn set_needs(&mut self, address: u8, needs: BusNeeds) {
        if let Some(member) = self.members.get_mut(&address) {
            member.needs = needs;
        }
    }

    /// Begins a search for all nodes, also for those that have no address; they get free ones. A search that runs goes on.
    pub fn search(&mut self, now: Instant) {
        if self.search.is_none() {
            self.rounds = self.rounds.wrapping_add(1);
            let taken = self.members.keys().copied().collect();
            let given = self.given.clone();
            let seen = self.seen.clone();
            self.search = Some(Search::new(self.rounds, taken, given, seen, now));
        }
    }

    /// Handles received bytes.
    pub fn handle_bytes(&mut self, now: Instant, bytes: &[u8]) {
        if bytes.is_empty() {
            return;
        }
        for &byte in bytes {
            if self.raw.len() < 2 * FRAME {
                self.raw.push(byte);
            }
            let complete = self.decoder.push(byte);
            if byte != 0 {
                continue;
            }
            let raw = std::mem::take(&mut self.raw);
            if raw.len() > 1 && !self.is_echo(&raw) {
                self.on_frame(now, raw, complete.is_ok_and(|complete| complete));
            }
        }
        // A node is sending: asks no other node before there is a pause.
        self.quiet_at = self.quiet_at.max(now + GAP);
        // Within an answer, only the adapter pauses, so that a damaged one costs little more time than none.
        let pause = (self.turnaround.saturating_sub(BEGINS)).max(self.turnaround / 2);
        if let Some(question) = &mut self.question {
            question.deadline = question.deadline.max(now + pause).min(question.limit);
        }
    }

    /// Whether the frame is what was just sent: some transceivers hear themselves.
    fn is_echo(&mut self, raw: &[u8]) -> bool {
        let Some(question) = &mut self.question else {
            return false;
        };
        let echo = question.sent.iter().position(|sent| sent == raw);
        echo.map(|at| question.sent.remove(at)).is_some()
    }

    fn on_frame(&mut self, now: Instant, raw: Vec<u8>, intact: bool) {
        let message = self.decoder.bus_message();
        let from = self.decoder.address().filter(|_| intact);
        let asked = self.question.as_ref().map(|question| question.address);
        let found = match (intact, message) {
            (true, Ok((address, BusMessage::Here { id, name }))) => Some(Found {
                id,
                address,
                name: name.to_owned(),
            }),
            _ => None,
        };
        match asked {
            // Too late for its turn, but no less true.
            None => {
                match (&found, &mut self.search) {
                    (None, _) => self.frames.extend(from.map(|from| (from, raw))),
                    (Some(found), Some(search)) => search.hear(found),
                    (Some(found), None) => self.seen.hear(found.id, found.address),
                }
                return;
            }
            Some(None) => {
                if let Some(search) = &mut self.search {
                    match (search.polled(), found) {
                        (Some(_), Some(found)) => {
                            search.hear(&found);
                            search.on_polled(Polled::Damaged);
                        }
                        (Some(polled), None) if from == Some(polled) => {
                            search.on_polled(Polled::Intact);
                            let idle = self.decoder.turn() == Some((polled, Turn::Idle));
                            self.frames.extend((!idle).then_some((polled, raw)));
                        }
                        (Some(_), None) => search.on_polled(Polled::Damaged),
                        (None, Some(found)) => search.on_answer(found),
                        (None, None) => search.on_collision(),
                    }
                }
            }
            Some(Some(address)) => {
                let idle = self.decoder.turn() == Some((address, Turn::Idle));
                let valid = from == Some(address);
                if let Some(member) = self.members.get_mut(&address) {
                    self.events.extend(member.on_answer(address, valid, idle));
                }
                if valid && !idle {
                    self.frames.push_back((address, raw));
                }
            }
        }
        self.end_turn(now);
    }

    fn end_turn(&mut self, now: Instant) {
        self.question = None;
        self.quiet_at = now + GAP;
        if let Some(mut search) = self.search.take_if(|search| search.has_ended()) {
            search.finish();
            self.seen.clone_from(search.seen());
            self.given.clone_from(search.given());
            self.events.push_back(search.into_event());
        }
    }

    /// Gives up a question without an answer.
    pub fn handle_timeout(&mut self, now: Instant) {
        let Some(question) = self.question.take_if(|question| now >= question.deadline) else {
            return;
        };
        let partial = !self.raw.is_empty();
        self.decoder.reset();
        self.raw.clear();
        match question.address {
            None => {
                if let Some(search) = &mut self.search {
                    match (search.polled().is_some(), partial) {
                        (true, true) => search.on_polled(Polled::Damaged),
                        (true, false) => search.on_polled(Polled::Silent),
                        (false, true) => search.on_collision(),
                        (false, false) => search.on_silence(),
                    }
                }
            }
            Some(address) => {
                if let Some(member) = self.members.get_mut(&address) {
                    let event = if partial {
                        member.on_answer(address, false, false)
                    } else {
                        member.on_silence(now).then_some(BusEvent::Silent(address))
                    };
                    self.events.extend(event);
                }
            }
        }
        self.end_turn(now);
    }

    /// The next question, if the line is free. Send it at once.
    pub fn poll_transmit(&mut self, now: Instant) -> Option<Vec<u8>> {
        if self.question.is_some() || now < self.quiet_at {
            return None;
        }
        let fits = self.search_fits(now);
        if let Some(search) = &mut self.search {
            search.set_waiting(!fits);
        }
        let (address, sent) = match self.choose(now)? {
            Choice::Member { address, poll } => {
                let member = self.members.get_mut(&address)?;
                (Some(address), member.take(now, address, poll))
            }
            Choice::Search => (None, vec![self.search.as_mut()?.question(now)]),
        };
        // The first delimiter ends noise of transceivers that were switched.
        let mut bytes = vec![0];
        bytes.extend(sent.iter().flatten());
        let deadline = now + self.time_of(bytes.len()) + self.turnaround;
        self.question = Some(Question {
            address,
            sent,
            deadline,
            limit: deadline + self.time_of(2 * FRAME),
        });
        Some(bytes)
    }

    fn time_of(&self, bytes: usize) -> Duration {
        self.byte_time * u32::try_from(bytes).unwrap_or(u32::MAX)
    }

    /// Whether no command waits, and all nodes with tasks have their turn in time after a question of a search without an
    /// answer, even if all of them have something to say.
    fn search_fits(&self, now: Instant) -> bool {
        if self.members.values().any(|member| member.has_command(now)) {
            return false;
        }
        let mut turns: Vec<Instant> = self.members.values().flat_map(Member::latest).collect();
        turns.sort_unstable();
        let poll = self.time_of(POLL_BYTES) + ANSWER + GAP;
        let search = self.time_of(SEARCH_BYTES) + self.turnaround + GAP;
        let mut begins = now + search;
        turns.into_iter().all(|latest| {
            let fits = begins <= latest;
            begins = begins + poll;
            fits
        })
    }

    /// The most urgent question that may be asked now.
    fn choose(&self, now: Instant) -> Option<Choice> {
        let members = self.members.iter().flat_map(|(&address, member)| {
            let ready = member.next().filter(|next| next.ready <= now);
            ready.map(move |next| {
                let poll = next.poll;
                (!next.urgent, next.due, Choice::Member { address, poll })
            })
        });
        let search = self.search.as_ref();
        let search = search.filter(|search| search.ready() <= now).map(|search| {
            let due = search.asked() + SEARCH_WITHIN;
            (true, due, Choice::Search)
        });
        let all = members.chain(search);
        let first = all.min_by_key(|(patient, due, _)| (*patient, *due));
        first.map(|(.., choice)| choice)
    }

    /// The next frame of a node, for its session.
    pub fn poll_frame(&mut self) -> Option<(u8, Vec<u8>)> {
        self.frames.pop_front()
    }

    /// The next event.
    pub fn poll_event(&mut self) -> Option<BusEvent> {
        self.events.pop_front()
    }

    /// When to call [`handle_timeout`](Self::handle_timeout) and [`poll_transmit`](Self::poll_transmit).
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Instant> {
        if let Some(question) = &self.question {
            return Some(question.deadline);
        }
        let mut wake = self.search.as_ref().map(Search::ready);
        for next in self.members.values().flat_map(Member::next) {
            wake = earliest(wake, Some(next.ready));
        }
        wake.map(|wake| wake.max(self.quiet_at))
    }
}
