//! A laboratory of the model: one or two gateways, a line, a node with motors, and what all that
//! came to.

use std::cell::Cell;

use ztl_core::link::{LINK_TIMEOUT, Loss};
use ztl_core::time::earliest;
use ztl_core::{Instant, State, TaskId};

use super::ends::mcu::{Identity, Node};
use super::ends::session::{Event, Session};
use super::gateway::{Journal, Told};
use super::line::{Lane, Parcel, Way};
use super::motor::{ENDLESS, Kind, Motor, TASKS, Truth, with_truth};
use crate::explore::System;
use crate::fingerprint::{Fingerprint, Origin};

/// What a client does.
#[derive(Debug, Clone, Copy)]
pub enum Act {
    /// Asks a gateway for the next task.
    Ask {
        /// Which gateway.
        gateway: usize,
        /// Which motor.
        motor: usize,
        /// How long it moves; `u16::MAX` is until it is stopped.
        millis: u16,
    },
    /// Wants a task to stop.
    Abort {
        /// Which gateway.
        gateway: usize,
        /// Which, from 0 in the order of asking.
        task: usize,
    },
}

/// What can go wrong. Each costs one of the faults that a scenario allows; that it goes on, or is
/// over at any later time, costs nothing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fault {
    /// A frame is lost (or damaged, which is the same).
    Drop(Way),
    /// A frame is late: it arrives at any later time, in whatever session, or never.
    Hold(Way),
    /// A frame comes a second time, at any later time.
    Copy(Way),
    /// All that is sent from now on comes a second time, in its order, at any later time.
    Tape(Way),
    /// Nothing arrives for a while, and then all.
    Stall(Way),
    /// All that is sent is lost for a while.
    Cut(Way),
    /// The device is reset.
    Reset,
    /// A gateway dies, and is started again at any later time.
    Kill(usize),
    /// It dies after it has written down what the next frame brings, before it says or tells anything.
    KillWriting(usize),
    /// The line is closed and opened again at any later time; what is under way arrives after that.
    Unplug,
}

/// What can happen next.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Action {
    /// The next frame arrives.
    Deliver(Way),
    /// Nothing happens until the next timer.
    Wait,
    /// The client does what it does next.
    Act,
    /// Something goes wrong.
    Disturb(Fault),
    /// A frame that was held back arrives.
    Release(u8),
    /// What was taped comes again.
    Replay(Way),
    /// A stall, or a cut, is over.
    Mend(Way),
    /// A gateway is started again.
    Start(usize),
    /// The line is opened again.
    Plug,
}

/// What is explored.
#[derive(Debug, Clone, Copy)]
pub struct Scenario {
    /// Its name.
    pub name: &'static str,
    /// What happens in it.
    pub about: &'static str,
    /// The motors.
    pub motors: [Kind; 2],
    /// How many gateways are at the line, 1 or 2.
    pub gateways: usize,
    /// Whether they have journals.
    pub journal: bool,
    /// What the clients do, in this order, each at any time.
    pub acts: &'static [Act],
    /// What can go wrong.
    pub faults: &'static [Fault],
    /// How often something goes wrong at most.
    pub times: u8,
}

impl Scenario {
    /// The same with another number of faults.
    #[must_use]
    pub fn with_times(&self, times: u8) -> &'static Self {
        // Leaked: there are few, and a laboratory is copied often.
        Box::leak(Box::new(Self { times, ..*self }))
    }
}

type SmallNode = Node<'static, [Motor; 2], 2, 128>;
type LabSession = Session<Journal>;

#[derive(Debug, Clone)]
struct Gateway {
    /// `None` while it is dead.
    session: Option<Box<LabSession>>,
    /// What is left while it is dead.
    journal: Journal,
}

#[derive(Debug, Clone, Copy, Default)]
struct Client {
    told: Told,
    gateway: usize,
    motor: usize,
    /// It ends only when it is stopped.
    endless: bool,
    /// Its gateway was started anew and has forgotten it.
    forgotten: bool,
    /// The boot of the device when it was asked for, as far as its gateway knew.
    boot: u32,
}

