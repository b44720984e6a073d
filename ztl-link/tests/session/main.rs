//! The gateway's session and `ztl-mcu`'s real node over a line, on virtual time. A failing test prints its trace.
//! `tests/simulation` simulates many faults.
#![expect(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::indexing_slicing,
    reason = "helpers of tests may panic"
)]

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::rc::Rc;
use std::sync::{Arc, Mutex};

use std::time::{Duration, UNIX_EPOCH};

use ztl_core::link::Loss;
use ztl_core::{Instant, State, TaskId};
use ztl_link::*;
use ztl_mcu::link::Offer;
use ztl_mcu::{Acting, Component, Identity, Node, Refused, Report, Run};
use ztl_sim::Disk;
use ztl_sim::line::{Dice, Faults, FaultyLine};
use ztl_std::gateway::{DeviceJournal, JournalRecords, Moment};

mod descriptions;
mod late;
mod own;
mod parameters;
mod restart;
mod updates;

/// The real motions of the motors, independent of any message.
#[derive(Default)]
struct World {
    /// How often each goal was begun.
    begun: BTreeMap<String, u32>,
    /// The goal under way, by motor.
    moving: [Option<String>; 2],
}

struct Motor {
    place: usize,
    name: &'static str,
    loss: Loss,
    world: Rc<RefCell<World>>,
    ends_at: Instant,
    aborted: bool,
}

impl Motor {
    fn rest(&mut self) {
        self.world.borrow_mut().moving[self.place] = None;
    }
}

/// A goal is `NUMBER MILLISECONDS`.
fn millis_of(goal: &str) -> Option<u64> {
    goal.split_once(' ')?.1.parse().ok()
}

impl Component for Motor {
    fn offer(&self) -> Offer<'_> {
        Offer::new(self.name).with_unit("ms").with_loss(self.loss)
    }

    fn check(&self, goal: &str, why: &mut Report<'_>) -> Result<(), Refused> {
        millis_of(goal).map(drop).ok_or_else(|| {
            why.text("NUMBER MILLISECONDS");
            Refused
        })
    }

    fn start(&mut self, now: Instant, goal: &str, _: &mut Report<'_>) -> Result<(), Refused> {
        let millis = millis_of(goal).ok_or(Refused)?;
        let mut world = self.world.borrow_mut();
        *world.begun.entry(goal.to_owned()).or_default() += 1;
        world.moving[self.place] = Some(goal.to_owned());
        self.ends_at = now + Duration::from_millis(millis);
        self.aborted = false;
        Ok(())
    }

    fn poll(&mut self, now: Instant, report: &mut Report<'_>) -> Run {
        report.text("at some place");
        if self.aborted || now >= self.ends_at {
            self.rest();
            return if self.aborted {
                Run::Aborted
            } else {
                Run::Completed
            };
        }
        Run::Running
    }

    fn abort(&mut self, _now: Instant) {
        self.aborted = true;
    }

    fn make_safe(&mut self, _now: Instant) {
        self.rest();
        self.aborted = true;
    }
}

/// One direction of a line as slow as 115200 baud.
fn line(seed: u64) -> FaultyLine {
    FaultyLine::new(Faults::default(), seed).with_baud(115_200)
}

/// The messages that have arrived so far.
fn arrived(line: &mut FaultyLine, now: Instant) -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut piece = [0xA5; 64];
    loop {
        let count = line.poll_bytes(now, &mut piece);
        if count == 0 {
            return bytes;
        }
        bytes.extend_from_slice(&piece[..count]);
    }
}

/// The simulation has no wall clock.
fn moment() -> Moment {
    Moment {
        wall: UNIX_EPOCH,
        running: Duration::ZERO,
    }
}

