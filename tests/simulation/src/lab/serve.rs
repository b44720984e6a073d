//! After all faults: every motor serves, and on a shared line every node has its turn.

use std::time::Duration;

use ztl_core::State;

use super::motor::NAMES;
use super::{Lab, Summary};
use crate::plan::{Dice, Trouble};

const ARM: usize = 0;
const BELT: usize = 1;
/// Duration of the tasks of all nodes at once.
const BUSY: u64 = 3500;
/// Until all tasks run and descriptions are read.
const BEGIN: Duration = Duration::from_millis(1000);
/// How long turns are measured; in the middle, each client aborts a task.
const MEASURED: Duration = Duration::from_millis(1600);
/// Until all clients know the outcomes.
const TOLD: Duration = Duration::from_secs(6);
/// Longest time without a turn of a node with a task, and until a `Start` or an `Abort` is sent: that of one question that
/// is under way, and its answer.
const HEALTHY: [Duration; 2] = [Duration::from_millis(50), Duration::from_millis(20)];

/// The same while another node has this trouble.
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
        self.books.came_to(task, State::Completed)
    }

    /// Runs a task on each node of a shared line at once: without faults, and while one node has a trouble.
    pub(super) fn serve_shared(&mut self, seed: u64, summary: &mut Summary) -> Result<(), String> {
        summary.healthy = self.serve_all(ARM, None, HEALTHY, "all nodes are well")?;
        let found = self.line.iter().flat_map(|line| &line.found).count();
        if found != self.devices.len() {
            return Err(format!("a search finds {found} nodes"));
        }

        let mut dice = Dice::new(seed);
        let ill = dice.below(self.devices.len() as u64) as usize;
        let number = dice.below(Trouble::ALL.len() as u64) as usize;
        let trouble = Trouble::ALL[number];
        let what = format!("device {ill} {trouble:?}");
        self.note(|| format!("from now on {what}"));
        self.trouble(ill, trouble, BEGIN + MEASURED + TOLD);
        summary.troubled[number] = self.serve_all(BELT, Some(ill), bounds(trouble), &what)?;
        self.pass_until(self.now + Duration::from_secs(4))?;
        self.serve_one(ill, BELT)?;
        summary.collided = self.line.iter().map(|line| line.wire.collided).sum();
        Ok(())
    }

    /// Runs a task on this motor of all nodes but one. Returns the longest time without a turn, and until a `Start` or an
    /// `Abort` was sent.
    fn serve_all(
        &mut self,
        motor: usize,
        ill: Option<usize>,
        most: [Duration; 2],
        what: &str,
    ) -> Result<[Duration; 2], String> {
        let clients = self.people.len();
        let well = |device: &usize| Some(*device) != ill;
        let tasks: Vec<usize> = (0..self.devices.len())
            .filter(well)
            .map(|device| self.ask(device % clients, device, motor, BUSY, false))
            .collect();
        self.pass_until(self.now + BEGIN)?;
        if let Some(line) = &mut self.line {
            line.watch(self.now);
        }
        self.pass_until(self.now + MEASURED / 2)?;
        let aborted = &tasks[..clients];
        for task in aborted {
            let id = self.books.id(*task);
            let id = id.ok_or_else(|| format!("promise 3: a new task, {task}, is not begun"))?;
            self.people[task % clients].abort(*task, id);
        }
        self.pass_until(self.now + MEASURED / 2)?;
        let now = self.now;
        let longest = self.line.as_mut().map(|line| line.longest(now, |device| well(&device)));
        let longest = longest.unwrap_or_default();
        if longest[0] > most[0] || longest[1] > most[1] {
            return Err(format!("turn: {longest:?}, longer than {most:?}, while {what}"));
        }
        self.pass_until(self.now + TOLD)?;
        for task in &tasks {
            let state = if aborted.contains(task) { State::Aborted } else { State::Completed };
            self.books.came_to(*task, state)?;
        }
        Ok(longest)
    }
}
