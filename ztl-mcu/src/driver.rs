//! Components whose tasks are `async`: a driver that waits for an I2C bus, a servo bus, a delay. It runs under embassy's
//! executor or any other, without an allocator. Requires the features `async` and `critical-section`.
//!
//! Implement [`Driver`], create a [`Slot`] for it, pass `&slot` to the [`Node`](crate::Node) as a component, and run
//! [`Slot::run`] in a task of the executor. The executor's task holds the future, so the slot needs no memory for it. In one
//! task with [`Pump::run`](crate::pump::Pump::run), join it with a loop that runs the pump again after each error of the
//! port: `join(async { loop { let _ = pump.run(..).await; } }, slot.run(&mut motor))`. Otherwise the first error ends the
//! node's turns, and with them its timer for a lost link. Neither `run` nor `make_safe` may block.
//!
//! ```
//! use embedded_hal_async::delay::DelayNs;
//! use embedded_hal_async::i2c::I2c;
//! use ztl_mcu::driver::{Driver, Failed, Progress, Slot};
//! use ztl_mcu::link::Offer;
//! use ztl_mcu::{Refused, Report};
//!
//! /// A motor with a register for its target and one for its position.
//! struct Motor<I, D> { bus: I, delay: D }
//!
//! const ADDRESS: u8 = 0x40;
//! const HOLD: u8 = 0xff;
//!
//! impl<I: I2c, D: DelayNs> Driver for Motor<I, D> {
//!     fn check(goal: &str, why: &mut Report<'_>) -> Result<(), Refused> {
//!         match goal.parse::<u8>() {
//!             Ok(0..=90) => Ok(()),
//!             _ => {
//!                 why.text("motor takes 0 to 90");
//!                 Err(Refused)
//!             }
//!         }
//!     }
//!
//!     async fn run(&mut self, goal: &str, progress: Progress<'_>) -> Result<(), Failed> {
//!         let target: u8 = goal.parse().map_err(|_| Failed)?;
//!         let mut at = [0];
//!         self.bus.write(ADDRESS, &[0, target]).await.map_err(|_| Failed)?;
//!         while at != [target] {
//!             self.delay.delay_ms(20).await;
//!             self.bus.write_read(ADDRESS, &[1], &mut at).await.map_err(|_| Failed)?;
//!             progress.write(|report| report.number(f32::from(at[0]), 0));
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
//! // Node::new(identity, (&slot,)), and in a task of the executor: slot.run(&mut motor).await
//! # drop(slot);
//! # }
//! ```

use core::cell::RefCell;
use core::convert::Infallible;
use core::fmt;
use core::future::{Future, poll_fn};
use core::marker::PhantomData;
use core::pin::pin;
use core::task::{Context, Poll, Waker};

use critical_section::Mutex;
use heapless::String;
use ztl_core::Instant;
use ztl_core::link::Offer;

use crate::component::{Component, Refused, Report, Run};
use crate::node::tasks::{TEXT, TaskText};
use crate::parameters::Tunable;

const INTERRUPTED: &str = "its driver was interrupted";

/// The goal will not be reached; the progress that was written last is the reason.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Failed;

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
    /// was under way is then cut off, as far as the bus allows that. [`make_safe`](Self::make_safe) runs after it.
    ///
    /// # Errors
    /// [`Failed`] if the goal will not be reached.
    fn run(
        &mut self,
        goal: &str,
        progress: Progress<'_>,
    ) -> impl Future<Output = Result<(), Failed>>;

    /// Goes to the safe state: after an abort or a failure, when the link is lost, in an emergency stop, and before the
    /// first task. Returns when it is reached; the task ends, and another one begins, only then. An ordinary abort comes
    /// here, too: an arm that would drop its load without torque is to stop and hold. Try again if the hardware does not answer.
    fn make_safe(&mut self) -> impl Future<Output = ()>;
}

/// Where a running task writes its progress, and its result or the reason of its failure.
#[derive(Clone, Copy)]
pub struct Progress<'a>(&'a Mutex<RefCell<TaskText>>);