/// The session of a gateway that was started on a disk.
fn session(disk: &Disk) -> Session<DeviceJournal<Disk>> {
    let stranger = u64::from(numbers());
    let log = JournalRecords::open(disk.clone(), &disk.written(), moment(), stranger);
    let gateway = log.gateway();
    let log = Arc::new(Mutex::new(log));
    let book = DeviceJournal::new(log, "lab", moment);
    Session::with_journal(book, gateway, Some(115_200), numbers)
}

type SmallNode = Node<'static, Acting<[Motor; 2]>, 2, 128>;

/// A gateway's session, a line, a device, and clients that keep books.
struct Pair {
    now: Instant,
    session: Session<DeviceJournal<Disk>>,
    disk: Disk,
    node: SmallNode,
    boots: u32,
    down: FaultyLine,
    up: FaultyLine,
    /// Everything that the gateway has received.
    heard: Vec<u8>,
    world: Rc<RefCell<World>>,
    /// The goal of each task asked for.
    asked: BTreeMap<TaskId, String>,
    accepted: BTreeMap<TaskId, u32>,
    rejected: BTreeMap<TaskId, String>,
    ended: BTreeMap<TaskId, (State, String)>,
    /// Number of tasks that the firmware has started, and of ids for them.
    pressed: u32,
    given: u32,
    /// Whether the session is that of another gateway, with its own journal.
    foreign: bool,
    /// Events that the firmware has reported.
    reported: Vec<String>,
    trace: Vec<String>,
}

fn node(world: &Rc<RefCell<World>>, boot: u32) -> SmallNode {
    let motor = |place, loss| Motor {
        place,
        name: ["arm", "belt"][place],
        loss,
        world: Rc::clone(world),
        ends_at: Instant::ZERO,
        aborted: false,
    };
    let components = [motor(0, Loss::Abort), motor(1, Loss::CarryOn)];
    Node::new(Identity::new("lab", "1", boot), Acting::new(components))
}

/// Sessions that differ; which they are does not matter.
fn numbers() -> u32 {
    use std::sync::atomic::{AtomicU32, Ordering};
    static NEXT: AtomicU32 = AtomicU32::new(1);
    NEXT.fetch_add(1, Ordering::Relaxed).max(1)
}

impl Pair {
    fn new(seed: u64) -> Self {
        let world = Rc::default();
        let disk = Disk::default();
        let mut lab = Self {
            now: Instant::from_millis(1000),
            session: session(&disk),
            disk,
            node: node(&world, 1),
            boots: 1,
            down: line(seed | 1 << 40),
            up: line(seed | 1 << 41),
            heard: Vec::new(),
            world,
            asked: BTreeMap::new(),
            accepted: BTreeMap::new(),
            rejected: BTreeMap::new(),
            ended: BTreeMap::new(),
            pressed: 0,
            given: 0,
            foreign: false,
            reported: Vec::new(),
            trace: Vec::new(),
        };
        lab.session.handle_connected(lab.now);
        lab
    }

    fn note(&mut self, text: String) {
        let at = self.now.as_micros();
        self.trace
            .push(format!("{:>10.3} ms  {text}", at as f64 / 1000.0));
    }

    fn ask(&mut self, component: &str, millis: u64) -> TaskId {
        let number = self.asked.len() as u32 + 1;
        let id = TaskId::new(number).unwrap();
        let goal = format!("{number} {millis}");
        self.note(format!("INIT {id} {component} {goal}"));
        self.asked.insert(id, goal.clone());
        self.session.start(self.now, id, component, &goal);
        self.settle();
        id
    }

    fn abort(&mut self, id: TaskId) {
        self.note(format!("ABORT {id}"));
        self.session.abort(self.now, id);
        self.settle();
    }

    /// The device loses its power and has it again.
    fn reset(&mut self) {
        self.boots += 1;
        self.note(format!("device reset, boot {}", self.boots));
        self.world.borrow_mut().moving = [None, None];
        self.node = node(&self.world, self.boots);
    }