/// The whole laboratory.
#[derive(Debug, Clone)]
pub struct Lab {
    scenario: &'static Scenario,
    now: Instant,
    gateways: Vec<Gateway>,
    plugged: bool,
    node: SmallNode,
    boot: u32,
    /// When the node's clock was 0.
    booted: Instant,
    down: Lane,
    up: Lane,
    held: Vec<(Way, Parcel)>,
    truth: Truth,
    clients: [Client; TASKS],
    asked: usize,
    acts: usize,
    times: u8,
    /// How many sessions were opened, and the latest of each gateway.
    opened: u32,
    latest: [u32; 2],
    /// The node's last answer, by session and seq; and when its last new command was.
    answered: (u32, u8),
    commanded: Instant,
    /// The gateway that has the node, and when it was last heard.
    holder: Option<(u32, Instant)>,
    /// What happens, for people; only when asked for.
    notes: Option<Vec<String>>,
}

thread_local! {
    static SESSION: Cell<u32> = const { Cell::new(0) };
}

/// A session's number is free in its lowest eight bits, where the boot id goes; the bit above says
/// which gateway opens it.
fn next_session() -> u32 {
    SESSION.set(SESSION.get() + 2);
    SESSION.get() << 8
}

fn gateway_of(session: u32) -> u32 {
    (session >> 8) & 1
}

/// A held frame is forgotten when this many commands have come after it; of pings alone, that takes
/// two seconds.
const COMMANDS: u32 = 8;

/// A line so slow that a command is repeated after a quarter of the link timeout: the fewer moments
/// there are at which something happens, the fewer states.
const BAUD: u32 = 2560;

/// Where all clocks but the node's begin.
const BEGIN: Instant = Instant::from_millis(10_000);

impl Lab {
    /// A laboratory in which everything has just been switched on.
    #[must_use]
    pub fn new(scenario: &'static Scenario) -> Self {
        let mut journal = Journal::default();
        journal.kept = scenario.journal;
        let gateway = Gateway {
            session: None,
            journal,
        };
        let mut lab = Self {
            scenario,
            now: BEGIN,
            gateways: vec![gateway; scenario.gateways],
            plugged: true,
            node: node(scenario, 1),
            boot: 1,
            booted: BEGIN,
            down: Lane::default(),
            up: Lane::default(),
            held: Vec::new(),
            truth: Truth::default(),
            clients: [Client::default(); TASKS],
            asked: 0,
            acts: 0,
            times: scenario.times,
            opened: 0,
            latest: [0; 2],
            answered: (0, 0),
            commanded: BEGIN,
            holder: None,
            notes: None,
        };
        for gateway in 0..scenario.gateways {
            lab.start(gateway);
        }
        lab.settle().expect("nothing has happened yet");
        lab
    }

    /// What happens on this path, for people.
    #[must_use]
    pub fn trace(&self, path: &[Action]) -> Vec<String> {
        let mut lab = self.clone();
        lab.notes = Some(Vec::new());
        for action in path {
            lab.note(|| format!("> {action:?}"));
            if let Err(promise) = lab.apply(*action) {
                lab.note(|| format!("BROKEN: {promise}"));
            }
        }
        lab.notes.unwrap_or_default()
    }

    fn note(&mut self, text: impl FnOnce() -> String) {
        let now = self.now.as_micros() - BEGIN.as_micros();
        if let Some(notes) = &mut self.notes {
            notes.push(format!("{:>9.1} ms  {}", now as f64 / 1000.0, text()));
        }
    }

    fn node_now(&self) -> Instant {
        Instant::ZERO + self.now.since(self.booted)
    }

