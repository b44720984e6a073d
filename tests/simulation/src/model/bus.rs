//! A shared line: the real bus of the gateway, and two real nodes with their sessions.

use std::time::Duration;

use ztl_core::time::earliest;
use ztl_core::{Instant, State};

use super::bus_scenarios::{BusAction, BusFault, BusScenario};
use super::ends::link::bus::{Bus, TURNAROUND};
use super::gateway::Told;
use super::line::{Parcel, Way};
use super::link::LinkModel;
use super::words::{Act, Fault};
use crate::explore::System;
use crate::fingerprint::BUS_FRAMES;

const BAUD: u32 = 115_200;
/// Time passes in steps of this, so that there are few moments at which something happens: each question takes one.
const GRID: Duration = Duration::from_millis(125);
/// Clients act and faults begin within this time, for each fault.
const WINDOW: Duration = Duration::from_millis(750);
/// Delayed frames arrive, broken wires are mended and the gateway is restarted within this time after that: longer than
/// two link timeouts, after which both ends have given up.
const LASTING: Duration = Duration::from_millis(2500);
/// No more steps than this are needed until both nodes are up, or until a task has ended.
const CALM_STEPS: u32 = 500;

/// What a bus keeps for a node, in the form that the fingerprint understands.
#[derive(Debug, Clone, Default)]
struct Kept {
    unasked: Vec<Parcel>,
    command: Option<Parcel>,
    last: Option<Parcel>,
}

/// What is on the line: a question for a node, or what a node has sent.
#[derive(Debug, Clone)]
struct Frames {
    node: usize,
    way: Way,
    parcels: Vec<Parcel>,
}

/// A gateway, a shared line and two nodes with their clients.
#[derive(Debug, Clone)]
pub struct BusModel {
    scenario: &'static BusScenario,
    now: Instant,
    /// When both nodes were up.
    begin: Instant,
    /// `None` while the gateway is killed.
    bus: Option<Bus>,
    /// Each node with its session and its clients.
    nodes: [LinkModel; 2],
    kept: [Kept; 2],
    cut: [bool; 2],
    /// Whether the second node has the address of the first one.
    readdressed: bool,
    question: Option<Frames>,
    held: Option<Frames>,
    acts: usize,
    times: u8,
}

const fn address(node: usize) -> u8 {
    node as u8 + 1
}

impl BusModel {
    /// All of it, with a link to each node.
    ///
    /// # Panics
    /// If that breaks a promise.
    #[must_use]
    pub fn new(scenario: &'static BusScenario) -> Self {
        let node: &'static _ = Box::leak(Box::new(scenario.node));
        let nodes = [0, 1].map(|number| LinkModel::at(node, Some(address(number))));
        let mut lab = Self {
            scenario,
            now: nodes[0].now,
            begin: nodes[0].now,
            bus: None,
            nodes,
            kept: Default::default(),
            cut: [false; 2],
            readdressed: false,
            question: None,
            held: None,
            acts: 0,
            times: scenario.times,
        };
        lab.connect();
        let ready = |lab: &Self| {
            let told = |node: &LinkModel| node.clients[..node.asked].iter().all(accepted);
            lab.nodes.iter().all(|node| is_up(node) && told(node))
        };
        lab.calm_until(ready).expect("a quiet line");
        for (node, act) in scenario.before {
            lab.nodes[*node].act(*act).expect("a quiet line");
        }
        lab.calm_until(ready).expect("a quiet line");
        lab.begin = lab.now;
        lab
    }

    /// Until when clients act and faults begin.
    fn window(&self) -> Duration {
        WINDOW * u32::from(self.scenario.times.max(1))
    }

    fn age(&self) -> Duration {
        self.now.since(self.begin)
    }

    fn may_last(&self) -> bool {
        self.age() < self.window() + LASTING
    }