    /// The cable is pulled and plugged in again: what was on its way is lost.
    fn replug(&mut self) {
        self.note("line closed and opened".to_owned());
        self.session.handle_disconnected();
        self.down.lose();
        self.up.lose();
        self.session.handle_connected(self.now);
        self.settle();
    }

    /// Everything that happens at this moment.
    fn settle(&mut self) {
        let bytes = arrived(&mut self.down, self.now);
        self.node.handle_bytes(self.now, &bytes);
        self.node.handle_timeout(self.now);
        let mut buffer = [0xA5; 64];
        loop {
            let count = self.node.poll_transmit(self.now, &mut buffer);
            if count == 0 {
                break;
            }
            self.up.handle_bytes(self.now, &buffer[..count]);
        }
        let bytes = arrived(&mut self.up, self.now);
        self.session.handle_bytes(self.now, &bytes);
        self.heard.extend_from_slice(&bytes);
        self.session.handle_timeout(self.now);
        let bytes = self.session.poll_transmit();
        self.down.handle_bytes(self.now, &bytes);
        while let Some(event) = self.session.poll_event() {
            self.on_event(event);
        }
    }

    fn on_event(&mut self, event: LinkEvent) {
        self.note(format!("{event:?}"));
        if event == LinkEvent::Begun
            && let Some(begun) = self.session.begun().cloned()
        {
            self.given += 1;
            let id = TaskId::new(1000 + self.given).unwrap();
            if self.session.take_up(self.now, id) && !self.foreign {
                self.asked.insert(id, begun.goal);
            }
            return;
        }
        if self.foreign {
            return;
        }
        match event {
            LinkEvent::Reported(text) => self.reported.push(text),
            LinkEvent::Accepted(id) => *self.accepted.entry(id).or_default() += 1,
            LinkEvent::TaskRejected(id, reason) => {
                assert!(!self.accepted.contains_key(&id), "{id} rejected after all");
                let again = self.rejected.insert(id, reason);
                assert_eq!(again, None, "{id} rejected twice");
            }
            LinkEvent::Ended(id, state, text) => {
                // Promise 4: once a client has a final state, nothing moves for its task.
                let goal = &self.asked[&id];
                let moving = self.world.borrow().moving.clone();
                assert!(
                    !moving.iter().flatten().any(|moving| moving == goal),
                    "{id} told {state} ({text}) while its motor moves"
                );
                let again = self.ended.insert(id, (state, text));
                assert_eq!(again, None, "{id} ended twice");
            }
            _ => {}
        }
    }

    fn pass(&mut self, time: Duration) {
        let end = self.now + time;
        for _ in 0..2_000_000 {
            self.settle();
            let wakes = [
                self.session.poll_timeout(),
                Some(self.node.poll_timeout(self.now)),
                self.down.poll_timeout(Duration::ZERO),
                self.up.poll_timeout(Duration::ZERO),
            ];
            // A wake-up that is due again at once would stand still.
            let soon = self.now + Duration::from_micros(10);
            match wakes.into_iter().flatten().min() {
                Some(wake) if wake < end => self.now = wake.max(soon),
                _ => {
                    self.now = end;
                    self.settle();
                    return;
                }
            }
        }
        panic!("no end within two million turns");
    }

    /// Books and world agree.
    fn check(&self) {
        for (id, goal) in &self.asked {
            let begun = self.world.borrow().begun.get(goal).copied().unwrap_or(0);
            let ended = self.ended.get(id);
            assert!(begun <= 1, "{id} was begun {begun} times");
            match self.rejected.get(id) {
                Some(reason) => {
                    assert_eq!(begun, 0, "{id} was rejected ({reason}) and moved");
                    assert_eq!(ended, None, "{id} was rejected and ended");
                }
                None => assert!(ended.is_some(), "{id} has no end"),
            }
            if let Some((State::Completed, _)) = ended {
                assert_eq!(begun, 1, "{id} completed without having moved");
            }
            assert!(self.accepted.get(id).is_none_or(|times| *times == 1));
        }
    }
}