    fn start(&mut self, gateway: usize) {
        self.lend_numbers(gateway);
        let place = &mut self.gateways[gateway];
        let mut session = Session::with_book(
            std::mem::take(&mut place.journal),
            gateway as u64 + 1,
            Some(BAUD),
            next_session,
        );
        let restored = session.book_mut().restored();
        for task in restored {
            session.restore(self.now, task);
        }
        if self.plugged {
            session.handle_connected(self.now);
        }
        place.session = Some(Box::new(session));
        self.take_numbers(gateway);
    }

    /// The next session that this gateway opens gets a number that none had.
    fn lend_numbers(&self, gateway: usize) {
        SESSION.set(self.opened * 2 + gateway as u32);
    }

    fn take_numbers(&mut self, gateway: usize) {
        let opened = SESSION.get() / 2;
        if opened != self.opened {
            self.opened = opened;
            self.latest[gateway] = SESSION.get();
        }
    }

    fn kill(&mut self, gateway: usize) {
        let place = &mut self.gateways[gateway];
        if let Some(mut session) = place.session.take() {
            place.journal = session.book_mut().clone();
        }
        let journal = &place.journal;
        let (open, ends) = (journal.restored(), journal.ends.clone());
        for task in 0..self.asked {
            let client = &mut self.clients[task];
            if client.gateway != gateway || client.told.is_final() {
                continue;
            }
            let id = task_id(task);
            if let Some((_, state)) = ends.iter().find(|(ended, _)| *ended == id) {
                // Told by the gateway that is started next.
                client.told = match state {
                    State::Rejected => Told::Rejected,
                    state => Told::Ended(*state),
                };
            } else if !journal.kept {
                client.forgotten = true;
            } else if open.iter().all(|task| task.id != id) {
                // It was never sent: nobody will.
                client.told = Told::Rejected;
            }
        }
    }

    /// Everything that is due at this moment.
    fn settle(&mut self) -> Result<(), String> {
        for _ in 0..20 {
            let node_now = self.node_now();
            let node = &mut self.node;
            with_truth(&mut self.truth, || node.handle_timeout(node_now));
            self.drain_node()?;
            for gateway in 0..self.gateways.len() {
                let now = self.now;
                self.with_session(gateway, |session| session.handle_timeout(now))?;
            }
            if self.wake() > self.now {
                return Ok(());
            }
        }
        Err("something is due at once for ever".to_owned())
    }

    fn wake(&self) -> Instant {
        let node_now = self.node_now();
        let node = self.now + self.node.poll_timeout(node_now).since(node_now);
        let sessions = self.gateways.iter().filter_map(|g| g.session.as_ref());
        sessions
            .map(|session| session.poll_timeout())
            .fold(Some(node), earliest)
            .unwrap_or(node)
    }

    fn drain_node(&mut self) -> Result<(), String> {
        let node_now = self.node_now();
        let mut buffer = [0xA5; 256];
        let mut bytes = Vec::new();
        loop {
            let count = self.node.poll_transmit(node_now, &mut buffer);
            if count == 0 {
                break;
            }
            bytes.extend_from_slice(&buffer[..count]);
        }
        let heard = self.plugged && self.gateways.iter().any(|g| g.session.is_some());
        let sent = self.up.send(&bytes, self.opened * 2 + 1, self.boot);
        if !heard {
            self.up.queue.clear();
        }
        for parcel in sent {
            self.note(|| format!("  node: {parcel:?}"));
            self.on_sent(&parcel)?;
        }
        Ok(())
    }

    /// What a frame of the node shows: which commands it has taken, and whose.
    fn on_sent(&mut self, parcel: &Parcel) -> Result<(), String> {
        let opens = parcel.is("Welcome") && parcel.session != self.answered.0;
        let executed = parcel.seq != 0 && (parcel.session, parcel.seq) != self.answered && !opens;
        if opens {
            let gateway = gateway_of(parcel.session);
            let live = |heard| self.now < heard + LINK_TIMEOUT;
            if let Some((holder, heard)) = self.holder
                && holder != gateway
                && live(heard)
            {
                return Err("promise: the device of one gateway is given to another".to_owned());
            }
            self.holder = Some((gateway, self.now));
            self.answered = (parcel.session, 0);
        } else if executed {
            self.answered = (parcel.session, parcel.seq);
            self.commanded = self.now;
            if let Some((_, heard)) = &mut self.holder {
                *heard = self.now;
            }
        }
        Ok(())
    }

