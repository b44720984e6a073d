//! Simulated motors, and the record of what really happened to each task.

use std::cell::RefCell;
use std::rc::Rc;
use std::time::Duration;

use ztl_core::link::Offer;
use ztl_core::{Instant, State};
use ztl_mcu::describe::{ComponentDescription, Describe, GoalRule};
use ztl_mcu::{Component, Reading, Refused, Report, Run, description};

use crate::plan::MotorPlan;

/// What really happened to a task.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct Execution {
    /// How often it was started.
    pub(super) begun: u32,
    /// Its final state at the motor.
    pub(super) came_to: Option<State>,
}

/// The real state of a motor.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Condition {
    /// The task that it runs.
    pub(super) task: Option<usize>,
    /// It has not reached its safe state since its last task.
    pub(super) powered: bool,
    /// It is going to its safe state.
    pub(super) to_safety: bool,
}

/// What really happened.
#[derive(Debug, Default)]
pub(super) struct Truth {
    /// By number of the task.
    pub(super) tasks: Vec<Execution>,
    /// The motors of each device.
    pub(super) motors: Vec<[Condition; 2]>,
    /// The device that always has a reading.
    pub(super) floods: Option<usize>,
}

/// Reported for an unreachable device, whose motors may still be going to their safe state.
const NOT_ANSWERING: &str = "device is not answering";

impl Truth {
    pub(super) fn moves(&self, task: usize) -> bool {
        self.moving().any(|(moving, _)| moving == task)
    }

    /// Whether a task runs although its client received a final state with this reason.
    pub(super) fn moves_after(&self, task: usize, why: &str) -> bool {
        let allowed = |motor: &Condition| motor.to_safety && why == NOT_ANSWERING;
        self.moving()
            .any(|(moving, motor)| moving == task && !allowed(motor))
    }

    /// The running tasks.
    pub(super) fn moving(&self) -> impl Iterator<Item = (usize, &Condition)> {
        let motors = self.motors.iter().flatten();
        motors.filter_map(|motor| Some((motor.task?, motor)))
    }

    fn execution(&mut self, task: usize) -> &mut Execution {
        if self.tasks.len() <= task {
            self.tasks.resize(task + 1, Execution::default());
        }
        &mut self.tasks[task]
    }

    fn begin(&mut self, (device, motor): (usize, usize), task: usize) {
        self.execution(task).begun += 1;
        let motor = &mut self.motors[device][motor];
        assert!(!motor.to_safety, "started before it is safe");
        motor.task = Some(task);
        motor.powered = true;
    }

    pub(super) fn end(&mut self, (device, motor): (usize, usize), state: Option<State>) {
        if let Some(task) = self.motors[device][motor].task.take() {
            self.execution(task).came_to = state;
        }
    }

    /// Puts the motor into its safe state.
    pub(super) fn rest(&mut self, place: (usize, usize), state: Option<State>) {
        self.end(place, state);
        self.motors[place.0][place.1] = Condition::default();
    }
}

/// The truth, shared by all motors of a laboratory.
pub(super) type Shared = Rc<RefCell<Truth>>;

/// A motor that moves for some time.
pub(super) struct Motor {
    pub(super) plan: MotorPlan,
    pub(super) place: (usize, usize),
    pub(super) truth: Shared,
    pub(super) ends: Option<(Instant, State)>,
    /// When it reaches its safe state, or fails to, if it is going there.
    pub(super) safe_at: Option<Instant>,
    /// How often it still fails to reach it.
    pub(super) failures: u8,
}

/// The names of a device's motors.
pub(super) const NAMES: [&str; 2] = ["arm", "belt"];

/// A goal is `TASK MILLISECONDS`.
fn read(goal: &str) -> Option<(usize, u64)> {
    let (task, millis) = goal.split_once(' ')?;
    Some((task.parse().ok()?, millis.parse().ok()?))
}

impl Motor {
    /// Whether its last attempt to reach its safe state has failed.
    fn fails_at(&self, now: Instant) -> bool {
        self.failures > 0 && self.safe_at.is_some_and(|at| now >= at)
    }
}

impl Describe for Motor {
    const DESCRIPTION: &'static str = description!(ComponentDescription {
        about: Some("moves for some time, and takes its time to stop"),
        ..ComponentDescription::new(GoalRule::Any)
    });
}

impl Component for Motor {
    fn offer(&self) -> Offer<'_> {
        Offer::new(NAMES[self.place.1])
            .with_unit("ms")
            .with_busy(self.plan.busy)
            .with_loss(self.plan.loss)
            .with_topics("place")
    }

    fn check(&self, goal: &str, why: &mut Report<'_>) -> Result<(), Refused> {
        read(goal).map(drop).ok_or_else(|| {
            why.text("TASK MILLISECONDS");
            Refused
        })
    }

    fn start(&mut self, now: Instant, goal: &str, _: &mut Report<'_>) -> Result<(), Refused> {
        let (task, millis) = read(goal).ok_or(Refused)?;
        self.truth.borrow_mut().begin(self.place, task);
        self.ends = Some((now + Duration::from_millis(millis), State::Completed));
        self.failures = self.plan.failures;
        Ok(())
    }

    fn poll(&mut self, now: Instant, report: &mut Report<'_>) -> Run {
        if self.safe_at.is_some_and(|at| now < at) {
            return Run::Running;
        }
        if self.fails_at(now) {
            return Run::Failed;
        }
        if self.safe_at.take().is_some() {
            self.truth
                .borrow_mut()
                .rest(self.place, Some(State::Failed));
        }
        let Some((at, state)) = self.ends else {
            return Run::Aborted;
        };
        // Occasional progress.
        report.number((now.as_micros() / 400_000) as f32, 0);
        if now < at {
            return Run::Running;
        }
        self.ends = None;
        self.truth.borrow_mut().end(self.place, Some(state));
        match state {
            State::Aborted => Run::Aborted,
            _ => Run::Completed,
        }
    }

    fn abort(&mut self, now: Instant) {
        if let Some((at, _)) = self.ends {
            let stopped = now + self.plan.slow;
            // It may reach its goal before it stops.
            if stopped < at {
                self.ends = Some((stopped, State::Aborted));
            }
        }
    }

    fn make_safe(&mut self, now: Instant) {
        self.ends = None;
        if self.fails_at(now) {
            self.failures -= 1;
            self.safe_at = None;
        }
        self.safe_at.get_or_insert(now + self.plan.slow);
        let (device, motor) = self.place;
        self.truth.borrow_mut().motors[device][motor].to_safety = true;
    }

    fn poll_reading(&mut self, _: Instant, buffer: &mut [u8]) -> Option<Reading> {
        let floods = self.truth.borrow().floods == Some(self.place.0);
        floods.then(|| {
            buffer.fill(b'x');
            Reading {
                topic: 0,
                len: buffer.len(),
            }
        })
    }

    fn poll_timeout(&self, now: Instant) -> Instant {
        now + self.plan.slow.max(Duration::from_millis(10))
    }
}