    /// Whether it matters how long ago it has begun.
    fn is_disturbed(&self) -> bool {
        let acts = self.acts < self.scenario.acts.len();
        let lasting = self.bus.is_none() || self.held.is_some() || self.cut.contains(&true);
        let lasting = lasting || self.readdressed;
        acts || self.times > 0 || lasting
    }

    /// A new bus, with both nodes.
    fn connect(&mut self) {
        let mut bus = Bus::new(BAUD, TURNAROUND);
        for node in 0..self.nodes.len() {
            bus.add(self.now, address(node));
        }
        self.bus = Some(bus);
    }

    fn calm_until(&mut self, done: impl Fn(&Self) -> bool) -> Result<(), String> {
        for _ in 0..CALM_STEPS {
            self.apply(self.calm())?;
            if done(self) {
                return Ok(());
            }
        }
        Err("promise 3: a node does not serve".to_owned())
    }

    /// Both ends process what is due, until the gateway has asked a question or waits.
    fn settle(&mut self) -> Result<(), String> {
        let now = self.now;
        for node in &mut self.nodes {
            node.now = now;
            node.settle()?;
        }
        self.search()?;
        if let Some(bus) = &mut self.bus {
            bus.handle_timeout(now);
        }
        loop {
            self.queue();
            let Some(bus) = &mut self.bus else {
                return Ok(());
            };
            let Some((to, bytes)) = bus.poll_frame() else {
                break;
            };
            let node = usize::from(to) - 1;
            let parcel = self.parcel(node, &bytes);
            self.nodes[node].deliver(Way::Up, &parcel)?;
        }
        while bus_event(&mut self.bus) {}
        let question = self.bus.as_mut().and_then(|bus| bus.poll_transmit(now));
        if let Some(bytes) = question {
            self.on_question(&bytes);
        }
        Ok(())
    }

    /// Searches are quick here, and find what there is.
    fn search(&mut self) -> Result<(), String> {
        for (number, node) in self.nodes.iter_mut().enumerate() {
            let session = node.gateways[0].session.as_ref();
            if session.is_some_and(|session| !session.astray_boots().is_empty()) {
                let alone = !self.readdressed && !self.cut[number];
                node.with_session(0, |session| {
                    session.handle_search(alone);
                    session.handle_search(alone);
                })?;
            }
        }
        Ok(())
    }

    fn parcel(&self, node: usize, bytes: &[u8]) -> Parcel {
        let both = self.nodes.iter();
        let opened = match self.readdressed {
            true => both.map(|it| it.opened).max().unwrap_or_default(),
            false => self.nodes[node].opened,
        };
        Parcel::new(bytes, opened * 2 + 1, self.nodes[node].boots())
    }

    /// The second node is switched off and on, with this address.
    fn readdress(&mut self, to: u8) -> Result<(), String> {
        let node = &mut self.nodes[1];
        let own = node.address.replace(to);
        node.up.queue.clear();
        node.disturb(Fault::Reset)?;
        node.address = own;
        let boots = [self.nodes[0].boots(), self.nodes[1].boots()];
        (self.nodes[0].other_boot, self.nodes[1].other_boot) = (boots[1], boots[0]);
        self.readdressed = own != Some(to);
        Ok(())
    }

    /// Gives the bus what the sessions transmit.
    fn queue(&mut self) {
        let Some(bus) = &mut self.bus else {
            return;
        };
        for (number, node) in self.nodes.iter_mut().enumerate() {
            let kept = &mut self.kept[number];
            for parcel in node.down.queue.drain(..) {
                bus.queue(self.now, address(number), &parcel.bytes);
                let known = |known: &Parcel| known.bytes == parcel.bytes;
                if parcel.seq != 0 || parcel.is("Hello") {
                    kept.command = Some(parcel);
                } else if !kept.unasked.iter().any(known) {
                    kept.unasked.push(parcel);
                }
            }
            let session = node.gateways[0].session.as_ref();
            if let Some(session) = session {
                bus.set_needs(address(number), session.bus_needs());
            }
        }
    }

