//! The whole of the model: one or two gateways, a line, and a node with motors.

use std::cell::Cell;

use ztl_core::time::earliest;
use ztl_core::{Instant, State, TaskId};

use super::ends::link::{LinkEvent, Session};
use super::gateway::{Journal, Told};
use super::line::{Lane, Parcel, Way};
use super::motor::{ENDLESS, TASKS, Truth, with_truth};
use super::node::SomeNode;
use super::own::{OwnTask, take_up};
use super::parameters::{SETS, SetClient};
use super::words::{Act, Scenario};
use crate::explore::System;
use crate::fingerprint::NEARLY_ALL;

pub(super) type LabSession = Session<Journal>;

#[derive(Debug, Clone)]
pub(super) struct Gateway {
    /// `None` while it is killed.
    pub(super) session: Option<Box<LabSession>>,
    /// The journal while it is killed.
    pub(super) journal: Journal,
}

#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Client {
    pub(super) told: Told,
    pub(super) gateway: usize,
    pub(super) motor: usize,
    /// Whether it ends only when it is stopped.
    pub(super) endless: bool,
    /// Whether it was aborted.
    pub(super) aborted: bool,
    /// Whether its gateway was restarted and does not know it.
    pub(super) forgotten: bool,
    /// The boot of the device when it was started, as known to its gateway.
    pub(super) boot: u32,
    pub(super) own: OwnTask,
}

/// Gateways, a line, a node and clients.
#[derive(Debug, Clone)]
pub struct LinkModel {
    pub(super) scenario: &'static Scenario,
    pub(super) now: Instant,
    pub(super) gateways: Vec<Gateway>,
    pub(super) plugged: bool,
    pub(super) node: SomeNode,
    /// The node's address on a shared line.
    pub(super) address: Option<u8>,
    pub(super) boot: u32,
    /// The highest boot of another board that may have its address.
    pub(super) other_boot: u32,
    /// When the node's clock was 0.
    pub(super) booted: Instant,
    pub(super) down: Lane,
    pub(super) up: Lane,
    pub(super) held: Vec<(Way, Parcel)>,
    pub(super) truth: Truth,
    pub(super) clients: [Client; TASKS],
    pub(super) set_clients: [SetClient; SETS],
    pub(super) asked: usize,
    pub(super) acts: usize,
    pub(super) times: u8,
    /// Number of sessions opened, and the latest of each gateway.
    pub(super) opened: u32,
    pub(super) latest: [u32; 2],
    /// Session and sequence number of the node's last answer.
    pub(super) answered: (u32, u8),
    pub(super) commanded: Instant,
    /// The gateway that holds the node, and when its last command arrived.
    pub(super) holder: Option<(u32, Instant)>,
    /// The trace, if requested.
    pub(super) notes: Option<Vec<String>>,
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

pub(super) fn gateway_of(session: u32) -> u32 {
    (session >> 8) & 1
}

/// Maximum number of steps of [`Act::Idle`].
const IDLE_STEPS: u32 = 4000;

/// A line so slow that a command is repeated after a quarter of the link timeout: the fewer moments
/// there are at which something happens, the fewer states.
const BAUD: u32 = 2560;

/// Initial value of all clocks but the node's.
const BEGIN: Instant = Instant::from_millis(10_000);

impl LinkModel {
    /// All of it, just switched on.
    #[must_use]
    pub fn new(scenario: &'static Scenario) -> Self {
        Self::at(scenario, None)
    }

    /// The same, with a node that has this address on a shared line.
    pub(super) fn at(scenario: &'static Scenario, address: Option<u8>) -> Self {
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
            node: SomeNode::new(scenario, 1, address),
            address,
            boot: 1,
            other_boot: 0,
            booted: BEGIN,
            down: Lane::default(),
            up: Lane::default(),
            held: Vec::new(),
            truth: Truth::default(),
            clients: [Client::default(); TASKS],
            set_clients: [SetClient::default(); SETS],
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
        let first = if scenario.late { 1 } else { scenario.gateways };
        for gateway in 0..first {
            lab.start(gateway);
        }
        lab.settle().expect("nothing has happened yet");
        lab
    }

    pub(super) fn note(&mut self, text: impl FnOnce() -> String) {
        let now = self.now.as_micros() - BEGIN.as_micros();
        if let Some(notes) = &mut self.notes {
            notes.push(format!("{:>9.1} ms  {}", now as f64 / 1000.0, text()));
        }
    }

    pub(super) fn node_now(&self) -> Instant {
        Instant::ZERO + self.now.since(self.booted)
    }

    pub(super) fn start(&mut self, gateway: usize) {
        self.lend_numbers(gateway);
        let place = &mut self.gateways[gateway];
        let mut session = Session::with_journal(
            std::mem::take(&mut place.journal),
            gateway as u64 + 1,
            Some(BAUD),
            next_session,
        );
        if let Some(address) = self.address {
            session = session.with_address(address);
        }
        let restored = session.journal_mut().restored();
        for task in restored {
            session.restore(self.now, task);
        }
        if self.plugged {
            session.handle_connected(self.now);
        }
        place.session = Some(Box::new(session));
        self.take_numbers(gateway);
    }

    /// The next session that this gateway opens gets an unused number.
    pub(super) fn lend_numbers(&self, gateway: usize) {
        SESSION.set(self.opened * 2 + gateway as u32);
    }

