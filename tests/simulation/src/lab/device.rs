//! A device with its line: the real node, which can be reset.

use std::ops::Range;
use std::rc::Rc;
use std::time::Duration;

use ztl_core::Instant;
use ztl_core::link::{LINK_TIMEOUT, Loss};
use ztl_core::time::earliest;
use ztl_mcu::Reason;
use ztl_sim::line::{Faults, FaultyLine};

use super::gateway::BAUD;
use super::motor::{Motor, Shared, Truth};
use super::some_node::{Place, SomeNode};
use crate::plan::{Dice, MotorPlan, Trouble, Way};

/// Bytes are transferred in pieces of about this duration.
const BURST: Duration = Duration::from_millis(1);
/// Most time until the node of a shared line begins its answer, in µs: the main loop of its firmware takes it.
const MAIN_LOOP: u64 = 700;
/// How often a node is reset or babbles that does, and how many bytes it sends: a fifth of what the line takes.
const RESETS: Duration = Duration::from_millis(100);
const BABBLES: Duration = Duration::from_millis(87);
const RUBBISH: u64 = 200;
/// The last new command arrives at most this long after a direction is cut, or after a stall releases what was sent before: a
/// `Start` that is in the line, and a `Ping` that was due.
const LAST_COMMAND: Duration = Duration::from_millis(1300);

/// Clients learn the final state of a task at most this long after a direction is cut: an answer that is in the line for a
/// second, two link timeouts, and one second.
const GIVEN_UP: Duration = Duration::from_millis(4100);

/// The line to the gateway.
const UP: u64 = 2;

pub(super) struct Device {
    number: usize,
    motors: [MotorPlan; 2],
    node: SomeNode,
    /// Its place on a shared line.
    place: Option<Place>,
    /// What is wrong with it, and when the node does that next.
    trouble: Option<(Trouble, Instant)>,
    dice: Dice,
    /// When it has something to do, at the latest; only on a shared line.
    due: Instant,
    boots: u32,
    /// Time of the last reset, when its clock was 0.
    booted: Instant,
    down: FaultyLine,
    up: FaultyLine,
    cuts: [Range<Instant>; 2],
    /// When the last stall ended before the line was closed.
    released: Instant,
    /// Number of happenings that keep the line closed.
    unplugged: u32,
    truth: Shared,
}

impl Device {
    pub(super) fn new(
        now: Instant,
        seed: u64,
        (number, place): (usize, Option<Place>),
        motors: [MotorPlan; 2],
        truth: Shared,
    ) -> Self {
        let mut dice = Dice::new(seed ^ (number as u64 + 1) << 40);
        let mut line = |way: u64| {
            let seed = seed ^ way << 50 ^ (number as u64) << 60;
            let line = FaultyLine::new(Faults::default(), seed);
            match (place.is_some(), way) {
                (false, _) => line.with_baud(BAUD),
                (true, UP) => line.with_latency(Duration::from_micros(dice.below(MAIN_LOOP))),
                (true, _) => line,
            }
        };
        Self {
            number,
            motors,
            node: node((number, place), motors, boot(number, 1), &truth),
            place,
            trouble: None,
            boots: 1,
            booted: now,
            down: line(1),
            up: line(UP),
            dice,
            due: now,
            cuts: [now..now, now..now],
            released: now,
            unplugged: 0,
            truth,
        }
    }

    fn clock(&self, now: Instant) -> Instant {
        Instant::ZERO + now.since(self.booted)
    }

    /// Gives the node a trouble, or ends it.
    pub(super) fn set_trouble(&mut self, trouble: Option<(Trouble, Instant)>) {
        self.trouble = trouble;
        self.due = Instant::ZERO;
        let mut truth = self.truth.borrow_mut();
        match self.trouble {
            Some((Trouble::Floods, _)) => truth.floods = Some(self.number),
            _ if truth.floods == Some(self.number) => truth.floods = None,
            _ => {}
        }
    }

    fn trouble(&mut self, now: Instant) {
        match &mut self.trouble {
            Some((Trouble::Babbles, next)) if *next <= now => {
                *next = now + BABBLES;
                let rubbish = (0..self.dice.below(2 * RUBBISH)).map(|_| self.dice.below(256) as u8);
                let rubbish: Vec<u8> = rubbish.collect();
                self.up.handle_bytes(now, &rubbish);
            }
            Some((Trouble::Resets, next)) if *next <= now => {
                *next = now + RESETS;
                self.reset(now);
            }
            _ => {}
        }
    }

    /// Passes bytes to the node, advances the motors, and sends output.
    pub(super) fn turn(&mut self, now: Instant) {
        self.trouble(now);
        let clock = self.clock(now);
        let mut buffer = [0xA5; 64];
        loop {
            let count = self.down.poll_bytes(now, &mut buffer);
            if count == 0 {
                break;
            }
            self.node.handle_bytes(clock, &buffer[..count]);
        }
        self.node.handle_timeout(clock);
        loop {
            let count = self.node.poll_transmit(clock, &mut buffer);
            if count == 0 {
                break;
            }
            if self.is_plugged() {
                self.up.handle_bytes(now, &buffer[..count]);
            }
        }
        if self.place.is_some() {
            self.due = self.next(now);
        }
    }

    /// Whether it has something to do, which the devices of a shared line mostly have not.
    pub(super) fn is_due(&self, now: Instant) -> bool {
        self.place.is_none() || self.due <= now
    }