    fn on_question(&mut self, bytes: &[u8]) {
        let frames: Vec<&[u8]> = bytes.split_inclusive(|byte| *byte == 0).collect();
        let frames = frames.into_iter().filter(|frame| frame.len() > 1);
        // The address is the first byte, after the one that counts.
        let frames: Vec<&[u8]> = frames.collect();
        let Some(node) = frames.last().map(|frame| usize::from(frame[1]) - 1) else {
            return;
        };
        let parcels: Vec<Parcel> = frames
            .iter()
            .map(|frame| self.parcel(node, frame))
            .collect();
        let kept = &mut self.kept[node];
        kept.unasked.clear();
        let polls = parcels.last().is_some_and(|last| last.is("Poll"));
        kept.last = if polls { None } else { kept.command.take() };
        self.nodes[node].note(|| format!("  gateway asks node {node}: {parcels:?}"));
        self.question = Some(Frames {
            node,
            way: Way::Down,
            parcels,
        });
    }

    /// All nodes hear a frame, except the one that sends it.
    fn heard_by_nodes(&mut self, parcel: &Parcel, sender: Option<usize>) -> Result<(), String> {
        if self.readdressed {
            // It also answers in the sessions of the other one.
            self.nodes[1].opened = self.nodes[1].opened.max(self.nodes[0].opened);
        }
        for (number, node) in self.nodes.iter_mut().enumerate() {
            if Some(number) != sender && !self.cut[number] {
                node.deliver(Way::Down, parcel)?;
            }
        }
        Ok(())
    }

    fn deliver(&mut self, frames: &Frames) -> Result<(), String> {
        for parcel in &frames.parcels {
            match frames.way {
                Way::Down => self.heard_by_nodes(parcel, None)?,
                Way::Up => self.heard_by_gateway(frames.node, parcel),
            }
        }
        Ok(())
    }

    fn heard_by_gateway(&mut self, node: usize, parcel: &Parcel) {
        self.nodes[node].note(|| format!("  gateway hears node {node}: {parcel:?}"));
        if let Some(bus) = &mut self.bus {
            bus.handle_bytes(self.now, &parcel.bytes);
        }
        let kept = &mut self.kept[node];
        let sent = kept.last.as_ref().map(|last| &last.bytes);
        kept.command.take_if(|command| Some(&command.bytes) == sent);
    }

    fn senders(&self) -> impl Iterator<Item = usize> {
        (0..self.nodes.len()).filter(|node| !self.nodes[*node].up.queue.is_empty())
    }

    /// What the nodes send arrives at the gateway and at the other node.
    fn on_answer(&mut self) -> Result<(), String> {
        let senders: Vec<usize> = self.senders().collect();
        let Some(parcel) = self.take_answer() else {
            return Ok(());
        };
        if let [sender] = senders[..] {
            self.heard_by_gateway(sender, &parcel);
            return self.heard_by_nodes(&parcel, Some(sender));
        }
        // Both at once: neither arrives, and each frame ends the other.
        self.nodes[0].note(|| "  both nodes send".to_owned());
        self.take_answer();
        let damaged: Vec<u8> = parcel.bytes.iter().map(|byte| byte | 0x80).collect();
        if let Some(bus) = &mut self.bus {
            bus.handle_bytes(self.now, &damaged);
            bus.handle_bytes(self.now, &[0]);
        }
        Ok(())
    }

    fn take_answer(&mut self) -> Option<Parcel> {
        let sender = self.senders().next()?;
        self.nodes[sender].up.queue.pop_front()
    }

    fn print(&self, exact: bool) -> u64 {
        let mut all = self.nodes[0].fingerprinter();
        for (number, node) in self.nodes.iter().enumerate() {
            let mut print = node.fingerprinter();
            if exact {
                print = print.exactly();
            }
            node.add_to(&mut print);
            print.add(&self.kept[number]);
            for frames in [&self.question, &self.held] {
                print.add(&frames.as_ref().filter(|frames| frames.node == number));
            }
            all.add(&print.finish());
        }
        all.set_now(self.now);
        all.skip(&BUS_FRAMES);
        all.add(&self.bus);
        let end = self.window() + LASTING;
        let age = self.is_disturbed().then(|| self.age().min(end));
        all.add(&(self.cut, self.readdressed, self.acts, self.times, age));
        all.finish()
    }