    pub(super) fn take_numbers(&mut self, gateway: usize) {
        let opened = SESSION.get() / 2;
        if opened != self.opened {
            self.opened = opened;
            self.latest[gateway] = SESSION.get();
        }
    }

    pub(super) fn kill(&mut self, gateway: usize) {
        let place = &mut self.gateways[gateway];
        if let Some(mut session) = place.session.take() {
            place.journal = session.journal_mut().clone();
        }
        self.lose_sets(gateway);
        let journal = &self.gateways[gateway].journal;
        let kept = journal.kept;
        let (open, ends) = (journal.restored(), journal.ends.clone());
        for task in 0..self.asked {
            let client = &self.clients[task];
            if client.gateway != gateway {
                continue;
            }
            if client.told.is_final() {
                if !kept {
                    self.forget_end(task);
                }
                continue;
            }
            if self.is_untaken_after_kill(task, kept) {
                continue;
            }
            let client = &mut self.clients[task];
            let id = task_id(task);
            if let Some((_, state)) = ends.iter().find(|(ended, _)| *ended == id) {
                // Told by the gateway that is started next.
                client.told = match state {
                    State::Rejected => Told::Rejected,
                    state => Told::Ended(*state),
                };
            } else if !kept {
                client.forgotten = true;
            } else if !client.own.own && open.iter().all(|task| task.id != id) {
                // It was never sent and never will be.
                client.told = Told::Rejected;
            }
        }
    }

    /// Processes everything that is due now.
    pub(super) fn settle(&mut self) -> Result<(), String> {
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

    pub(super) fn wake(&self) -> Instant {
        let node_now = self.node_now();
        let node = self.now + self.node.poll_timeout(node_now).since(node_now);
        let sessions = self.gateways.iter().filter_map(|g| g.session.as_ref());
        sessions
            .map(|session| session.poll_timeout())
            .fold(Some(node), earliest)
            .unwrap_or(node)
    }

    /// The highest boot that a frame may be of.
    pub(super) fn boots(&self) -> u32 {
        self.boot.max(self.other_boot)
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
        let sent = self.up.send(&bytes, self.opened * 2 + 1, self.boots());
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
    pub(super) fn with_session(
        &mut self,
        gateway: usize,
        act: impl FnOnce(&mut LabSession),
    ) -> Result<(), String> {
        self.lend_numbers(gateway);
        let Some(session) = &mut self.gateways[gateway].session else {
            return Ok(());
        };
        act(session);
        let now = self.now;
        let events: Vec<LinkEvent> = std::iter::from_fn(|| session.poll_event()).collect();
        let taken = events
            .contains(&LinkEvent::Begun)
            .then(|| take_up(session, now))
            .flatten();
        let bytes = session.poll_transmit();
        self.take_numbers(gateway);
        if let Some(task) = taken {
            self.on_taken(task)?;
        }
        if self.plugged {
            for parcel in self.down.send(&bytes, self.opened * 2 + 1, self.boots()) {
                self.note(|| format!("  gateway {gateway}: {parcel:?}"));
            }
        }
        for event in events {
            self.note(|| format!("  gateway {gateway} tells {event:?}"));
            self.on_event(event)?;
        }
        Ok(())
    }

    /// A client receives a reply.
    pub(super) fn deliver(&mut self, way: Way, parcel: &Parcel) -> Result<(), String> {
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

    /// Whether [`Act::Idle`] can begin: nothing is in transit.
    pub(super) fn can_idle(&self) -> bool {
        let idle = |lane: &Lane| lane.queue.is_empty() && !lane.stalled && !lane.cut;
        idle(&self.down) && idle(&self.up) && self.answered.1 < NEARLY_ALL
    }

    /// Forgets held frames that are dropped wherever they arrive, those of a session that its
    /// gateway has left.
    pub(super) fn forget(&mut self) {
        let latest = self.latest;
        let dead = |parcel: &Parcel| {
            let gateway = gateway_of(parcel.session) as usize;
            parcel.session >> 8 != 0 && parcel.session >> 8 != latest[gateway]
        };
        self.held
            .retain(|(way, parcel)| *way == Way::Down || !dead(parcel));
    }

    pub(super) fn lane(&mut self, way: Way) -> &mut Lane {
        match way {
            Way::Down => &mut self.down,
            Way::Up => &mut self.up,
        }
    }

    pub(super) fn act(&mut self, act: Act) -> Result<(), String> {
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
                    aborted: false,
                    forgotten: false,
                    boot,
                    own: OwnTask::default(),
                };
                let name = ["arm", "belt"][motor];
                let goal = format!("{task} {millis}");
                self.with_session(gateway, |session| {
                    session.start(now, task_id(task), name, &goal);
                })
            }
            Act::Press { motor, millis } => self.press(motor, millis),
            Act::Set { gateway, motor } => self.set(gateway, motor),
            Act::Abort { gateway, task } => {
                let own = self.clients[task].own;
                self.clients[task].aborted = !own.own || own.taken;
                self.with_session(gateway, |session| session.abort(now, task_id(task)))
            }
            Act::Idle => {
                for _ in 0..IDLE_STEPS {
                    if self.answered.1 >= NEARLY_ALL {
                        return Ok(());
                    }
                    self.apply(self.calm())?;
                }
                Err("promise 3: the gateway sends no commands".to_owned())
            }
        }
    }
}

pub(super) fn task_id(task: usize) -> TaskId {
    TaskId::new(task as u32 + 1).expect("not 0")
}
