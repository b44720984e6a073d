//! The plan of a simulated laboratory: a list of happenings, generated from a seed, that can be shrunk.

use std::fmt;
use std::time::Duration;

use ztl_core::link::{Busy, Loss};
pub(crate) use ztl_sim::line::Dice;
use ztl_sim::line::Faults;

/// A direction of a line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Way {
    /// To the device.
    Down,
    /// To the gateway.
    Up,
}

/// Properties of a motor.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MotorPlan {
    /// What it does when the link is lost.
    pub loss: Loss,
    /// What it does with a second task.
    pub busy: Busy,
    /// How long it takes to stop, and how often it is polled.
    pub slow: Duration,
    /// How often it fails to reach its safe state before it does.
    pub failures: u8,
}

/// A happening.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum What {
    /// A client starts a task.
    Ask {
        /// The client.
        client: usize,
        /// The device.
        device: usize,
        /// The motor; the one after the last does not exist.
        motor: usize,
        /// Duration of the task.
        millis: u64,
        /// Whether the client waits for an early final state.
        to_end: bool,
    },
    /// A client aborts a task of any client, numbered from 0 in the order of starting.
    Abort {
        /// The client.
        client: usize,
        /// The task.
        task: usize,
    },
    /// A button of the device starts a task, and an event is reported.
    Press {
        /// The device.
        device: usize,
        /// The motor.
        motor: usize,
        /// Duration of the task.
        millis: u64,
    },
    /// The device is reset.
    Reset(usize),
    /// The line is closed, loses all bytes on it, and is opened again after this time.
    Unplug(usize, Duration),
    /// All bytes are lost for this time.
    Cut(usize, Way, Duration),
    /// All bytes are delayed for this time.
    Stall(usize, Way, Duration),
    /// The line has these faults for this time.
    Noise(usize, Way, Faults, Duration),
    /// The gateway is killed after writing this many bytes of a journal entry, and restarted after this time.
    Kill(usize, Duration),
    /// The disk is full for this time.
    Full(Duration),
    /// Messages between clients and gateway are lost for this time.
    Deaf(Duration),
    /// A node of a shared line has this trouble for this time.
    Trouble(usize, Trouble, Duration),
}

/// What is wrong with a node of a shared line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Trouble {
    /// It sends rubbish without being asked, a fifth of the time.
    Babbles,
    /// It always has a reading, as long as fits.
    Floods,
    /// It is reset every 100 ms.
    Resets,
    /// It neither hears nor sends.
    Silent,
    /// It hears, and is not heard.
    Mute,
}

impl Trouble {
    /// All of them.
    pub const ALL: [Self; 5] = [
        Self::Babbles,
        Self::Floods,
        Self::Resets,
        Self::Silent,
        Self::Mute,
    ];
}

/// A happening and its time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Happening {
    /// Time from the start.
    pub at: Duration,
    /// The happening.
    pub what: What,
}

/// The plan of a run.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    /// The seed of the plan and of the line faults.
    pub seed: u64,
    /// Whether the devices are nodes of one shared line.
    pub shared: bool,
    /// The devices and their motors.
    pub devices: Vec<[MotorPlan; 2]>,
    /// Number of clients.
    pub clients: usize,
    /// Whether the gateway has a journal.
    pub journal: bool,
    /// The happenings, in order.
    pub happenings: Vec<Happening>,
}

/// The end of a happening with a duration.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Revert {
    Plug(usize),
    Silence(usize, Way),
    Healthy(usize),
    Start,
    Empty,
}

/// Nodes of a shared line.
const NODES: u64 = 16;
/// How long a gateway needs for nearly all commands of a session if it sends only pings.
const IDLE: Duration = Duration::from_secs(56);

impl Plan {
    /// The plan of a seed, with one or two devices on lines of their own.
    #[must_use]
    pub fn new(seed: u64) -> Self {
        let mut dice = Dice::new(seed);
        let devices = 1 + dice.below(2);
        Self::with(seed, dice, devices, false)
    }

    /// The plan of a seed, with 16 nodes on a shared line.
    #[must_use]
    pub fn shared(seed: u64) -> Self {
        Self::with(seed, Dice::new(seed), NODES, true)
    }