    /// Lets a session act, and takes what comes of it.
    fn with_session(
        &mut self,
        gateway: usize,
        act: impl FnOnce(&mut LabSession),
    ) -> Result<(), String> {
        self.lend_numbers(gateway);
        let Some(session) = &mut self.gateways[gateway].session else {
            return Ok(());
        };
        act(session);
        let bytes = session.poll_transmit();
        let events: Vec<Event> = std::iter::from_fn(|| session.poll_event()).collect();
        self.take_numbers(gateway);
        if self.plugged {
            for parcel in self.down.send(&bytes, self.opened * 2 + 1, self.boot) {
                self.note(|| format!("  gateway {gateway}: {parcel:?}"));
            }
        }
        for event in events {
            self.note(|| format!("  gateway {gateway} tells {event:?}"));
            self.on_event(event)?;
        }
        Ok(())
    }

    /// A client is told something.
    fn on_event(&mut self, event: Event) -> Result<(), String> {
        let (id, told, text) = match event {
            Event::Accepted(id) => (id, Told::Accepted, String::new()),
            Event::Rejected(id, text) => (id, Told::Rejected, text),
            Event::Ended(id, state, text) => (id, Told::Ended(state), text),
            _ => return Ok(()),
        };
        let task = id.get() as usize - 1;
        let client = self.clients[task];
        let again = client.told == told && told == Told::Accepted && self.scenario.journal;
        let first = match told {
            Told::Accepted | Told::Rejected => client.told == Told::Nothing,
            _ => !client.told.is_final(),
        };
        if !first && !again {
            return Err(format!(
                "promise 2: task {task} was told {:?} and is told {told:?} ({text})",
                client.told
            ));
        }
        self.clients[task].told = told;
        self.judge_end(task, told, &text)
    }

    /// Whether what is told is true.
    fn judge_end(&self, task: usize, told: Told, text: &str) -> Result<(), String> {
        let client = self.clients[task];
        let fate = self.truth.tasks[task];
        let lie = |promise: u8, why: &str| {
            Err(format!(
                "promise {promise}: task {task} is told {told:?} ({text}), {why}"
            ))
        };
        let Told::Ended(state) = told else {
            return Ok(());
        };
        match (state, text) {
            (State::Completed, _) if fate.came_to != Some(State::Completed) => {
                lie(2, "but its motor did not come to its goal")
            }
            (State::Failed, "the device no longer holds the task") => {
                lie(2, "but it does until that is known here")
            }
            (State::Aborted, _) if fate.begun > 0 && fate.came_to != Some(State::Aborted) => {
                lie(2, "but its motor was not stopped by that")
            }
            (State::Failed, "device was reset") if client.boot == self.boot => {
                lie(3, "but it was not")
            }
            (State::Failed, "device is not answering") => {
                let kind = self.scenario.motors[client.motor];
                match kind.loss {
                    Loss::CarryOn => lie(4, "but it carries on"),
                    _ => Ok(()),
                }
            }
            _ => Ok(()),
        }
    }

    /// What must be true at any time.
    fn judge(&self) -> Result<(), String> {
        for (task, (fate, client)) in self.truth.tasks.iter().zip(&self.clients).enumerate() {
            if fate.begun > 1 {
                return Err(format!("promise 1: task {task} is begun twice"));
            }
            if client.told == Told::Rejected && fate.begun > 0 {
                return Err(format!("promise 6: task {task} was rejected and moves"));
            }
            if client.told.is_final() && self.truth.moves(task) {
                return Err(format!(
                    "promise 4: task {task} was told {:?} and its motor moves",
                    client.told
                ));
            }
        }
        for (motor, moving) in self.truth.moving.iter().enumerate() {
            let lost = self.now > self.commanded + LINK_TIMEOUT;
            if moving.is_some() && lost && self.scenario.motors[motor].loss != Loss::CarryOn {
                return Err(format!("promise 4: motor {motor} moves without a link"));
            }
        }
        Ok(())
    }