    fn wake(&self) -> Instant {
        let bus = self.bus.as_ref().and_then(Bus::poll_timeout);
        let nodes = self.nodes.iter().map(|node| Some(node.wake()));
        let wake = nodes.fold(bus, earliest).unwrap_or(self.now);
        let micros = wake.since(self.now).as_micros();
        let steps = micros.div_ceil(GRID.as_micros()).max(1);
        self.now + GRID * u32::try_from(steps).unwrap_or(u32::MAX)
    }

    /// The next step while all faults last.
    fn go_on(&self) -> BusAction {
        if self.question.is_some() {
            return BusAction::Ask;
        }
        if self.senders().next().is_some() {
            return BusAction::Answer;
        }
        BusAction::Wait
    }

    fn can(&self, fault: BusFault) -> bool {
        match fault {
            BusFault::DropQuestion => self.question.is_some(),
            BusFault::HoldQuestion | BusFault::CopyQuestion => {
                self.question.is_some() && self.held.is_none()
            }
            BusFault::DropAnswer => self.senders().next().is_some(),
            BusFault::HoldAnswer => self.senders().next().is_some() && self.held.is_none(),
            BusFault::Cut(node) => !self.cut[node],
            BusFault::Reset(_) => true,
            BusFault::Readdress | BusFault::Replace => !self.readdressed,
            BusFault::Kill => self.bus.is_some(),
        }
    }

    fn disturb(&mut self, fault: BusFault) -> Result<(), String> {
        self.times = self.times.saturating_sub(1);
        match fault {
            BusFault::DropQuestion => self.question = None,
            BusFault::HoldQuestion => self.held = self.question.take(),
            BusFault::CopyQuestion => self.held.clone_from(&self.question),
            BusFault::DropAnswer => drop(self.take_answer()),
            BusFault::HoldAnswer => {
                let node = self.senders().next().unwrap_or_default();
                self.held = self.take_answer().map(|parcel| Frames {
                    node,
                    way: Way::Up,
                    parcels: vec![parcel],
                });
            }
            BusFault::Cut(node) => self.cut[node] = true,
            BusFault::Reset(node) => self.nodes[node].disturb(Fault::Reset)?,
            BusFault::Readdress => self.readdress(address(0))?,
            BusFault::Replace => {
                self.cut[0] = true;
                self.readdress(address(0))?;
            }
            BusFault::Kill => {
                self.bus = None;
                self.question = None;
                self.kept = Default::default();
                for node in &mut self.nodes {
                    node.kill(0);
                    node.down.queue.clear();
                }
            }
        }
        Ok(())
    }
}

fn accepted(client: &super::link::Client) -> bool {
    client.told == Told::Accepted
}

fn is_up(node: &LinkModel) -> bool {
    let session = node.gateways[0].session.as_ref();
    session.is_some_and(|session| session.is_up())
}

/// Takes an event of the bus, which only the log shows.
fn bus_event(bus: &mut Option<Bus>) -> bool {
    bus.as_mut().and_then(Bus::poll_event).is_some()
}

impl System for BusModel {
    type Action = BusAction;

    fn calm(&self) -> BusAction {
        if self.bus.is_none() {
            return BusAction::Start;
        }
        match self.cut.iter().position(|cut| *cut) {
            Some(node) => BusAction::Mend(node as u8),
            None if self.readdressed => BusAction::Mend(1),
            None => self.go_on(),
        }
    }