    /// A button starts a task, and an event is reported, for which there may be no room.
    pub(super) fn press(
        &mut self,
        now: Instant,
        motor: u8,
        task: usize,
        millis: u64,
    ) -> Result<(), Reason> {
        self.due = now;
        let clock = self.clock(now);
        self.node.report_event(clock, &format!("event {task}"));
        let goal = format!("{task} {millis}");
        self.node.start_here(clock, motor, &goal)
    }

    /// Whether it was reset.
    pub(super) const fn was_reset(&self) -> bool {
        self.boots > 1
    }

    /// Bytes that have arrived at the gateway.
    pub(super) fn arrived(&mut self, now: Instant) -> Vec<u8> {
        let mut bytes = Vec::new();
        let mut buffer = [0xA5; 64];
        loop {
            let count = self.up.poll_bytes(now, &mut buffer);
            if count == 0 {
                return bytes;
            }
            bytes.extend_from_slice(&buffer[..count]);
        }
    }

    pub(super) fn send(&mut self, now: Instant, bytes: &[u8]) {
        if self.is_plugged() {
            self.down.handle_bytes(now, bytes);
            self.due = now;
        }
    }

    pub(super) fn wake(&self, now: Instant) -> Instant {
        if self.place.is_some() {
            self.due
        } else {
            self.next(now)
        }
    }

    fn next(&self, now: Instant) -> Instant {
        let clock = self.clock(now);
        let node = now + self.node.poll_timeout(clock).since(clock);
        // A shared line has made pieces already.
        let burst = if self.place.is_some() {
            Duration::ZERO
        } else {
            BURST
        };
        let lines = [&self.down, &self.up].map(|line| line.poll_timeout(burst));
        let trouble = match self.trouble {
            Some((Trouble::Babbles | Trouble::Resets, next)) => Some(next),
            _ => None,
        };
        let other = lines.into_iter().chain([trouble]).fold(None, earliest);
        other.map_or(node, |other| other.min(node))
    }

    pub(super) fn reset(&mut self, now: Instant) {
        self.boots += 1;
        self.booted = now;
        self.due = now;
        for motor in 0..self.motors.len() {
            self.truth.borrow_mut().rest((self.number, motor), None);
        }
        let boot = boot(self.number, self.boots);
        self.node = node((self.number, self.place), self.motors, boot, &self.truth);
    }

    pub(super) fn unplug(&mut self, now: Instant) {
        self.unplugged += 1;
        self.released = self.released().min(now);
        self.down.lose();
        self.up.lose();
    }

    /// Returns whether the line is open again.
    pub(super) fn plug(&mut self) -> bool {
        self.unplugged -= 1;
        self.is_plugged()
    }

    pub(super) const fn is_plugged(&self) -> bool {
        self.unplugged == 0
    }

    pub(super) fn way(&mut self, way: Way) -> &mut FaultyLine {
        match way {
            Way::Down => &mut self.down,
            Way::Up => &mut self.up,
        }
    }

    pub(super) fn cut(&mut self, way: Way, time: Range<Instant>) {
        self.cuts[way as usize] = time.clone();
        self.way(way).cut(time);
    }

    /// Ends all faults of the line.
    pub(super) fn mend(&mut self, now: Instant) {
        self.set_trouble(None);
        for way in [Way::Down, Way::Up] {
            self.cut(way, now..now);
            self.way(way).set_faults(Faults::default());
        }
    }

    /// When the last stall ends or has ended. It releases commands, or answers to which the gateway sends new ones.
    fn released(&self) -> Instant {
        let lines = [&self.down, &self.up].map(FaultyLine::held_until);
        lines.into_iter().fold(self.released, Instant::max)
    }

    /// Whether a direction has been cut for so long that the gateway, if it was able to write, must have ended the tasks.
    pub(super) fn is_silent(&self, now: Instant, able: Instant) -> bool {
        let long =
            |cut: &Range<Instant>| cut.contains(&now) && now > cut.start.max(able) + GIVEN_UP;
        self.cuts.iter().any(long)
    }

    /// Which motors stop by themselves when the link is lost.
    pub(super) fn acts(&self) -> [bool; 2] {
        self.motors.map(|motor| motor.loss != Loss::CarryOn)
    }

    /// Promise 4: a device without new commands for this long is in its safe state.
    pub(super) fn judge(&self, now: Instant, truth: &Truth) -> Result<(), String> {
        let cut = |cut: &Range<Instant>| {
            let begin = cut.start.max(self.released());
            cut.contains(&now) && now > begin + LAST_COMMAND + LINK_TIMEOUT
        };
        if !self.cuts.iter().any(cut) {
            return Ok(());
        }
        for (plan, motor) in self.motors.iter().zip(truth.motors[self.number]) {
            if plan.loss != Loss::CarryOn && motor.powered && !motor.to_safety {
                return Err(format!(
                    "promise 4: device {} is not in its safe state without a link: {motor:?}",
                    self.number
                ));
            }
        }
        Ok(())
    }
}

/// Boot ids are random: never repeated.
fn boot(number: usize, boots: u32) -> u32 {
    boots.wrapping_mul(0x85EB_CA6B) ^ (number as u32) << 8
}

fn node(
    (number, place): (usize, Option<Place>),
    motors: [MotorPlan; 2],
    boot: u32,
    truth: &Shared,
) -> SomeNode {
    let motor = |place: usize| Motor {
        plan: motors[place],
        place: (number, place),
        truth: Rc::clone(truth),
        ends: None,
        safe_at: None,
        failures: motors[place].failures,
    };
    SomeNode::new([motor(0), motor(1)], boot, place)
}
