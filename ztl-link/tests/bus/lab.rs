//! A shared line: one slot of time for each byte. Bytes that are sent in one slot collide.

use std::cell::RefCell;
use std::collections::{BTreeMap, VecDeque};
use std::rc::Rc;
use std::time::Duration;

use ztl_core::link::update::UpdatePhase;
use ztl_core::link::{Decoder, Loss, Turn};
use ztl_core::{Instant, State, TaskId};
use ztl_link::bus::{Bus, BusEvent, TURNAROUND};
use ztl_link::{LinkEvent, Session, UpdateReply, UpdateRequest};
use ztl_mcu::bus::OnBus;
use ztl_mcu::link::Offer;
use ztl_mcu::update::{Firmware, Receiving, Updatable, UpdateError, Updater, Verification};
use ztl_mcu::{Component, Identity, Node, Reading, Refused, Report, Run};
use ztl_sim::line::Dice;

const BAUD: u32 = 115_200;
/// Of one byte, in ns.
const SLOT: u64 = 10_000_000_000 / BAUD as u64;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Trouble {
    /// Always has a reading, as long as fits.
    Floods,
    /// Has lost its power.
    Silent,
    /// Its wires are broken.
    Cut,
    /// Resets every 100 ms.
    Resets,
    /// Sends bytes without being asked, a fifth of the time.
    Babbles,
}

#[derive(Default)]
pub(crate) struct World {
    begun: BTreeMap<String, u32>,
    moving: Option<String>,
    stopped_early: Vec<String>,
    floods: bool,
    pub(crate) carries_on: bool,
}

/// Firmware that takes updates.
type Parts = Updatable<OnBus<[Motor; 1]>, Flash>;

/// Counts what it receives.
pub(crate) struct Flash;

/// Length of an image.
pub(crate) const IMAGE: u32 = 4 << 10;

impl Updater for Flash {
    fn firmware(&self) -> Firmware<'_> {
        Firmware {
            board: "desk",
            version: "1",
            confirmed: true,
            trial_ms: 0,
            self_test: None,
        }
    }

    fn begin(&mut self, _: &[u8], _: bool) -> Result<Receiving, UpdateError> {
        Ok(Receiving {
            length: IMAGE,
            offset: 0,
        })
    }

    fn write(&mut self, _: u32, _: &[u8]) -> Result<(), UpdateError> {
        Ok(())
    }

    fn verify(&mut self) -> Result<Verification, UpdateError> {
        Ok(Verification::Done)
    }

    fn restart(&mut self) {}

    fn confirm(&mut self) -> Result<(), UpdateError> {
        Ok(())
    }
}

/// A goal is `NUMBER MILLISECONDS`.
#[derive(Clone)]
struct Motor {
    world: Rc<RefCell<World>>,
    ends_at: Instant,
    aborted: bool,
}

impl Component for Motor {
    fn offer(&self) -> Offer<'_> {
        let offer = Offer::new("motor").with_topics("place");
        match self.world.borrow().carries_on {
            true => offer.with_loss(Loss::CarryOn),
            false => offer,
        }
    }

    fn check(&self, _: &str, _: &mut Report<'_>) -> Result<(), Refused> {
        Ok(())
    }

    fn start(&mut self, now: Instant, goal: &str, _: &mut Report<'_>) -> Result<(), Refused> {
        let millis = goal.split_once(' ').unwrap().1.parse().unwrap();
        let mut world = self.world.borrow_mut();
        *world.begun.entry(goal.to_owned()).or_default() += 1;
        world.moving = Some(goal.to_owned());
        self.ends_at = now + Duration::from_millis(millis);
        self.aborted = false;
        Ok(())
    }

    fn poll(&mut self, now: Instant, report: &mut Report<'_>) -> Run {
        report.number((now.as_millis() % 1000) as f32 / 10.0, 1);
        let mut world = self.world.borrow_mut();
        if self.aborted {
            let goal = world.moving.take();
            world.stopped_early.extend(goal);
            return Run::Aborted;
        }
        if now >= self.ends_at {
            world.moving = None;
            return Run::Completed;
        }
        Run::Running
    }

    fn abort(&mut self, _: Instant) {
        self.aborted = true;
    }

    fn make_safe(&mut self, _: Instant) {
        self.aborted = true;
    }

    fn poll_reading(&mut self, _: Instant, buffer: &mut [u8]) -> Option<Reading> {
        let floods = self.world.borrow().floods;
        floods.then(|| {
            buffer.fill(b'x');
            Reading {
                topic: 0,
                len: buffer.len(),
            }
        })
    }
}

