//! Components whose tasks are `async`: a driver that waits for an I2C bus, a servo bus, a delay. It runs under embassy's
//! executor or any other, without an allocator. Requires the features `async` and `critical-section`.
//!
//! Implement [`Driver`], create a [`Slot`] for it, pass [`Slot::component`] to the [`Node`](crate::Node), and run
//! [`Slot::run`] in a task of the executor. The executor's task holds the future, so the slot needs no memory for it. In one
//! task with [`Pump::run`](crate::pump::Pump::run), join both with a port that does not fail
//! ([`Plugged`](crate::pump::Plugged)): `join(pump.run(..), slot.run(..))`. With another port, the first error ends the
//! node's turns, and with them its timer for a lost link: run the pump again in a loop. Neither `run` nor `make_safe` may
//! block.
//!
//! ```
//! use embedded_hal_async::delay::DelayNs;
//! use embedded_hal_async::i2c::I2c;
//! use ztl_mcu::driver::{Driver, Failed, Progress, Slot};
//! use ztl_mcu::link::Offer;
//! use ztl_mcu::{Refused, Report, parse_goal};
//!
//! /// A motor with a register for its target and one for its position, in half degrees.
//! struct Motor<I, D> { bus: I, delay: D }
//!
//! const ADDRESS: u8 = 0x40;
//! const HOLD: u8 = 0xff;
//!
//! /// The target in half degrees.
//! fn target(goal: &str, why: &mut Report<'_>) -> Result<u8, Refused> {
//!     let degrees: f32 = parse_goal(goal, why)?;
//!     if !(0.0..=90.0).contains(&degrees) {
//!         why.text("motor takes 0 to 90 degrees");
//!         return Err(Refused);
//!     }
//!     Ok((degrees * 2.0 + 0.5) as u8)
//! }
//!
//! impl<I: I2c, D: DelayNs> Driver for Motor<I, D> {
//!     fn check(goal: &str, why: &mut Report<'_>) -> Result<(), Refused> {
//!         target(goal, why).map(drop)
//!     }
//!
//!     async fn run(&mut self, goal: &str, progress: Progress<'_>) -> Result<(), Failed> {
//!         let target = progress.write(|why| target(goal, why)).map_err(|_| Failed)?;
//!         let mut at = [0];
//!         self.bus.write(ADDRESS, &[0, target]).await.map_err(|_| Failed)?;
//!         while at != [target] {
//!             self.delay.delay_ms(20).await;
//!             self.bus.write_read(ADDRESS, &[1], &mut at).await.map_err(|_| Failed)?;
//!             progress.write(|report| report.number(f32::from(at[0]) / 2.0, 1));
//!         }
//!         Ok(())
//!     }
//!
//!     async fn make_safe(&mut self) {
//!         while self.bus.write(ADDRESS, &[0, HOLD]).await.is_err() {
//!             self.delay.delay_ms(5).await;
//!         }
//!     }
//! }
//!
//! # fn create<I: I2c, D: DelayNs>() {
//! let slot: Slot<'_, Motor<I, D>> = Slot::new(Offer::new("motor").with_range(0.0, 90.0, "deg"));
//! // Node::new(identity, (slot.component(),)), and in a task of the executor: slot.run(&mut motor, clock).await
//! # drop(slot);
//! # }
//! # let mut text = ztl_mcu::Reason::new();
//! # assert_eq!(target("12.5", &mut Report::new(&mut text)), Ok(25));
//! # assert_eq!(target("90.5", &mut Report::new(&mut text)), Err(Refused));
//! ```

use core::cell::RefCell;
use core::convert::Infallible;
use core::fmt;
use core::future::{Future, poll_fn};
use core::marker::PhantomData;
use core::pin::pin;
use core::sync::atomic::{AtomicU8, AtomicUsize, Ordering};
use core::task::{Context, Poll, Waker};
use core::time::Duration;

use critical_section::Mutex;
use heapless::String;
use ztl_core::Instant;
use ztl_core::link::Offer;
use ztl_core::time::micros;

use crate::component::{Component, Reading, Refused, Report, Run};
use crate::describe::Describe;
use crate::node::tasks::{TEXT, TaskText};
use crate::node::utf8::push_utf8;
use crate::parameters::Tunable;

const INTERRUPTED: &str = "its driver was interrupted";
const LATE: &str = "its driver began too late";
/// Default of [`Slot::with_patience`].
const PATIENCE: Duration = Duration::from_millis(500);

/// The goal will not be reached; the progress that was written last is the reason.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Failed;

/// Another future of the slot runs already.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct AlreadyRuns;

impl fmt::Display for AlreadyRuns {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("another future of the slot runs already")
    }
}

impl core::error::Error for AlreadyRuns {}