impl Progress<'_> {
    /// Replaces the text of the task; at most 48 bytes.
    pub fn write(&self, write: impl FnOnce(&mut Report<'_>)) {
        let mut text = TaskText::new();
        write(&mut Report::new(&mut text));
        with(self.0, |known| *known = text);
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
    /// A task waits for it.
    Wanted,
    Runs,
    Rests,
}

struct State<const GOAL: usize> {
    stage: Stage,
    /// How the last task ends, as soon as the driver rests.
    end: Run,
    goal: String<GOAL>,
    waker: Option<Waker>,
}

impl<const GOAL: usize> State<GOAL> {
    /// Sends the driver to its safe state; a task of it ends like this.
    fn stop(&mut self, end: Run) {
        if matches!(self.stage, Stage::Wanted | Stage::Runs) {
            self.end = end;
        }
        self.stage = Stage::Stop;
    }
}

/// Does something in a critical section, without another access.
fn with<S, T>(state: &Mutex<RefCell<S>>, act: impl FnOnce(&mut S) -> T) -> Option<T> {
    critical_section::with(|cs| {
        let mut state = state.borrow(cs).try_borrow_mut().ok()?;
        Some(act(&mut state))
    })
}

/// The place of a [`Driver`] among the components of a node: `&Slot` is the component. Goals have at most `GOAL` bytes.
///
/// The node and the executor's task may run at different priorities. A critical section copies a goal or a text of 48
/// bytes. The node learns of progress and of the end at its next `poll`, at most 10 ms later.
pub struct Slot<'o, D, const GOAL: usize = TEXT> {
    offer: Offer<'o>,
    state: Mutex<RefCell<State<GOAL>>>,
    text: Mutex<RefCell<TaskText>>,
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
                goal: String::new(),
                waker: None,
            })),
            text: Mutex::new(RefCell::new(TaskText::new())),
            driver: PhantomData,
        }
    }

    fn set_text(&self, text: &str) {
        Progress(&self.text).write(|report| report.text(text));
    }

    /// Changes the state and wakes the driver.
    fn ask<T>(&self, act: impl FnOnce(&mut State<GOAL>) -> T) -> Option<T> {
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
        act: impl FnOnce(&mut State<GOAL>) -> Option<T>,
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
    /// Runs a driver forever: first it goes to its safe state, then it carries out the node's tasks. Only one future of a
    /// slot may run at a time.
    ///
    /// The future may be dropped at any time and called again. Until then the driver does nothing, also not after an
    /// abort, and its component counts as on the way to its safe state: its task stays, and it takes no other. When the
    /// future runs again, the driver goes to its safe state, and the task ends as FAILED.
    pub async fn run(&self, driver: &mut D) -> Infallible {
        let interrupted = with(&self.state, |state| {
            let had_task = matches!(state.stage, Stage::Wanted | Stage::Runs);
            state.stop(Run::Failed);
            had_task
        });
        if interrupted == Some(true) {
            self.set_text(INTERRUPTED);
        }
        let _leaving = Leaving(self);
        loop {
            match poll_fn(|context| self.poll_next(context)).await {
                Some(goal) => {
                    let end = match self.carry_out(driver, &goal).await {
                        Some(Ok(())) => Run::Completed,
                        Some(Err(Failed)) => Run::Failed,
                        None => continue,
                    };
                    with(&self.state, |state| {
                        state.end = end;
                        // It may have been stopped at the last moment.
                        if state.stage == Stage::Runs {
                            state.stage = match end {
                                // Its driver does not know where it is, and it may still move.
                                Run::Failed => Stage::Stop,
                                _ => Stage::Rests,
                            };
                        }
                    });
                }
                None => {
                    driver.make_safe().await;
                    with(&self.state, |state| state.stage = Stage::Rests);
                }
            }
        }
    }

    /// The next thing to do: a task, or `None` to go to the safe state.
    fn poll_next(&self, context: &Context<'_>) -> Poll<Option<String<GOAL>>> {
        self.poll_state(context, |state| match state.stage {
            Stage::Stop => Some(None),
            Stage::Wanted => {
                state.stage = Stage::Runs;
                Some(Some(core::mem::take(&mut state.goal)))
            }
            Stage::Runs | Stage::Rests => None,
        })
    }

    /// Runs a task. Drops it and returns `None` if it is stopped.
    async fn carry_out(&self, driver: &mut D, goal: &str) -> Option<Result<(), Failed>> {
        let mut task = pin!(driver.run(goal, Progress(&self.text)));
        poll_fn(|context| {
            let stopped = |state: &mut State<GOAL>| (state.stage == Stage::Stop).then_some(());
            if self.poll_state(context, stopped).is_ready() {
                return Poll::Ready(None);
            }
            task.as_mut().poll(context).map(Some)
        })
        .await
    }
}

/// The future of a slot's driver: without it, no task can be carried out.
struct Leaving<'s, 'o, D, const GOAL: usize>(&'s Slot<'o, D, GOAL>);

impl<D, const GOAL: usize> Drop for Leaving<'_, '_, D, GOAL> {
    fn drop(&mut self) {
        with(&self.0.state, |state| {
            if state.stage == Stage::Rests {
                state.stage = Stage::Stop;
            }
        });
    }
}

impl<D, const GOAL: usize> Tunable for &Slot<'_, D, GOAL> {}

impl<D: Driver, const GOAL: usize> Component for &Slot<'_, D, GOAL> {
    fn offer(&self) -> Offer<'_> {
        self.offer
    }

    fn check(&self, goal: &str, why: &mut Report<'_>) -> Result<(), Refused> {
        if goal.len() > GOAL {
            why.text("goal is too long for its driver");
            return Err(Refused);
        }
        D::check(goal, why)
    }

    fn start(&mut self, _now: Instant, goal: &str, why: &mut Report<'_>) -> Result<(), Refused> {
        let rests = with(&self.state, |state| state.stage == Stage::Rests);
        if rests == Some(true) {
            self.set_text("");
        }
        // Asked again, because `run` may have begun anew in between.
        let started = self.ask(|state| {
            let rests = state.stage == Stage::Rests;
            if rests {
                state.goal.clear();
                // It fits: `check` was called.
                let _ = state.goal.push_str(goal);
                state.stage = Stage::Wanted;
            }
            rests
        });
        if started == Some(true) {
            return Ok(());
        }
        why.text("its driver is not ready");
        Err(Refused)
    }

    fn poll(&mut self, _now: Instant, report: &mut Report<'_>) -> Run {
        // First the state: the end is written after the last text.
        let end = with(&self.state, |state| {
            (state.stage == Stage::Rests).then_some(state.end)
        });
        if let Some(text) = with(&self.text, |text| text.clone()) {
            report.text(&text);
        }
        end.flatten().unwrap_or(Run::Running)
    }

    fn abort(&mut self, _now: Instant) {
        self.ask(|state| state.stop(Run::Aborted));
    }

    fn make_safe(&mut self, now: Instant) {
        self.abort(now);
    }
}

impl<D, const GOAL: usize> fmt::Debug for Slot<'_, D, GOAL> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Slot").field(&self.offer.name).finish()
    }
}

#[cfg(test)]
mod tests;