    fn deliver(&mut self, way: Way, parcel: &Parcel) -> Result<(), String> {
        self.note(|| format!("  {way:?} arrives {parcel:?}"));
        match way {
            Way::Down => {
                let node_now = self.node_now();
                let node = &mut self.node;
                with_truth(&mut self.truth, || {
                    node.handle_bytes(node_now, &parcel.bytes);
                });
                self.drain_node()?;
            }
            Way::Up => {
                for gateway in 0..self.gateways.len() {
                    let now = self.now;
                    self.with_session(gateway, |session| session.handle_bytes(now, &parcel.bytes))?;
                }
            }
        }
        Ok(())
    }

    /// Forgets held frames that are dropped wherever they arrive, those of a session that its
    /// gateway has left; and those held for longer than a line does, some seconds.
    fn forget(&mut self) {
        let (latest, (session, seq)) = (self.latest, self.answered);
        let dead = |parcel: &Parcel| {
            let gateway = gateway_of(parcel.session) as usize;
            parcel.session >> 8 != 0 && parcel.session >> 8 != latest[gateway]
        };
        let old = |parcel: &Parcel| {
            let behind = (255 + u32::from(seq) - u32::from(parcel.seq)) % 255;
            parcel.session == session && parcel.seq != 0 && (COMMANDS..128).contains(&behind)
        };
        self.held
            .retain(|(way, parcel)| !old(parcel) && (*way == Way::Down || !dead(parcel)));
    }

    fn lane(&mut self, way: Way) -> &mut Lane {
        match way {
            Way::Down => &mut self.down,
            Way::Up => &mut self.up,
        }
    }

    fn act(&mut self, act: Act) -> Result<(), String> {
        let now = self.now;
        match act {
            Act::Ask {
                gateway,
                motor,
                millis,
            } => {
                let task = self.asked;
                self.asked += 1;
                let session = self.gateways[gateway].session.as_ref();
                let known = session.and_then(|session| session.device());
                let boot = known.map_or(self.boot, |device| device.boot);
                self.clients[task] = Client {
                    told: Told::Nothing,
                    gateway,
                    motor,
                    endless: millis == ENDLESS,
                    forgotten: false,
                    boot,
                };
                let name = ["arm", "belt"][motor];
                let goal = format!("{task} {millis}");
                self.with_session(gateway, |session| {
                    session.start(now, task_id(task), name, &goal);
                })
            }
            Act::Abort { gateway, task } => {
                self.with_session(gateway, |session| session.abort(now, task_id(task)))
            }
        }
    }

    fn can_act(&self) -> bool {
        let Some(act) = self.scenario.acts.get(self.acts) else {
            return false;
        };
        let (Act::Ask { gateway, .. } | Act::Abort { gateway, .. }) = *act;
        self.gateways[gateway].session.is_some()
    }

    fn can(&self, fault: Fault) -> bool {
        let lane = |way| match way {
            Way::Down => &self.down,
            Way::Up => &self.up,
        };
        match fault {
            Fault::Drop(way) => lane(way).brings(),
            Fault::Hold(way) | Fault::Copy(way) => lane(way).brings() && self.held.len() < 2,
            Fault::Tape(way) => lane(way).tape.is_none(),
            Fault::Stall(way) | Fault::Cut(way) => {
                let lane = lane(way);
                !lane.stalled && !lane.cut
            }
            Fault::Reset => true,
            Fault::Kill(gateway) => self.gateways[gateway].session.is_some(),
            Fault::KillWriting(gateway) => {
                self.up.brings() && self.gateways[gateway].session.is_some()
            }
            Fault::Unplug => self.plugged,
        }
    }