/// A part that carries out one task at a time, in async functions.
pub trait Driver {
    /// Checks a goal without moving anything, as [`Component::check`]. It has no access to the driver, because a task
    /// may be using it.
    ///
    /// # Errors
    /// [`Refused`], with the reason in `why`.
    fn check(goal: &str, why: &mut Report<'_>) -> Result<(), Refused>;

    /// Carries out a task whose goal was checked. The progress that was written last is the result.
    ///
    /// An abort, the loss of the link and an emergency stop drop the future at the point where it waits. A transfer that
    /// was under way is then cut off, as far as the bus allows that. After it runs [`abort`](Self::abort) or
    /// [`make_safe`](Self::make_safe).
    ///
    /// # Errors
    /// [`Failed`] if the goal will not be reached.
    fn run(
        &mut self,
        goal: &str,
        progress: Progress<'_>,
    ) -> impl Future<Output = Result<(), Failed>>;

    /// Stops after an abort of its task, as [`Component::abort`]: an arm slows down and holds its load. Returns when it
    /// has stopped; the task ends, and another one begins, only then. The loss of the link and an emergency stop drop this
    /// future, too. Goes to the safe state by default.
    fn abort(&mut self) -> impl Future<Output = ()> {
        self.make_safe()
    }

    /// Goes to the safe state: after a failure, when the link is lost, in an emergency stop, and before the first task.
    /// Returns when it is reached; the task ends, and another one begins, only then. Try again if the hardware does not
    /// answer.
    fn make_safe(&mut self) -> impl Future<Output = ()>;

    /// Writes the next reading, as [`Component::poll_reading`]. Like `check` it has no access to the driver, which keeps
    /// its readings in a static, such as a [`LatestReading`](crate::shared::LatestReading). Defaults to `None`.
    fn poll_reading(now: Instant, buffer: &mut [u8]) -> Option<Reading> {
        let _ = (now, buffer);
        None
    }
}

/// Where a running task writes its progress, and its result or the reason of its failure.
#[derive(Clone, Copy)]
pub struct Progress<'a>(&'a Mutex<RefCell<TaskText>>);

impl Progress<'_> {
    /// Replaces the text of the task, at most 48 bytes, and returns what `write` returns.
    pub fn write<T>(&self, write: impl FnOnce(&mut Report<'_>) -> T) -> T {
        let mut text = TaskText::new();
        let value = write(&mut Report::new(&mut text));
        with(self.0, |known| *known = text);
        value
    }
}

impl fmt::Debug for Progress<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Progress")
    }
}

/// What a driver does.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Stage {
    /// It is to go to the safe state, or is on its way.
    Stop,
    /// It is to stop its task, or is on its way.
    Abort,
    /// A task waits for it.
    Wanted,
    Runs,
    Rests,
}

struct State {
    stage: Stage,
    /// How the last task ends, as soon as the driver rests.
    end: Run,
    /// When the goal is too old to begin.
    late_at: Instant,
    /// Whether a future runs the driver.
    driven: bool,
    waker: Option<Waker>,
}

impl State {
    fn has_task(&self) -> bool {
        matches!(self.stage, Stage::Wanted | Stage::Runs)
    }

    fn rests(&self) -> bool {
        self.stage == Stage::Rests
    }

    /// Sends the driver to its safe state, or only lets it stop its task, if it has one, which ends like this.
    fn stop(&mut self, next: Stage, end: Run) {
        let has_task = self.has_task();
        if !has_task && next == Stage::Abort {
            return;
        }
        // Made safe without a task: the failure of an earlier one would mean that the driver is not safe.
        if has_task || end == Run::Aborted {
            self.end = end;
        }
        self.stage = next;
    }
}

/// Does something in a critical section, without another access.
fn with<S, T>(state: &Mutex<RefCell<S>>, act: impl FnOnce(&mut S) -> T) -> Option<T> {
    critical_section::with(|cs| {
        let mut state = state.borrow(cs).try_borrow_mut().ok()?;
        Some(act(&mut state))
    })
}

/// Connects a [`Driver`] with a node, which gets the slot's [`component`](Self::component). Goals have at most `GOAL` bytes.
///
/// The node and the executor's task may run at different priorities. A critical section copies a text of 48 bytes, but not
/// the goal. The node learns of progress and of the end at its next `poll`, at most 10 ms later.
pub struct Slot<'o, D, const GOAL: usize = TEXT> {
    offer: Offer<'o>,
    state: Mutex<RefCell<State>>,
    text: Mutex<RefCell<TaskText>>,
    /// Not in a critical section, because it may be long: the component writes it only while the driver rests, and the driver
    /// reads it only after the start of a task.
    goal: [AtomicU8; GOAL],
    goal_len: AtomicUsize,
    /// In µs.
    patience: u64,
    driver: PhantomData<fn(D)>,
}

