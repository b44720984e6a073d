//! A whole laboratory on virtual time: clients, the gateway's dispatcher, sessions and journal, lines with faults, and
//! devices. It compares what clients were told with what the motors really did.

mod boards;
mod client;
mod device;
mod gateway;
mod happen;
mod judge;
mod master;
mod motor;
mod own;
mod second;
mod serve;
mod shared;
mod some_node;
mod summary;

use std::cell::RefCell;
use std::collections::VecDeque;
use std::rc::Rc;
use std::time::Duration;

use ztl_core::Instant;
use ztl_core::time::earliest;
use ztl_link::Session;
use ztl_mcu::describe::Describe as _;
use ztl_sim::Disk;

use self::client::{Known, Person, Wish, person};
use self::device::Device;
use self::gateway::{Gateway, Letter, address, name};
use self::judge::Books;
use self::motor::{Condition, Motor, NAMES, Shared, Truth};
use self::shared::SharedLine;
use self::some_node::{Place, id};
use crate::plan::{Happening, Plan, Revert};
pub use summary::{Failure, Summary};

/// Everything must settle within this time after the last fault.
const QUIET: Duration = Duration::from_secs(14);
/// Latency of messages between clients and gateway.
const NETWORK: Duration = Duration::from_millis(1);
/// Maximum number of turns between two happenings, about ten times what they need.
const TURNS: usize = 40_000;

/// Plays a plan. Returns its trace if `traced`.
///
/// # Errors
/// The first broken promise.
pub fn play(plan: &Plan, traced: bool) -> Result<(Summary, Vec<String>), Failure> {
    gateway::set_first_number(plan.seed as u32);
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
    /// A board at the address of one of the devices, on a shared line.
    second: Option<Device>,
    /// The line of all devices, if they share one.
    line: Option<SharedLine>,
    /// `None` while it is killed.
    gateway: Option<Gateway>,
    boots: u32,
    disk: Option<Disk>,
    /// Since when the gateway runs and can write.
    able_since: Instant,
    people: Vec<Person>,
    /// Messages in transit, with their arrival times.
    to_gateway: VecDeque<(Instant, Letter)>,
    to_people: VecDeque<(Instant, Letter)>,
    deaf_until: Instant,
    /// Faults that end, and when.
    reverts: Vec<(Instant, Revert)>,
    books: Books,
    traced: bool,
    trace: Vec<String>,
}

const BEGIN: Instant = Instant::from_millis(1000);

impl Lab {
    fn new(plan: &Plan, traced: bool) -> Self {
        let truth: Shared = Rc::new(RefCell::new(Truth::default()));
        // The last ones are those of a second board.
        truth.borrow_mut().motors = vec![[Condition::default(); 2]; plan.devices.len() + 1];
        let device = |(number, motors): (usize, _)| {
            let address = address(number);
            let id = id(address);
            let place = plan.shared.then_some(Place { address, id });
            Device::new(BEGIN, plan.seed, (number, place), motors, Rc::clone(&truth))
        };
        let devices = plan.devices.iter().copied().enumerate().map(device);
        let mut lab = Self {
            now: BEGIN,
            devices: devices.collect(),
            second: None,
            truth,
            line: plan
                .shared
                .then(|| SharedLine::new(BEGIN, plan.devices.len(), plan.seed)),
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
        let reset: Vec<bool> = self.devices.iter().map(Device::was_reset).collect();
        self.books.own_settled(&self.truth.borrow(), &reset)?;
        self.judge_descriptions()?;
        let mut summary = Summary::default();
        match self.line {
            Some(_) => self.serve_shared(plan, &mut summary)?,
            None => self.serve()?,
        }
        summary += self.books.summary(&self.truth.borrow());
        Ok(summary)
    }

    /// Asks again for every reported final state, which must not have changed.
    fn ask_again(&mut self) {
        for (task, who, known) in self.books.all() {
            if let Known::Ended(id, ..) = known {
                self.people[who].watch(self.now, task, id);
            }
        }
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

    /// No part of a description comes twice or out of order, even if the line loses and repeats frames.
    fn judge_descriptions(&self) -> Result<(), String> {
        let sessions = self.gateway.iter().flat_map(|gateway| &gateway.sessions);
        let devices = sessions.filter_map(Session::device);
        for component in devices.flat_map(|device| &device.components) {
            if !Motor::DESCRIPTION
                .as_bytes()
                .starts_with(&component.description)
            {
                let text = String::from_utf8_lossy(&component.description);
                return Err(format!("{} describes itself as {text}", component.name));
            }
        }
        Ok(())
    }

    fn pass_until(&mut self, end: Instant) -> Result<(), String> {
        let lines = self.line.iter().map(|_| self.devices.len()).sum::<usize>();
        for _ in 0..TURNS * lines.max(1) {
            self.turn()?;
            // Advances even if something is due at once again.
            let soon = self.now + Duration::from_micros(20);
            match self.wake() {
                Some(wake) if wake < end => self.now = wake.max(soon),
                _ => {
                    self.now = end.max(self.now);
                    return self.turn();
                }
            }
        }
        Err(format!("time does not advance: {:?}", self.wake()))
    }

    fn wake(&self) -> Option<Instant> {
        let devices = self
            .devices
            .iter()
            .chain(&self.second)
            .map(|device| Some(device.wake(self.now)));
        let people = self.people.iter().map(Person::poll_timeout);
        let letters = [&self.to_gateway, &self.to_people];
        let letters = letters.into_iter().map(|l| l.front().map(|(at, _)| *at));
        let reverts = self.reverts.iter().map(|(at, _)| Some(*at));
        let gateway = self.gateway.as_ref().and_then(Gateway::poll_timeout);
        let line = self.line.iter().map(SharedLine::poll_timeout);
        let all = devices
            .chain(people)
            .chain(letters)
            .chain(reverts)
            .chain(line);
        all.fold(gateway, earliest)
    }

    /// Processes everything that is due now.
    fn turn(&mut self) -> Result<(), String> {
        gateway::set_clocks(self.now);
        self.revert();
        for device in self.devices.iter_mut().chain(&mut self.second) {
            if device.is_due(self.now) {
                device.turn(self.now);
            }
        }
        self.exchange();
        self.carry_requests();
        if let Some(gateway) = &mut self.gateway {
            gateway.handle_timeout(self.now);
            let taken = std::mem::take(&mut gateway.taken);
            for (id, goal) in &taken {
                self.books.on_taken(*id, goal)?;
            }
            for (device, event) in std::mem::take(&mut gateway.told) {
                self.books.on_reported(&event)?;
                self.note(|| format!("gateway, {}: {event:?}", name(device)));
                self.books.on_event(&event, &self.truth.borrow())?;
            }
        }
        match &mut self.line {
            Some(line) => line.transmit(self.now, self.gateway.as_mut())?,
            None => self.exchange(),
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

    /// Exchanges bytes between sessions and lines.
    fn exchange(&mut self) {
        if let Some(line) = &mut self.line {
            let devices = self.devices.iter_mut().chain(&mut self.second).collect();
            return line.receive(self.now, devices, self.gateway.as_mut());
        }
        for device in 0..self.devices.len() {
            self.exchange_with(device);
        }
    }

    fn exchange_with(&mut self, device: usize) {
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

/// Takes a letter that has arrived.
fn arrived(letters: &mut VecDeque<(Instant, Letter)>, now: Instant) -> Option<Letter> {
    let (at, _) = letters.front()?;
    if *at > now {
        return None;
    }
    letters.pop_front().map(|(_, letter)| letter)
}