    fn disturb(&mut self, fault: Fault) -> Result<(), String> {
        self.times = self.times.saturating_sub(1);
        match fault {
            Fault::Drop(way) => {
                self.lane(way).queue.pop_front();
            }
            Fault::Hold(way) => {
                let parcel = self.lane(way).queue.pop_front();
                self.held.extend(parcel.map(|parcel| (way, parcel)));
            }
            Fault::Copy(way) => {
                let parcel = self.lane(way).queue.front().cloned();
                self.held.extend(parcel.map(|parcel| (way, parcel)));
            }
            Fault::Tape(way) => self.lane(way).tape = Some(Vec::new()),
            Fault::Stall(way) => self.lane(way).stalled = true,
            Fault::Cut(way) => self.lane(way).cut = true,
            Fault::Reset => {
                self.boot += 1;
                self.booted = self.now;
                self.node = node(self.scenario, self.boot);
                self.truth.rest();
                self.holder = None;
                self.answered = (0, 0);
            }
            Fault::Kill(gateway) => self.kill(gateway),
            Fault::KillWriting(gateway) => {
                let parcel = self.up.queue.pop_front();
                self.lend_numbers(gateway);
                if let (Some(parcel), Some(session)) = (parcel, &mut self.gateways[gateway].session)
                {
                    session.handle_bytes(self.now, &parcel.bytes);
                }
                self.take_numbers(gateway);
                self.kill(gateway);
            }
            Fault::Unplug => {
                self.plugged = false;
                for gateway in 0..self.gateways.len() {
                    self.with_session(gateway, LabSession::handle_disconnected)?;
                }
            }
        }
        Ok(())
    }
}

fn task_id(task: usize) -> TaskId {
    TaskId::new(task as u32 + 1).expect("not 0")
}

fn node(scenario: &Scenario, boot: u32) -> SmallNode {
    let motor = |place| Motor {
        place,
        kind: scenario.motors[place],
        run: None,
    };
    Node::new(Identity::new("lab", "1", boot), [motor(0), motor(1)])
}

impl System for Lab {
    type Action = Action;

    fn calm(&self) -> Action {
        if let Some(dead) = self.gateways.iter().position(|g| g.session.is_none()) {
            return Action::Start(dead);
        }
        if !self.plugged {
            return Action::Plug;
        }
        for (way, lane) in [(Way::Down, &self.down), (Way::Up, &self.up)] {
            if lane.stalled || lane.cut {
                return Action::Mend(way);
            }
        }
        self.go_on()
    }

    fn disturbances(&self) -> Vec<Action> {
        let mut actions = Vec::new();
        // What lasts goes on, unless that is what calm is.
        let on = self.go_on();
        if on != self.calm() {
            actions.push(on);
        }
        if self.can_act() {
            actions.push(Action::Act);
        }
        for (gateway, place) in self.gateways.iter().enumerate() {
            if place.session.is_none() {
                actions.push(Action::Start(gateway));
            }
        }
        if !self.plugged {
            actions.push(Action::Plug);
        }
        for (way, lane) in [(Way::Down, &self.down), (Way::Up, &self.up)] {
            if lane.stalled || lane.cut {
                actions.push(Action::Mend(way));
            }
            if lane.tape.is_some() {
                actions.push(Action::Replay(way));
            }
        }
        actions.extend((0..self.held.len()).map(|place| Action::Release(place as u8)));
        if self.times > 0 {
            let faults = self.scenario.faults.iter().copied();
            actions.extend(faults.filter(|fault| self.can(*fault)).map(Action::Disturb));
        }
        let calm = self.calm();
        actions.retain(|action| *action != calm);
        actions
    }