impl<'o, D, const GOAL: usize> Slot<'o, D, GOAL> {
    /// The place of a driver that is not safe yet: it takes no task before [`run`](Self::run) has called
    /// [`Driver::make_safe`].
    #[must_use]
    pub const fn new(offer: Offer<'o>) -> Self {
        Self {
            offer,
            state: Mutex::new(RefCell::new(State {
                stage: Stage::Stop,
                end: Run::Completed,
                late_at: Instant::ZERO,
                driven: false,
                waker: None,
            })),
            text: Mutex::new(RefCell::new(TaskText::new())),
            goal: [const { AtomicU8::new(0) }; GOAL],
            goal_len: AtomicUsize::new(0),
            patience: micros(PATIENCE),
            driver: PhantomData,
        }
    }

    /// Sets how long a goal may wait until the executor starts the driver. After that the task fails, and the driver does not
    /// start. Defaults to 500 ms.
    #[must_use]
    pub const fn with_patience(mut self, patience: Duration) -> Self {
        self.patience = micros(patience);
        self
    }

    /// The component of a node. Only the newest one may be in use: a task that an earlier node left behind is stopped, and
    /// the driver goes to its safe state.
    pub fn component(&self) -> SlotComponent<'_, 'o, D, GOAL> {
        self.stop(Stage::Stop, Run::Failed);
        SlotComponent(self)
    }

    fn set_text(&self, text: &str) {
        Progress(&self.text).write(|report| report.text(text));
    }

    /// As [`State::stop`].
    fn stop(&self, next: Stage, end: Run) {
        self.ask(|state| state.stop(next, end));
    }

    /// Changes the state and wakes the driver.
    fn ask<T>(&self, act: impl FnOnce(&mut State) -> T) -> Option<T> {
        let (value, waker) = with(&self.state, |state| (act(state), state.waker.take()))?;
        if let Some(waker) = waker {
            waker.wake();
        }
        Some(value)
    }

    /// Ready with what `act` finds; otherwise the next change of the state wakes.
    fn poll_state<T>(
        &self,
        context: &Context<'_>,
        act: impl FnOnce(&mut State) -> Option<T>,
    ) -> Poll<T> {
        let waker = context.waker().clone();
        // The old waker is dropped outside of the critical section.
        let found = with(&self.state, |state| {
            (act(state), state.waker.replace(waker))
        });
        match found {
            Some((Some(value), _)) => Poll::Ready(value),
            _ => Poll::Pending,
        }
    }
}

impl<D: Driver, const GOAL: usize> Slot<'_, D, GOAL> {
    /// Runs a driver forever: first it goes to its safe state, then it carries out the node's tasks. `clock` is that of the
    /// node.
    ///
    /// The future may be dropped at any time and called again. Until then the driver does nothing, also not after an
    /// abort, and its component counts as on the way to its safe state: its task stays, and it takes no other. When the
    /// future runs again, the driver goes to its safe state, and the task ends as FAILED.
    ///
    /// # Errors
    /// [`AlreadyRuns`], without touching the driver: only one future of a slot may run at a time.
    pub async fn run(
        &self,
        driver: &mut D,
        clock: impl Fn() -> Instant,
    ) -> Result<Infallible, AlreadyRuns> {
        let interrupted = with(&self.state, |state| {
            if core::mem::replace(&mut state.driven, true) {
                return Err(AlreadyRuns);
            }
            let interrupted = state.has_task();
            state.stop(Stage::Stop, Run::Failed);
            Ok(interrupted)
        });
        if interrupted.unwrap_or(Err(AlreadyRuns))? {
            self.set_text(INTERRUPTED);
        }
        let _leaving = Leaving(self);
        let mut goal = String::new();
        loop {
            let stage = poll_fn(|context| self.poll_next(context, clock())).await;
            if stage == Stage::Runs {
                self.read_goal(&mut goal);
            }
            match self.act(driver, stage, &goal).await {
                // Its driver does not know where it is, and it may still move.
                Some(Err(Failed)) => self.end(stage, Run::Failed, Stage::Stop),
                Some(Ok(())) => self.end(stage, Run::Completed, Stage::Rests),
                None => {}
            }
        }
    }

    /// The next thing to do.
    fn poll_next(&self, context: &Context<'_>, now: Instant) -> Poll<Stage> {
        self.poll_state(context, |state| {
            match state.stage {
                Stage::Stop | Stage::Abort => {}
                Stage::Wanted if now >= state.late_at => {
                    self.set_text(LATE);
                    state.stage = Stage::Rests;
                    state.end = Run::Failed;
                    return None;
                }
                Stage::Wanted => state.stage = Stage::Runs,
                Stage::Runs | Stage::Rests => return None,
            }
            Some(state.stage)
        })
    }

    /// Copies the goal of the task that runs.
    fn read_goal(&self, goal: &mut String<GOAL>) {
        let mut bytes = [0; GOAL];
        for (to, from) in bytes.iter_mut().zip(&self.goal) {
            *to = from.load(Ordering::Relaxed);
        }
        let len = self.goal_len.load(Ordering::Relaxed);
        goal.clear();
        push_utf8(goal, bytes.get(..len).unwrap_or_default());
    }

    /// Does what this stage asks for. Drops it and returns `None` if something else is to be done.
    async fn act(&self, driver: &mut D, stage: Stage, goal: &str) -> Option<Result<(), Failed>> {
        let mut acting = pin!(async {
            match stage {
                Stage::Runs => return driver.run(goal, Progress(&self.text)).await,
                Stage::Abort => driver.abort().await,
                _ => driver.make_safe().await,
            }
            Ok(())
        });
        poll_fn(|context| {
            let changed = |state: &mut State| (state.stage != stage).then_some(());
            if self.poll_state(context, changed).is_ready() {
                return Poll::Ready(None);
            }
            acting.as_mut().poll(context).map(Some)
        })
        .await
    }

    /// What this stage asked for is done; unless something else is to be done since, `next` follows.
    fn end(&self, stage: Stage, end: Run, next: Stage) {
        with(&self.state, |state| {
            if stage == Stage::Runs {
                state.end = end;
            }
            if state.stage == stage {
                state.stage = next;
            }
        });
    }
}

