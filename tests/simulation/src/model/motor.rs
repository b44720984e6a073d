//! Simulated motors, and the record of what really happened to each task.

use std::cell::RefCell;
use std::time::Duration;

use ztl_core::link::{Busy, Loss, Offer};
use ztl_core::{Instant, State};

use super::ends::mcu::{Component, Refused, Report, Run};
use super::parameters::SETS;

/// Maximum number of tasks in a scenario, including the one that checks that the device serves.
pub(super) const TASKS: usize = 4;

/// What really happened to a task.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct Execution {
    /// How often a motor started it.
    pub(super) begun: u8,
    /// Its final state at the motor.
    pub(super) came_to: Option<State>,
}

/// What really happened, including before a reset.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct Truth {
    pub(super) tasks: [Execution; TASKS],
    /// The task that each motor runs.
    pub(super) moving: [Option<u8>; 2],
    /// Whether each motor is under power, which is not its safe state.
    pub(super) powered: [bool; 2],
    /// How often each value of a parameter was set.
    pub(super) sets: [u8; SETS],
    /// Whether one was set while its motor ran a task.
    pub(super) set_under_task: bool,
}

impl Truth {
    pub(super) fn moves(&self, task: usize) -> bool {
        self.moving
            .iter()
            .flatten()
            .any(|moving| usize::from(*moving) == task)
    }

    fn end(&mut self, motor: usize, state: Option<State>) {
        if let Some(task) = self.moving[motor].take() {
            self.tasks[usize::from(task)].came_to = state;
        }
    }

    /// Cuts the power.
    pub(super) fn rest(&mut self) {
        for motor in 0..self.moving.len() {
            self.end(motor, None);
        }
        self.powered = [false; 2];
    }
}

thread_local! {
    /// The truth of the current model; the node does not expose its components.
    pub(super) static TRUTH: RefCell<Truth> = RefCell::default();
}

/// Lets `act` change the truth.
pub(super) fn with_truth<T>(truth: &mut Truth, act: impl FnOnce() -> T) -> T {
    TRUTH.set(*truth);
    let done = act();
    *truth = TRUTH.with_borrow(|truth| *truth);
    done
}

/// Properties of a motor.
#[derive(Debug, Clone, Copy)]
pub struct Kind {
    /// What it does when the link is lost.
    pub loss: Loss,
    /// What it does with a second task.
    pub busy: Busy,
    /// Whether it fails to reach its safe state at first.
    pub fails: bool,
}

/// A motor that moves for some time.
#[derive(Debug, Clone)]
pub(super) struct Motor {
    pub(super) place: usize,
    pub(super) kind: Kind,
    pub(super) run: Option<Moving>,
    /// Its parameter.
    pub(super) value: u32,
}

#[derive(Debug, Clone, Copy)]
pub(super) enum Moving {
    Until(Instant),
    /// Until it is stopped.
    On,
    Aborted,
    /// To the safe state, which it reaches at the next poll.
    ToSafety,
    /// Its first attempt to reach the safe state has failed, or will at the next poll.
    Failing,
}

/// A duration that means until the motor is stopped.
pub(super) const ENDLESS: u16 = u16::MAX;

/// A goal is `TASK MILLISECONDS`.
fn read(goal: &str) -> Option<(u8, u16)> {
    let (task, millis) = goal.split_once(' ')?;
    Some((task.parse().ok()?, millis.parse().ok()?))
}

impl Component for Motor {
    fn offer(&self) -> Offer<'_> {
        Offer::new(["arm", "belt"][self.place])
            .with_unit("ms")
            .with_busy(self.kind.busy)
            .with_loss(self.kind.loss)
    }

    fn check(&self, goal: &str, why: &mut Report<'_>) -> Result<(), Refused> {
        if read(goal).is_some() {
            return Ok(());
        }
        why.text("TASK MILLISECONDS");
        Err(Refused)
    }

    fn start(&mut self, now: Instant, goal: &str, _why: &mut Report<'_>) -> Result<(), Refused> {
        let (task, millis) = read(goal).ok_or(Refused)?;
        TRUTH.with_borrow_mut(|truth| {
            assert_eq!(truth.moving[self.place], None, "started while it moves");
            truth.tasks[usize::from(task)].begun += 1;
            truth.moving[self.place] = Some(task);
            truth.powered[self.place] = true;
        });
        self.run = Some(match millis {
            ENDLESS => Moving::On,
            millis => Moving::Until(now + Duration::from_millis(millis.into())),
        });
        Ok(())
    }

    fn poll(&mut self, now: Instant, _report: &mut Report<'_>) -> Run {
        let (state, run) = match self.run {
            Some(Moving::Aborted) => (State::Aborted, Run::Aborted),
            Some(Moving::Until(end)) if now >= end => (State::Completed, Run::Completed),
            Some(Moving::ToSafety) => (State::Failed, Run::Aborted),
            Some(Moving::Failing) => return Run::Failed,
            Some(_) => return Run::Running,
            // It is safe.
            None => return Run::Aborted,
        };
        let safe = matches!(self.run, Some(Moving::ToSafety));
        self.run = None;
        TRUTH.with_borrow_mut(|truth| {
            truth.end(self.place, Some(state));
            truth.powered[self.place] &= !safe;
        });
        run
    }

    fn abort(&mut self, _now: Instant) {
        self.run = Some(Moving::Aborted);
    }

    fn make_safe(&mut self, _now: Instant) {
        let again = matches!(self.run, Some(Moving::Failing | Moving::ToSafety));
        let powered = TRUTH.with_borrow(|truth| truth.powered[self.place]);
        self.run = Some(match self.kind.fails && powered && !again {
            true => Moving::Failing,
            false => Moving::ToSafety,
        });
    }

    fn poll_timeout(&self, now: Instant) -> Instant {
        match self.run {
            Some(Moving::Until(end)) => end,
            Some(Moving::Aborted | Moving::ToSafety | Moving::Failing) => now,
            Some(Moving::On) | None => Instant::NEVER,
        }
    }
}