pub(crate) struct Member {
    id: u64,
    address: u8,
    node: Node<'static, Parts, 4, 128>,
    pub(crate) world: Rc<RefCell<World>>,
    sending: VecDeque<u8>,
    /// Between two turns of its main loop, in slots.
    pace: u64,
    pub(crate) trouble: Option<Trouble>,
    turns: Vec<Instant>,
}

impl Member {
    pub(crate) fn moves(&self) -> bool {
        self.world.borrow().moving.is_some()
    }
}

pub(crate) struct Lab {
    slot: u64,
    dice: Dice,
    corrupt: u64,
    pub(crate) nodes: Vec<Member>,
    bus: Bus,
    sending: VecDeque<u8>,
    sessions: BTreeMap<u8, Session>,
    up: BTreeMap<u8, bool>,
    outcomes: BTreeMap<u32, State>,
    pub(crate) other_boards: usize,
    /// All bytes of an image before this are stored.
    pub(crate) stored: u32,
    pub(crate) bus_events: Vec<BusEvent>,
}

fn boot(id: u64, resets: u32) -> u32 {
    (id >> 32) as u32 ^ id as u32 ^ resets
}

fn id(task: u32) -> TaskId {
    TaskId::new(task).unwrap()
}

fn random() -> u32 {
    use std::sync::atomic::{AtomicU32, Ordering};
    static LAST: AtomicU32 = AtomicU32::new(1);
    LAST.fetch_add(0x9E37_79B9, Ordering::Relaxed)
}

impl Lab {
    pub(crate) fn empty(seed: u64) -> Self {
        Self {
            slot: 0,
            dice: Dice::new(seed),
            corrupt: 0,
            nodes: Vec::new(),
            bus: Bus::new(BAUD, TURNAROUND),
            sending: VecDeque::new(),
            sessions: BTreeMap::new(),
            up: BTreeMap::new(),
            outcomes: BTreeMap::new(),
            other_boards: 0,
            stored: 0,
            bus_events: Vec::new(),
        }
    }

    /// Nodes with the addresses from 1, and a session with each.
    pub(crate) fn new(nodes: u8, seed: u64) -> Self {
        let mut lab = Self::empty(seed);
        for address in 1..=nodes {
            lab.add_node(address);
            let mut session = Session::new(4711, Some(BAUD), random).with_address(address);
            session.handle_connected(lab.now());
            lab.sessions.insert(address, session);
            lab.bus.add(lab.now(), address);
        }
        lab
    }

    pub(crate) fn add_node(&mut self, address: u8) -> u64 {
        // Some ids differ in their last bits only.
        let id = match self.nodes.last() {
            Some(last) if last.id & 1 == 0 => last.id | 1,
            _ => self.dice.throw() & !3,
        };
        let world = Rc::new(RefCell::new(World::default()));
        let pace = self.dice.below(8) + 1;
        self.nodes.push(Member {
            id,
            address,
            node: fresh_node(id, address, 0, &world),
            world,
            sending: VecDeque::new(),
            pace,
            trouble: None,
            turns: Vec::new(),
        });
        id
    }

    pub(crate) fn now(&self) -> Instant {
        Instant::from_micros(self.slot * SLOT / 1000)
    }

    /// Begins an update of a node, which goes on by itself.
    pub(crate) fn update(&mut self, address: u8) {
        let now = self.now();
        let begin = UpdateRequest::Begin {
            now: true,
            downgrade: false,
            manifest: vec![1; 104],
        };
        let session = self.sessions.get_mut(&address).unwrap();
        session.request_update(now, 0, begin);
    }

    /// A node is switched off and on again.
    pub(crate) fn reset(&mut self, node: usize, resets: u32) {
        let member = &mut self.nodes[node];
        member.world.borrow_mut().moving = None;
        member.node = fresh_node(member.id, member.address, resets, &member.world);
        member.sending.clear();
    }

    /// How many sessions there were with the node of this address.
    pub(crate) fn sessions(&self, address: u8) -> u64 {
        self.sessions[&address].counters().sessions
    }