/// The future of a slot's driver: without it, no task can be carried out.
struct Leaving<'s, 'o, D, const GOAL: usize>(&'s Slot<'o, D, GOAL>);

impl<D, const GOAL: usize> Drop for Leaving<'_, '_, D, GOAL> {
    fn drop(&mut self) {
        with(&self.0.state, |state| {
            state.driven = false;
            if !state.has_task() {
                state.stage = Stage::Stop;
            }
        });
    }
}

/// The component of a [`Slot`], from [`Slot::component`].
pub struct SlotComponent<'s, 'o, D, const GOAL: usize = TEXT>(&'s Slot<'o, D, GOAL>);

impl<D, const GOAL: usize> Tunable for SlotComponent<'_, '_, D, GOAL> {}

impl<D: Driver, const GOAL: usize> Component for SlotComponent<'_, '_, D, GOAL> {
    fn offer(&self) -> Offer<'_> {
        self.0.offer
    }

    fn check(&self, goal: &str, why: &mut Report<'_>) -> Result<(), Refused> {
        if goal.len() > GOAL {
            why.text("goal is too long for its driver");
            return Err(Refused);
        }
        D::check(goal, why)
    }

    fn start(&mut self, now: Instant, goal: &str, why: &mut Report<'_>) -> Result<(), Refused> {
        let ready = with(&self.0.state, |state| state.rests());
        if ready == Some(true) {
            self.0.goal_len.store(goal.len(), Ordering::Relaxed);
            for (to, from) in self.0.goal.iter().zip(goal.as_bytes()) {
                to.store(*from, Ordering::Relaxed);
            }
            let started = self.0.ask(|state| {
                if !state.rests() {
                    return false;
                }
                with(&self.0.text, |text| text.clear());
                state.late_at = now.after(self.0.patience);
                state.stage = Stage::Wanted;
                true
            });
            if started == Some(true) {
                return Ok(());
            }
        }
        why.text("its driver is not ready");
        Err(Refused)
    }

    fn poll(&mut self, _now: Instant, report: &mut Report<'_>) -> Run {
        // First the state: the end is written after the last text.
        let end = with(&self.0.state, |state| state.rests().then_some(state.end));
        if let Some(text) = with(&self.0.text, |text| text.clone()) {
            report.text(&text);
        }
        end.flatten().unwrap_or(Run::Running)
    }

    fn abort(&mut self, _now: Instant) {
        self.0.stop(Stage::Abort, Run::Aborted);
    }

    fn make_safe(&mut self, _now: Instant) {
        self.0.stop(Stage::Stop, Run::Aborted);
    }

    fn poll_reading(&mut self, now: Instant, buffer: &mut [u8]) -> Option<Reading> {
        D::poll_reading(now, buffer)
    }
}

impl<D: Describe, const GOAL: usize> Describe for SlotComponent<'_, '_, D, GOAL> {
    const DESCRIPTION: &'static str = D::DESCRIPTION;
}

impl<D, const GOAL: usize> fmt::Debug for SlotComponent<'_, '_, D, GOAL> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Debug::fmt(self.0, f)
    }
}

impl<D, const GOAL: usize> fmt::Debug for Slot<'_, D, GOAL> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Slot").field(&self.offer.name).finish()
    }
}

#[cfg(test)]
mod tests;
