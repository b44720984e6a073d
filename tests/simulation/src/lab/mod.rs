//! A whole laboratory on virtual time: clients, the gateway's dispatcher, sessions and journal,
//! lines with faults, and devices; and what all of that came to, against what really moved.

mod client;
mod device;
mod gateway;
mod happen;
mod judge;
mod motor;

use std::cell::{Cell, RefCell};
use std::collections::VecDeque;
use std::rc::Rc;
use std::time::Duration;

use ztl_core::Instant;
use ztl_core::time::earliest;

use self::client::{Known, Person, Wish, person};
use self::device::Device;
use self::gateway::{Disk, Gateway, Letter, name};
use self::happen::Revert;
use self::judge::Books;
use self::motor::{Condition, NAMES, Shared, Truth};
use crate::plan::{Happening, Plan};

/// After the last fault everything must have settled within this.
const QUIET: Duration = Duration::from_secs(14);
/// A message between client and gateway takes this long.
const NETWORK: Duration = Duration::from_millis(1);
/// Most turns between two happenings; some ten times what the longest takes.
const TURNS: usize = 40_000;

/// What a run came to.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Summary {
    /// Tasks that a motor began.
    pub begun: u32,
    /// Tasks that came to their goal, for their clients.
    pub completed: u32,
    /// That ended in another way.
    pub ended: u32,
    /// That were refused.
    pub refused: u32,
    /// Of which nobody can say what became.
    pub unknown: u32,
}

impl std::ops::AddAssign for Summary {
    fn add_assign(&mut self, other: Self) {
        self.begun += other.begun;
        self.completed += other.completed;
        self.ended += other.ended;
        self.refused += other.refused;
        self.unknown += other.unknown;
    }
}

impl std::fmt::Display for Summary {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self {
            begun,
            completed,
            ended,
            refused,
            unknown,
        } = self;
        write!(
            f,
            "{begun} tasks were begun; clients were told {completed} completed, {ended} ended in \
             another way, {refused} refused, and could not know of {unknown}"
        )
    }
}

/// A promise that is broken.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Failure {
    /// Which.
    pub complaint: String,
    /// What happened, when it was asked for.
    pub trace: Vec<String>,
}

thread_local! {
    static NUMBER: Cell<u32> = const { Cell::new(0) };
}

/// A session's number: another each time, the same in each run.
fn number() -> u32 {
    NUMBER.set(NUMBER.get().wrapping_add(0x9E37_79B9));
    NUMBER.get()
}

/// Plays a plan. When `traced`, what happened comes with it.
///
/// # Errors
/// The first promise that is broken.
pub fn play(plan: &Plan, traced: bool) -> Result<(Summary, Vec<String>), Failure> {
    NUMBER.set(plan.seed as u32);
    let mut lab = Lab::new(plan, traced);
    let done = lab.run(plan);
    let trace = lab.trace;
    match done {
        Ok(summary) => Ok((summary, trace)),
        Err(complaint) => Err(Failure { complaint, trace }),
    }
}

struct Lab {
    now: Instant,
    truth: Shared,
    devices: Vec<Device>,
    /// `None` while it is dead.
    gateway: Option<Gateway>,
    boots: u32,
    disk: Option<Disk>,
    /// Since when the gateway runs and could write.
    able_since: Instant,
    people: Vec<Person>,
    /// Messages under way, with the moment when they arrive.
    to_gateway: VecDeque<(Instant, Letter)>,
    to_people: VecDeque<(Instant, Letter)>,
    deaf_until: Instant,
    /// What goes back to what it was, and when.
    reverts: Vec<(Instant, Revert)>,
    books: Books,
    traced: bool,
    trace: Vec<String>,
}

const BEGIN: Instant = Instant::from_millis(1000);

impl Lab {
    fn new(plan: &Plan, traced: bool) -> Self {
        let truth: Shared = Rc::new(RefCell::new(Truth::default()));
        truth.borrow_mut().motors = vec![[Condition::default(); 2]; plan.devices.len()];
        let device = |(number, motors): (usize, _)| {
            Device::new(BEGIN, plan.seed, number, motors, Rc::clone(&truth))
        };
        let devices = plan.devices.iter().copied().enumerate().map(device);
        let mut lab = Self {
            now: BEGIN,
            devices: devices.collect(),
            truth,
            gateway: None,
            boots: 0,
            disk: plan.journal.then(Disk::default),
            able_since: BEGIN,
            people: (0..plan.clients).map(Person::new).collect(),
            to_gateway: VecDeque::new(),
            to_people: VecDeque::new(),
            deaf_until: BEGIN,
            reverts: Vec::new(),
            books: Books::new(plan.journal),
            traced,
            trace: Vec::new(),
        };
        lab.start_gateway();
        lab
    }

    fn note(&mut self, text: impl FnOnce() -> String) {
        if self.traced {
            let now = self.now.since(BEGIN).as_secs_f64() * 1000.0;
            self.trace.push(format!("{now:>10.3} ms  {}", text()));
        }
    }

    fn run(&mut self, plan: &Plan) -> Result<Summary, String> {
        for Happening { at, what } in &plan.happenings {
            self.pass_until(BEGIN + *at)?;
            self.note(|| format!("> {what:?}"));
            self.happen(*what);
        }
        let last = self.reverts.iter().map(|(at, _)| *at).max();
        let quiet = last.unwrap_or(self.now).max(self.now).max(self.deaf_until);
        self.pass_until(quiet)?;
        self.note(|| "> from now on nothing goes wrong".to_owned());
        for device in &mut self.devices {
            device.mend(self.now);
        }
        self.pass_until(self.now + QUIET)?;
        self.ask_again();
        self.pass_until(self.now + Duration::from_secs(4))?;
        self.books.settled(&self.truth.borrow())?;
        self.serve()?;
        Ok(self.books.summary(&self.truth.borrow()))
    }