    /// A search has found the board of this address alone there, or not.
    pub(crate) fn found(&mut self, address: u8, alone: bool) {
        self.sessions
            .get_mut(&address)
            .unwrap()
            .handle_search(alone);
    }

    pub(crate) fn corrupt_one_in(&mut self, bytes: u64) {
        self.corrupt = bytes;
    }

    /// Adds a node with the id of the last one.
    pub(crate) fn add_twin(&mut self, address: u8) {
        let id = self.nodes.last().unwrap().id;
        self.add_node(address);
        let twin = self.nodes.last_mut().unwrap();
        twin.id = id;
        twin.node = fresh_node(id, address, 1, &twin.world);
    }

    /// The gateway's line is opened again.
    pub(crate) fn reopen(&mut self) {
        self.bus.reopen();
        self.sending.clear();
    }

    pub(crate) fn bus_search(&mut self) {
        let now = self.now();
        self.bus.search(now);
    }

    pub(crate) fn address_of(&self, id: u64) -> u8 {
        let node = self.nodes.iter().find(|node| node.id == id).unwrap();
        node.node.components().components.address()
    }

    pub(crate) fn is_up(&self, address: u8) -> bool {
        self.up.get(&address).copied().unwrap_or_default()
    }

    pub(crate) fn outcome(&self, task: u32) -> Option<State> {
        self.outcomes.get(&task).copied()
    }

    pub(crate) fn start(&mut self, address: u8, task: u32, goal: &str) {
        let now = self.now();
        let session = self.sessions.get_mut(&address).unwrap();
        session.start(now, id(task), "motor", goal);
    }

    pub(crate) fn abort(&mut self, address: u8, task: u32) {
        let now = self.now();
        self.sessions
            .get_mut(&address)
            .unwrap()
            .abort(now, id(task));
    }

    pub(crate) fn forget_turns(&mut self) {
        let now = self.now();
        for node in &mut self.nodes {
            node.turns = vec![now];
        }
    }

    pub(crate) fn longest_pause(&self, address: u8) -> Duration {
        let turns = &self.nodes[usize::from(address) - 1].turns;
        let pauses = turns.windows(2).map(|pair| pair[1].since(pair[0]));
        let last = self.now().since(*turns.last().unwrap());
        pauses.max().unwrap_or_default().max(last)
    }

    /// The outcome of a task is what its motor has done.
    pub(crate) fn judge(&self, task: u32, goal: &str) {
        let begun: u32 = self
            .nodes
            .iter()
            .filter_map(|node| node.world.borrow().begun.get(goal).copied())
            .sum();
        let stopped = self.nodes.iter().any(|node| {
            node.world
                .borrow()
                .stopped_early
                .iter()
                .any(|one| one == goal)
        });
        match self.outcome(task).unwrap() {
            State::Completed => assert!(begun == 1 && !stopped, "{goal}: completed, begun {begun}"),
            State::Aborted => assert!(
                begun == 0 || begun == 1 && stopped,
                "{goal}: aborted, begun {begun}"
            ),
            State::Rejected => assert_eq!(begun, 0, "{goal}: rejected"),
            _ => assert!(begun <= 1, "{goal}: begun {begun}"),
        }
    }

    pub(crate) fn until(
        &mut self,
        most: Duration,
        what: &str,
        mut done: impl FnMut(&Self) -> bool,
    ) {
        let end = self.now() + most;
        while !done(self) {
            assert!(self.now() < end, "not within {most:?}: {what}");
            self.step();
        }
    }

    pub(crate) fn run(&mut self, time: Duration) {
        let end = self.now() + time;
        while self.now() < end {
            self.step();
        }
    }