    fn apply(&mut self, action: Action) -> Result<(), String> {
        match action {
            Action::Deliver(way) => {
                if let Some(parcel) = self.lane(way).queue.pop_front() {
                    self.deliver(way, &parcel)?;
                }
            }
            Action::Wait => self.now = self.wake(),
            Action::Act => {
                if let Some(act) = self.scenario.acts.get(self.acts) {
                    self.acts += 1;
                    self.note(|| format!("  {act:?}"));
                    self.act(*act)?;
                }
            }
            Action::Disturb(fault) => self.disturb(fault)?,
            Action::Release(place) => {
                let (way, parcel) = self.held.remove(usize::from(place));
                self.deliver(way, &parcel)?;
            }
            Action::Replay(way) => {
                for parcel in self.lane(way).tape.take().unwrap_or_default() {
                    self.deliver(way, &parcel)?;
                }
            }
            Action::Mend(way) => {
                let lane = self.lane(way);
                lane.stalled = false;
                lane.cut = false;
            }
            Action::Start(gateway) => {
                self.start(gateway);
                self.with_session(gateway, |_| {})?;
            }
            Action::Plug => {
                self.plugged = true;
                let now = self.now;
                for gateway in 0..self.gateways.len() {
                    self.with_session(gateway, |session| session.handle_connected(now))?;
                }
            }
        }
        self.settle()?;
        self.forget();
        self.judge()
    }

    fn fingerprint(&self) -> u64 {
        let node = self.node_now();
        let mut print = Fingerprint::new(Origin {
            now: node,
            node,
            seq: self.answered.1,
        });
        print.add(&self.node);
        print.set_now(self.now);
        for gateway in &self.gateways {
            print.add(&gateway.session);
            print.add(&gateway.journal);
        }
        for lane in [&self.down, &self.up] {
            print.add(&(lane.cut, lane.stalled));
            print.add(&lane.queue);
            print.add(&lane.tape);
        }
        print.add(&self.held);
        print.add(&self.truth);
        print.add(&self.clients);
        print.add(&(self.plugged, self.boot, self.asked, self.acts, self.times));
        print.add(&self.holder);
        print.add(&self.commanded);
        print.finish()
    }

    fn settled(&self) -> Result<(), String> {
        let up = |gateway: &Gateway| gateway.session.as_ref().is_some_and(|s| s.is_up());
        if !self.gateways.iter().any(up) {
            return Err("promise 3: the device does not serve again".to_owned());
        }
        for (task, client) in self.clients.iter().enumerate().take(self.asked) {
            let moves = self.truth.moves(task);
            let open = !client.forgotten && !client.told.is_final();
            if open && client.endless && moves && client.told == Told::Accepted {
                continue;
            }
            if open {
                return Err(format!(
                    "promise 2: task {task} never ends; told {:?}",
                    client.told
                ));
            }
            if moves {
                return Err(format!("promise 4: task {task} moves for ever"));
            }
        }
        Ok(())
    }

    fn serves(&self) -> Result<(), String> {
        let mut lab = self.clone();
        let up = |gateway: &Gateway| gateway.session.as_ref().is_some_and(|s| s.is_up());
        let gateway = lab.gateways.iter().position(up).unwrap_or(0);
        let task = lab.asked;
        let Some(motor) = lab.truth.moving.iter().position(Option::is_none) else {
            return Ok(());
        };
        lab.act(Act::Ask {
            gateway,
            motor,
            millis: 30,
        })?;
        for _ in 0..100 {
            let calm = lab.calm();
            lab.apply(calm)?;
            match lab.clients[task].told {
                Told::Ended(State::Completed) => return Ok(()),
                told if told.is_final() => {
                    return Err(format!("promise 3: a new task is told {told:?}"));
                }
                _ => {}
            }
        }
        Err("promise 3: a new task does not end".to_owned())
    }
}

impl Lab {
    /// What happens next while nothing changes.
    fn go_on(&self) -> Action {
        if self.plugged {
            if self.down.brings() {
                return Action::Deliver(Way::Down);
            }
            let heard = self.gateways.iter().any(|g| g.session.is_some());
            if self.up.brings() && heard {
                return Action::Deliver(Way::Up);
            }
        }
        Action::Wait
    }
}