    /// Every end that a client was told is still the same.
    fn ask_again(&mut self) {
        for (task, who, known) in self.books.all() {
            if let Known::Ended(id, ..) = known {
                self.people[who].watch(self.now, task, id);
            }
        }
    }

    /// Each device does a new task with each motor.
    fn serve(&mut self) -> Result<(), String> {
        for device in 0..self.devices.len() {
            for motor in 0..NAMES.len() {
                let task = self.ask(0, device, motor, 20, true);
                self.pass_until(self.now + Duration::from_millis(1500))?;
                self.books.completed(task)?;
            }
        }
        Ok(())
    }

    fn ask(
        &mut self,
        client: usize,
        device: usize,
        motor: usize,
        millis: u64,
        to_end: bool,
    ) -> usize {
        let task = self.books.ask(client, (device, motor));
        let component = NAMES.get(motor).copied().unwrap_or("leg");
        self.people[client].wish(Wish {
            task,
            device: name(device),
            component,
            goal: format!("{task} {millis}"),
            to_end,
        });
        task
    }

    fn pass_until(&mut self, end: Instant) -> Result<(), String> {
        for _ in 0..TURNS {
            self.turn()?;
            // What is due again at once would stand still.
            let soon = self.now + Duration::from_micros(20);
            match self.wake() {
                Some(wake) if wake < end => self.now = wake.max(soon),
                _ => {
                    self.now = end.max(self.now);
                    return self.turn();
                }
            }
        }
        Err(format!(
            "something is due at once for ever: {:?}",
            self.wake()
        ))
    }

    fn wake(&self) -> Option<Instant> {
        let devices = self.devices.iter().map(|device| device.wake(self.now));
        let people = self.people.iter().map(Person::poll_timeout);
        let letters = [&self.to_gateway, &self.to_people];
        let letters = letters.into_iter().map(|l| l.front().map(|(at, _)| *at));
        let reverts = self.reverts.iter().map(|(at, _)| Some(*at));
        let gateway = self.gateway.as_ref().and_then(Gateway::poll_timeout);
        let all = devices.chain(people).chain(letters).chain(reverts);
        all.fold(gateway, earliest)
    }

    /// All that happens at this moment.
    fn turn(&mut self) -> Result<(), String> {
        gateway::set_clocks(self.now);
        self.revert();
        for device in 0..self.devices.len() {
            self.devices[device].turn(self.now);
            self.exchange(device);
        }
        self.carry_requests();
        if let Some(gateway) = &mut self.gateway {
            gateway.handle_timeout(self.now);
            for (device, event) in std::mem::take(&mut gateway.told) {
                self.note(|| format!("gateway, {}: {event:?}", name(device)));
                self.books.on_event(&event, &self.truth.borrow())?;
            }
        }
        for device in 0..self.devices.len() {
            self.exchange(device);
        }
        self.carry_answers()?;
        let truth = self.truth.borrow();
        for (number, device) in self.devices.iter().enumerate() {
            device.judge(self.now, &truth)?;
            if device.is_silent(self.now, self.able_since) {
                self.books.judge_silent(number, device.acts())?;
            }
        }
        self.books.judge(&truth)
    }

    /// Bytes between a session and its line.
    fn exchange(&mut self, device: usize) {
        let now = self.now;
        let line = &mut self.devices[device];
        let arrived = line.arrived(now);
        let Some(gateway) = &mut self.gateway else {
            return;
        };
        let session = &mut gateway.sessions[device];
        if line.is_plugged() {
            session.handle_bytes(now, &arrived);
        }
        let bytes = session.poll_transmit();
        line.send(now, &bytes);
    }

    /// Whether a message arrives.
    fn is_heard(&self) -> bool {
        self.now >= self.deaf_until
    }

    fn carry_requests(&mut self) {
        let now = self.now;
        while let Some(letter) = arrived(&mut self.to_gateway, now) {
            if let Some(gateway) = &mut self.gateway {
                gateway.handle_request(now, letter);
            }
        }
    }

    fn carry_answers(&mut self) -> Result<(), String> {
        let (now, heard) = (self.now, self.is_heard());
        if let Some(gateway) = &mut self.gateway {
            let out = std::mem::take(&mut gateway.out);
            let out = out.into_iter().filter(|_| heard);
            self.to_people
                .extend(out.map(|letter| (now + NETWORK, letter)));
        }
        while let Some(letter) = arrived(&mut self.to_people, now) {
            self.note(|| {
                let text = String::from_utf8_lossy(&letter.1).into_owned();
                format!("client {} hears {text}", person(&letter.0))
            });
            self.people[person(&letter.0)].handle_reply(now, &letter);
        }
        for number in 0..self.people.len() {
            self.people[number].handle_timeout(now);
            let out = std::mem::take(&mut self.people[number].out);
            for letter in out {
                self.note(|| {
                    let text = String::from_utf8_lossy(&letter.1).into_owned();
                    format!("client {number} says {text}")
                });
                if heard && self.gateway.is_some() {
                    self.to_gateway.push_back((now + NETWORK, letter));
                }
            }
            for (task, known) in std::mem::take(&mut self.people[number].news) {
                self.note(|| format!("client {number} knows of task {task}: {known:?}"));
                self.books.on_news(task, known, &self.truth.borrow())?;
            }
        }
        Ok(())
    }
}

/// Takes out a letter that has arrived.
fn arrived(letters: &mut VecDeque<(Instant, Letter)>, now: Instant) -> Option<Letter> {
    let (at, _) = letters.front()?;
    if *at > now {
        return None;
    }
    letters.pop_front().map(|(_, letter)| letter)
}