    fn with(seed: u64, mut dice: Dice, devices: u64, shared: bool) -> Self {
        let devices: Vec<_> = (0..devices)
            .map(|_| [motor(&mut dice), motor(&mut dice)])
            .collect();
        let clients = 1 + dice.below(3) as usize;
        let journal = dice.chance(0.75);
        let mut happenings = Vec::new();
        let mut at = Duration::ZERO;
        let mut asked = 0;
        for _ in 0..6 + dice.below(20) {
            at += Duration::from_millis(dice.below(700));
            let what = if shared && dice.chance(0.2) {
                trouble(&mut dice)
            } else {
                what(&mut dice, devices.len(), clients, journal, asked)
            };
            asked += usize::from(matches!(what, What::Ask { .. } | What::Press { .. }));
            happenings.push(Happening { at, what });
        }
        // Sometimes a session has had nearly all its commands when the first happening begins.
        if !shared && dice.chance(0.1) {
            let idle = IDLE + Duration::from_millis(dice.below(6000));
            for happening in &mut happenings {
                happening.at += idle;
            }
        }
        Self {
            seed,
            shared,
            devices,
            clients,
            journal,
            happenings,
        }
    }
}

fn trouble(dice: &mut Dice) -> What {
    let node = dice.below(NODES) as usize;
    let trouble = Trouble::ALL[dice.below(Trouble::ALL.len() as u64) as usize];
    What::Trouble(node, trouble, Duration::from_millis(dice.below(6000)))
}

fn motor(dice: &mut Dice) -> MotorPlan {
    let loss = match dice.below(4) {
        0 | 1 => Loss::Abort,
        2 => Loss::Hold,
        _ => Loss::CarryOn,
    };
    let busy = match dice.below(4) {
        0 | 1 => Busy::Refuse,
        2 => Busy::Queue(1 + dice.below(2) as u8),
        _ => Busy::Replace,
    };
    let slow = Duration::from_millis([10, 10, 50, 300][dice.below(4) as usize]);
    let failures = [0, 0, 0, 1, 8][dice.below(5) as usize];
    MotorPlan {
        loss,
        busy,
        slow,
        failures,
    }
}

fn what(dice: &mut Dice, devices: usize, clients: usize, journal: bool, asked: usize) -> What {
    let client = dice.below(clients as u64) as usize;
    let device = dice.below(devices as u64) as usize;
    let way = [Way::Down, Way::Up][dice.below(2) as usize];
    let time = |dice: &mut Dice, most| Duration::from_millis(dice.below(most));
    match dice.below(27) {
        0..=7 => What::Ask {
            client,
            device,
            // Rarely one that does not exist.
            motor: if dice.chance(0.03) {
                2
            } else {
                dice.below(2) as usize
            },
            millis: [0, 30, 400, 1500, 4000][dice.below(5) as usize] + dice.below(60),
            to_end: dice.chance(0.5),
        },
        8..=10 => What::Abort {
            client,
            task: asked.saturating_sub(1 + dice.below(3) as usize),
        },
        11 | 12 => What::Reset(device),
        13 => What::Unplug(device, time(dice, 2500)),
        14 | 15 => What::Cut(device, way, time(dice, 6500)),
        16 => What::Stall(device, way, time(dice, 4000)),
        17..=19 => {
            let faults = noise(dice);
            What::Noise(device, way, faults, time(dice, 6000))
        }
        20 | 21 => What::Kill(dice.below(25) as usize, time(dice, 1500)),
        24..=26 => What::Press {
            device,
            motor: dice.below(2) as usize,
            millis: [0, 30, 400, 1500, 4000][dice.below(5) as usize] + dice.below(60),
        },
        22 if journal => What::Full(time(dice, 2000)),
        _ => What::Deaf(time(dice, 2500)),
    }
}

fn noise(dice: &mut Dice) -> Faults {
    let rate = |dice: &mut Dice| [0.0, 0.0, 2e-2, 5e-3, 1e-3, 2e-4][dice.below(6) as usize];
    Faults {
        flip: rate(dice) / 8.0,
        drop: rate(dice),
        double: rate(dice),
        stall: rate(dice) / 4.0,
        stall_for: Duration::from_millis(dice.below(4000)),
    }
}

impl fmt::Display for Plan {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let journal = if self.journal { "a" } else { "no" };
        writeln!(
            f,
            "seed {}: {} clients, {journal} journal{}",
            self.seed,
            self.clients,
            if self.shared { ", a shared line" } else { "" }
        )?;
        for (number, [arm, belt]) in self.devices.iter().enumerate() {
            writeln!(f, "device {number}: arm {arm:?}, belt {belt:?}")?;
        }
        for Happening { at, what } in &self.happenings {
            writeln!(f, "{:>8} ms  {what:?}", at.as_millis())?;
        }
        Ok(())
    }
}
