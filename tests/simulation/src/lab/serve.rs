//! After all faults: every motor serves, and on a shared line every node has its turn.

use std::time::Duration;

use super::motor::NAMES;
use super::{Lab, Summary};
use crate::plan::{Dice, Trouble};

const ARM: usize = 0;
const BELT: usize = 1;
/// Duration of the tasks of all nodes at once.
const BUSY: u64 = 3500;
/// Until all tasks run and descriptions are read.
const BEGIN: Duration = Duration::from_millis(1000);
const MEASURED: Duration = Duration::from_millis(1500);
/// Until all clients know the outcomes.
const TOLD: Duration = Duration::from_secs(6);
/// Longest time without a turn of a node with a task.
const TURN: Duration = Duration::from_millis(50);
/// Longest time until a `Start` or an `Abort` is sent: a question that is under way, and its answer.
const URGENT: Duration = Duration::from_millis(20);
/// The same two while another node has this trouble.
const fn bounds(trouble: Trouble) -> [Duration; 2] {
    let [turn, urgent] = match trouble {
        // Rubbish takes up to 35 ms, and what it damages is asked again.
        Trouble::Babbles => [200, 100],
        _ => [60, 30],
    };
    [Duration::from_millis(turn), Duration::from_millis(urgent)]
}

impl Lab {
    /// Runs a new task on each motor of each device.
    pub(super) fn serve(&mut self) -> Result<(), String> {
        for device in 0..self.devices.len() {
            for motor in 0..NAMES.len() {
                self.serve_one(device, motor)?;
            }
        }
        Ok(())
    }

    fn serve_one(&mut self, device: usize, motor: usize) -> Result<(), String> {
        let task = self.ask(0, device, motor, 20, true);
        self.pass_until(self.now + Duration::from_millis(1500))?;
        self.books.completed(task)
    }

    /// Runs a task on each node of a shared line at once: without faults, and while one node has a trouble.
    pub(super) fn serve_shared(&mut self, seed: u64, summary: &mut Summary) -> Result<(), String> {
        let all = self.busy(ARM, |_| true)?;
        summary.healthy = self.measure(|_| true, [TURN, URGENT], "all nodes are well")?;
        self.pass_until(self.now + TOLD)?;
        all.into_iter().try_for_each(|task| self.books.completed(task))?;
        let found = self.line.iter().flat_map(|line| &line.found).count();
        if found != self.devices.len() {
            return Err(format!("a search finds {found} nodes"));
        }

        let mut dice = Dice::new(seed);
        let ill = dice.below(self.devices.len() as u64) as usize;
        let number = dice.below(Trouble::ALL.len() as u64) as usize;
        let trouble = Trouble::ALL[number];
        let others = |device: usize| device != ill;
        let lasts = BEGIN + MEASURED + TOLD;
        self.trouble(ill, trouble, lasts);
        self.note(|| format!("device {ill} has a trouble: {trouble:?}"));
        let tasks = self.busy(BELT, others)?;
        let what = format!("device {ill} {trouble:?}");
        summary.troubled[number] = self.measure(others, bounds(trouble), &what)?;
        self.pass_until(self.now + TOLD)?;
        tasks.into_iter().try_for_each(|task| self.books.completed(task))?;
        self.pass_until(self.now + Duration::from_secs(4))?;
        self.serve_one(ill, BELT)?;
        summary.collided = self.line.iter().map(|line| line.wire.collided).sum();
        Ok(())
    }

    /// Starts a task on this motor of these devices, and waits until they run.
    fn busy(
        &mut self,
        motor: usize,
        of: impl Fn(usize) -> bool,
    ) -> Result<Vec<usize>, String> {
        let clients = self.people.len();
        let devices = (0..self.devices.len()).filter(|device| of(*device));
        let tasks = devices
            .map(|device| self.ask(device % clients, device, motor, BUSY, false))
            .collect();
        self.pass_until(self.now + BEGIN)?;
        Ok(tasks)
    }

    /// Measures the longest time without a turn of these nodes, and until a `Start` or an `Abort` is sent.
    fn measure(
        &mut self,
        of: impl Fn(usize) -> bool,
        most: [Duration; 2],
        what: &str,
    ) -> Result<[Duration; 2], String> {
        if let Some(line) = &mut self.line {
            line.watch(self.now);
        }
        self.pass_until(self.now + MEASURED)?;
        let now = self.now;
        let Some(line) = &mut self.line else {
            return Ok([Duration::ZERO; 2]);
        };
        let longest = line.longest(now, of);
        if longest > most || longest[1] > most[1] {
            return Err(format!("turn: {longest:?}, longer than {most:?}, while {what}"));
        }
        Ok(longest)
    }
}