    fn disturbances(&self) -> Vec<BusAction> {
        if !self.may_last() {
            return Vec::new();
        }
        let open = self.age() < self.window();
        let mut actions = vec![self.go_on()];
        if open && self.acts < self.scenario.acts.len() && self.bus.is_some() {
            actions.push(BusAction::Act);
        }
        if self.bus.is_none() {
            actions.push(BusAction::Start);
        }
        let cut = (0..self.cut.len()).filter(|node| self.cut[*node]);
        actions.extend(cut.map(|node| BusAction::Mend(node as u8)));
        if self.readdressed && !self.cut[1] {
            actions.push(BusAction::Mend(1));
        }
        if self.held.is_some() {
            actions.push(BusAction::Release(0));
        }
        if open && self.times > 0 {
            let faults = self.scenario.faults.iter().copied();
            actions.extend(
                faults
                    .filter(|fault| self.can(*fault))
                    .map(BusAction::Disturb),
            );
        }
        let calm = self.calm();
        actions.retain(|action| *action != calm);
        actions
    }

    fn apply(&mut self, action: BusAction) -> Result<(), String> {
        match action {
            BusAction::Ask => {
                if let Some(question) = self.question.take() {
                    self.deliver(&question)?;
                }
            }
            BusAction::Answer => self.on_answer()?,
            BusAction::Wait => self.now = self.wake(),
            BusAction::Act => {
                if let Some((node, act)) = self.scenario.acts.get(self.acts) {
                    self.acts += 1;
                    self.nodes[*node].note(|| format!("  node {node}: {act:?}"));
                    self.nodes[*node].act(*act)?;
                }
            }
            BusAction::Disturb(fault) => self.disturb(fault)?,
            BusAction::Release(_) => {
                if let Some(held) = self.held.take() {
                    self.deliver(&held)?;
                }
            }
            BusAction::Mend(node) if self.cut[usize::from(node)] => {
                self.cut[usize::from(node)] = false;
            }
            BusAction::Mend(_) => self.readdress(address(1))?,
            BusAction::Start => {
                for node in &mut self.nodes {
                    node.start(0);
                    node.with_session(0, |_| {})?;
                }
                self.connect();
            }
        }
        for (node, cut) in self.nodes.iter_mut().zip(self.cut) {
            if cut {
                node.up.queue.clear();
            }
        }
        if !self.may_last() {
            self.held = None;
        }
        self.settle()?;
        self.nodes.iter().try_for_each(LinkModel::judge)
    }

    fn fingerprint(&self) -> u64 {
        self.print(false)
    }

    fn exact(&self) -> u64 {
        self.print(true)
    }

    fn settled(&self) -> Result<(), String> {
        self.nodes.iter().try_for_each(LinkModel::settled)
    }

    fn serves(&self) -> Result<(), String> {
        for number in 0..self.nodes.len() {
            let mut lab = self.clone();
            let node = &mut lab.nodes[number];
            let task = node.asked;
            let Some(motor) = node.truth.moving.iter().position(Option::is_none) else {
                continue;
            };
            node.act(Act::Ask {
                gateway: 0,
                motor,
                millis: 30,
            })?;
            lab.calm_until(|lab| lab.nodes[number].clients[task].told.is_final())?;
            let told = lab.nodes[number].clients[task].told;
            if told != Told::Ended(State::Completed) {
                return Err(format!("promise 3: a new task is told {told:?}"));
            }
        }
        Ok(())
    }

    fn trace(&self, path: &[BusAction]) -> Vec<String> {
        let mut lab = self.clone();
        for node in &mut lab.nodes {
            node.notes = Some(Vec::new());
        }
        let mut told = Vec::new();
        for action in path {
            told.push(format!("> {action:?}"));
            let broken = lab.apply(*action).err();
            for (number, node) in lab.nodes.iter_mut().enumerate() {
                let notes = node.notes.iter_mut().flat_map(|notes| notes.drain(..));
                told.extend(notes.map(|note| format!("node {number}: {note}")));
            }
            told.extend(broken.map(|promise| format!("BROKEN: {promise}")));
        }
        told
    }
}