#[track_caller]
fn ended(lab: &Pair, id: TaskId) -> (State, &str) {
    let (state, text) = lab.ended.get(&id).expect("it has ended");
    (*state, text)
}

#[test]
fn a_task_is_accepted_and_completed() {
    let mut lab = Pair::new(1);
    let id = lab.ask("arm", 200);
    lab.pass(Duration::from_millis(150));
    assert!(lab.session.is_up());
    assert_eq!(lab.accepted.get(&id), Some(&1));
    lab.pass(Duration::from_millis(150));
    assert_eq!(ended(&lab, id), (State::Completed, "at some place"));
    lab.check();
}

#[test]
fn a_device_rejection_is_reported_with_its_reason() {
    let mut lab = Pair::new(1);
    let first = lab.ask("arm", 500);
    let second = lab.ask("arm", 500);
    let third = lab.ask("leg", 500);
    lab.pass(Duration::from_millis(300));
    assert_eq!(lab.rejected[&second], "busy with another task");
    assert_eq!(
        lab.rejected[&third],
        "no component 'leg'; it has: arm, belt"
    );
    lab.abort(first);
    lab.pass(Duration::from_millis(100));
    assert_eq!(ended(&lab, first).0, State::Aborted);
    lab.check();
}

#[test]
fn a_goal_too_long_for_the_device_is_rejected_with_the_limit() {
    let mut lab = Pair::new(1);
    lab.pass(Duration::from_millis(300));
    let id = TaskId::new(1).unwrap();
    let goal = "x".repeat(200);
    lab.asked.insert(id, goal.clone());
    lab.session.start(lab.now, id, "arm", &goal);
    lab.settle();
    assert!(lab.rejected[&id].starts_with("the goal is 200 bytes long, the device takes 1"));
}

#[test]
fn a_rejected_task_leaves_its_number_to_the_next_one() {
    let mut lab = Pair::new(1);
    lab.pass(Duration::from_millis(300));
    lab.ask("arm", 60_000);
    for _ in 0..20 {
        lab.ask("arm", 1);
        lab.pass(Duration::from_millis(30));
    }
    assert_eq!(lab.rejected.len(), 20);
    // One whose Start never arrives.
    lab.down.cut(lab.now..lab.now + Duration::from_millis(1500));
    lab.ask("belt", 1);
    lab.pass(Duration::from_millis(3000));
    assert_eq!(lab.rejected.len(), 21);
    lab.ask("belt", 60_000);
    lab.pass(Duration::from_millis(100));
    let journal = String::from_utf8(lab.disk.written()).unwrap();
    let started = journal
        .lines()
        .rev()
        .find(|line| line.contains("\"link\":"));
    assert!(started.unwrap().contains("\"link\":2,"), "{journal}");
}

#[test]
fn a_device_that_cannot_describe_a_component_is_rejected_with_the_reason() {
    let mut lab = Pair::new(1);
    let long: &'static str = Box::leak("n".repeat(120).into_boxed_str());
    let motor = |place, name| Motor {
        place,
        name,
        loss: Loss::Abort,
        world: Rc::clone(&lab.world),
        ends_at: Instant::ZERO,
        aborted: false,
    };
    let motors = [motor(0, "arm"), motor(1, long)];
    lab.node = Node::new(Identity::new("lab", "1", 1), Acting::new(motors));
    lab.pass(Duration::from_millis(3000));
    assert!(!lab.session.is_up());
    let reason = "component 1: its description is longer than a frame";
    let told = lab.trace.iter().filter(|line| line.contains(reason));
    assert!((2..=4).contains(&told.count()), "{:?}", lab.trace);
}

