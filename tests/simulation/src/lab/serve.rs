//! After all faults: every motor serves, and on a shared line every node has its turn.

use std::time::Duration;

use ztl_core::State;

use super::motor::NAMES;
use super::shared::SharedLine;
use super::summary::Turns;
use super::{Lab, Summary};
use crate::plan::{Dice, Plan, Trouble};

const ARM: usize = 0;
const BELT: usize = 1;
/// Duration of the tasks of all nodes at once.
const BUSY: u64 = 3500;
/// Until all tasks run and descriptions are read.
const BEGIN: Duration = Duration::from_millis(1000);
/// How long turns are measured: without a `Start` or an `Abort`, and while each client aborts a task.
const MEASURED: [Duration; 2] = [Duration::from_millis(1000), Duration::from_millis(600)];
/// Until all clients know the outcomes.
const TOLD: Duration = Duration::from_secs(6);
/// Longest times. An `Abort` waits for one question that is under way, and its answer; three of them delay the polls.
const HEALTHY: Turns = Turns::bounds(50, 70, 20);

/// The same while another node has this trouble.
const fn bounds(trouble: Trouble) -> Turns {
    match trouble {
        // Rubbish takes up to 35 ms, and what it damages is asked again.
        Trouble::Babbles => Turns::bounds(200, 200, 100),
        _ => Turns::bounds(60, 80, 30),
    }
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

    pub(super) fn serve_one(&mut self, device: usize, motor: usize) -> Result<(), String> {
        let task = self.ask(0, device, motor, 20, true);
        self.pass_until(self.now + Duration::from_millis(1500))?;
        self.books.came_to(task, State::Completed)
    }

    /// Runs a task on each node of a shared line at once: without faults, and while one node has a trouble.
    pub(super) fn serve_shared(
        &mut self,
        plan: &Plan,
        summary: &mut Summary,
    ) -> Result<(), String> {
        summary.healthy = self.serve_all(ARM, None, HEALTHY, "all nodes are well")?;
        let found = self.line.iter().flat_map(|line| &line.found).count();
        if found != self.devices.len() {
            return Err(format!("a search finds {found} nodes"));
        }

        let mut dice = Dice::new(plan.seed);
        let ill = dice.below(self.devices.len() as u64) as usize;
        let number = dice.below(Trouble::ALL.len() as u64) as usize;
        let trouble = Trouble::ALL[number];
        let what = format!("device {ill} {trouble:?}");
        self.note(|| format!("from now on {what}"));
        self.trouble(ill, trouble, BEGIN + MEASURED[0] + MEASURED[1] + TOLD);
        summary.troubled[number] = self.serve_all(BELT, Some(ill), bounds(trouble), &what)?;
        self.pass_until(self.now + Duration::from_secs(4))?;
        self.serve_one(ill, BELT)?;
        self.serve_second(plan)?;
        summary.collided = self.line.iter().map(|line| line.wire.collided()).sum();
        Ok(())
    }

    /// Runs a task on this motor of all nodes but one, and measures their turns.
    fn serve_all(
        &mut self,
        motor: usize,
        ill: Option<usize>,
        most: Turns,
        what: &str,
    ) -> Result<Turns, String> {
        let clients = self.people.len();
        let well = |device: &usize| Some(*device) != ill;
        let tasks: Vec<usize> = (0..self.devices.len())
            .filter(well)
            .map(|device| self.ask(device % clients, device, motor, BUSY, false))
            .collect();
        self.pass_until(self.now + BEGIN)?;
        self.measure(MEASURED[0])?;
        let turn = self.longest(well);
        let aborted = &tasks[..clients];
        for task in aborted {
            let id = self.books.id(*task);
            let id = id.ok_or_else(|| format!("promise 3: a new task, {task}, is not begun"))?;
            self.people[task % clients].abort(*task, id);
        }
        self.measure(MEASURED[1])?;
        let longest = Turns {
            turn,
            aborting: self.longest(well),
            urgent: self
                .line
                .as_ref()
                .map_or(Duration::ZERO, SharedLine::urgent),
        };
        if !longest.keeps(most) {
            return Err(format!("turn: {longest}, not {most}, while {what}"));
        }
        self.pass_until(self.now + TOLD)?;
        for task in &tasks {
            let state = if aborted.contains(task) {
                State::Aborted
            } else {
                State::Completed
            };
            let came = self.books.came_to(*task, state);
            // In so much noise a node rarely misses all new commands of a link timeout.
            if most != bounds(Trouble::Babbles) || self.books.came_to(*task, State::Failed).is_err()
            {
                came?;
            }
        }
        Ok(longest)
    }

    fn measure(&mut self, time: Duration) -> Result<(), String> {
        if let Some(line) = &mut self.line {
            line.watch(self.now);
        }
        self.pass_until(self.now + time)
    }

    fn longest(&self, of: impl Fn(&usize) -> bool) -> Duration {
        let line = self.line.as_ref();
        line.map_or(Duration::ZERO, |line| line.longest(self.now, of))
    }
}