    /// One slot: each end that sends puts a byte on the line, and all others receive it.
    fn step(&mut self) {
        self.slot += 1;
        let now = self.now();
        let from_master = self.sending.pop_front();
        let mut heard = from_master;
        let mut speakers = usize::from(from_master.is_some());
        let mut spoke = vec![false; self.nodes.len()];
        for (node, spoke) in self.nodes.iter_mut().zip(&mut spoke) {
            if let Some(byte) = node.sending.pop_front()
                && node.trouble != Some(Trouble::Cut)
            {
                *spoke = true;
                speakers += 1;
                heard = Some(heard.unwrap_or_default() ^ byte);
            }
        }
        if speakers > 1 {
            heard = heard.map(|byte| byte ^ self.dice.below(256) as u8);
        }
        if self.corrupt > 0 && self.dice.below(self.corrupt) == 0 {
            heard = heard.map(|byte| byte ^ 1 << self.dice.below(8));
        }
        for (node, spoke) in self.nodes.iter_mut().zip(spoke) {
            let hears = !matches!(node.trouble, Some(Trouble::Silent | Trouble::Cut));
            if !spoke && hears {
                node.node.handle_bytes(now, heard.as_slice());
            }
            advance(node, now, self.slot, &mut self.dice);
        }
        if from_master.is_none() {
            self.bus.handle_bytes(now, heard.as_slice());
        }
        self.advance_master(now);
    }

    fn advance_master(&mut self, now: Instant) {
        self.bus.handle_timeout(now);
        while let Some((address, frame)) = self.bus.poll_frame() {
            if let Some(session) = self.sessions.get_mut(&address) {
                session.handle_bytes(now, &frame);
            }
        }
        while let Some(event) = self.bus.poll_event() {
            self.bus_events.push(event);
        }
        for (&address, session) in &mut self.sessions {
            session.handle_timeout(now);
            while let Some(event) = session.poll_event() {
                match event {
                    LinkEvent::Up => drop(self.up.insert(address, true)),
                    LinkEvent::Lost | LinkEvent::Silent => drop(self.up.insert(address, false)),
                    LinkEvent::Ended(id, state, _) => {
                        let before = self.outcomes.insert(id.get(), state);
                        assert_eq!(before, None, "two outcomes");
                    }
                    LinkEvent::Update(
                        _,
                        Ok(UpdateReply::Phase(UpdatePhase::Receiving { offset })),
                    ) => {
                        self.stored = offset;
                        let piece = session.device().unwrap().longest_piece() as u32;
                        let length = piece.min(IMAGE - offset);
                        if length > 0 {
                            let bytes = vec![7; length as usize];
                            session.request_update(now, 1, UpdateRequest::Write { offset, bytes });
                        }
                    }
                    LinkEvent::OtherBoard => self.other_boards += 1,
                    LinkEvent::TaskRejected(id, _) => {
                        let before = self.outcomes.insert(id.get(), State::Rejected);
                        assert_eq!(before, None, "two outcomes");
                    }
                    _ => {}
                }
            }
            self.bus.queue(now, address, &session.poll_transmit());
            self.bus.set_needs(address, session.bus_needs());
        }
        if self.sending.is_empty() {
            let question = self.bus.poll_transmit(now).unwrap_or_default();
            let mut decoder = Decoder::<200>::new();
            for &byte in &question {
                if decoder.push(byte) == Ok(true)
                    && let Some((address, Turn::Poll)) = decoder.turn()
                    && let Some(node) = self.nodes.iter_mut().find(|it| it.address == address)
                {
                    node.turns.push(now);
                }
            }
            self.sending.extend(question);
        }
    }
}

fn fresh_node(
    id: u64,
    address: u8,
    resets: u32,
    world: &Rc<RefCell<World>>,
) -> Node<'static, Parts, 4, 128> {
    let motor = Motor {
        world: Rc::clone(world),
        ends_at: Instant::ZERO,
        aborted: false,
    };
    Node::new(
        Identity::new("motor", "1", boot(id, resets)),
        Updatable::new(OnBus::new([motor], id, address), Flash),
    )
}

fn advance(node: &mut Member, now: Instant, slot: u64, dice: &mut Dice) {
    node.world.borrow_mut().floods = node.trouble == Some(Trouble::Floods);
    match node.trouble {
        Some(Trouble::Silent) => return,
        Some(Trouble::Resets) if slot.is_multiple_of(1_150) => {
            node.node = fresh_node(node.id, node.address, slot as u32, &node.world);
            node.sending.clear();
        }
        Some(Trouble::Babbles) if slot.is_multiple_of(1000) => {
            node.sending.extend((0..200).map(|_| dice.below(256) as u8));
        }
        _ => {}
    }
    if slot.is_multiple_of(node.pace) && node.sending.is_empty() {
        node.node.handle_timeout(now);
        let mut buffer = [0; 160];
        let len = node.node.poll_transmit(now, &mut buffer);
        node.sending.extend(&buffer[..len]);
    }
}