#[test]
fn without_a_device_a_task_is_rejected_in_time_and_never_starts() {
    let mut lab = Pair::new(1);
    lab.down.cut(Instant::ZERO..Instant::from_millis(5000));
    let id = lab.ask("arm", 200);
    lab.pass(Duration::from_millis(999));
    assert!(lab.rejected.is_empty());
    lab.pass(Duration::from_millis(2));
    assert_eq!(lab.rejected[&id], "device is not answering");
    lab.pass(Duration::from_secs(10));
    lab.check();
}

#[test]
fn a_cut_line_fails_the_task_only_after_the_devices_timeout() {
    for (down, up) in [(true, false), (false, true), (true, true)] {
        let mut lab = Pair::new(1);
        lab.pass(Duration::from_millis(300));
        let id = lab.ask("arm", 60_000);
        let belt = lab.ask("belt", 20_000);
        lab.pass(Duration::from_millis(500));
        let cut = lab.now;
        let until = cut + Duration::from_secs(5);
        if down {
            lab.down.cut(cut..until);
        }
        if up {
            lab.up.cut(cut..until);
        }
        // Ping period, link timeout, and at most one second.
        lab.pass(Duration::from_millis(1000));
        assert!(lab.ended.is_empty() || !up, "told by the device itself");
        lab.pass(Duration::from_millis(1300));
        let (state, text) = ended(&lab, id);
        assert_eq!(state, State::Failed);
        assert!(["device is not answering", "link was lost"].contains(&text));
        // A task that carries on stays, and its true outcome is reported.
        assert!(!lab.ended.contains_key(&belt));
        lab.pass(Duration::from_secs(20));
        assert_eq!(ended(&lab, belt).0, State::Completed);
        lab.check();
    }
}

#[test]
fn a_reset_fails_the_devices_tasks_and_it_serves_again() {
    let mut lab = Pair::new(1);
    let id = lab.ask("arm", 60_000);
    lab.pass(Duration::from_millis(500));
    lab.reset();
    lab.pass(Duration::from_millis(300));
    assert_eq!(ended(&lab, id), (State::Failed, "device was reset"));
    let next = lab.ask("arm", 100);
    lab.pass(Duration::from_millis(300));
    assert_eq!(ended(&lab, next).0, State::Completed);
    lab.check();
}

#[test]
fn a_task_survives_a_briefly_unplugged_line() {
    let mut lab = Pair::new(1);
    let id = lab.ask("arm", 2000);
    lab.pass(Duration::from_millis(500));
    lab.replug();
    lab.pass(Duration::from_millis(2000));
    assert_eq!(ended(&lab, id).0, State::Completed);
    lab.check();
}

#[test]
fn an_abort_is_resent_in_a_new_session() {
    let mut lab = Pair::new(1);
    let id = lab.ask("belt", 60_000);
    lab.pass(Duration::from_millis(500));
    lab.down.cut(lab.now..lab.now + Duration::from_millis(1500));
    lab.abort(id);
    lab.pass(Duration::from_millis(1400));
    assert!(lab.ended.is_empty());
    lab.pass(Duration::from_millis(600));
    assert_eq!(ended(&lab, id).0, State::Aborted);
    lab.check();
}

#[test]
fn another_gateways_tasks_are_aborted_and_acknowledged() {
    let mut lab = Pair::new(1);
    let stranger = lab.ask("arm", 60_000);
    lab.pass(Duration::from_millis(500));
    // The gateway dies; another one, that knows nothing, takes over.
    lab.session = session(&Disk::default());
    lab.asked.remove(&stranger);
    lab.accepted.clear();
    lab.session.handle_connected(lab.now);
    lab.pass(Duration::from_millis(3000));
    assert_eq!(lab.world.borrow().moving, [None, None]);
    let next = lab.ask("arm", 100);
    lab.pass(Duration::from_millis(500));
    assert_eq!(ended(&lab, next).0, State::Completed);
}

impl Drop for Pair {
    fn drop(&mut self) {
        if std::thread::panicking() {
            for line in &self.trace {
                eprintln!("{line}");
            }
        }
    }
}
