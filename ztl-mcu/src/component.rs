//! What moves: the part of a node that the firmware provides.

mod components;
mod report;

use core::time::Duration;

use ztl_core::Instant;
use ztl_core::link::Offer;

pub use components::Components;
pub(crate) use components::forward;
pub use report::Report;

/// The state of a component's task.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Run {
    /// The task runs; the report is its progress.
    Running,
    /// The goal will not be reached; the report is the reason.
    Failed,
    /// The task stopped after [`Component::abort`]; the report says where.
    Aborted,
    /// The goal is reached; the report is the result.
    Completed,
}

/// The component refuses the goal; the report says why.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Refused;

/// A reading that [`Component::poll_reading`] wrote.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Reading {
    /// Index of the topic in the component's offer.
    pub topic: u8,
    /// Length of the reading in bytes.
    pub len: usize,
}

/// A part that carries out one task at a time.
///
/// The node calls `check` for each task that arrives and `start` for one that may begin. It then calls `poll`
/// when `poll_timeout` asks for it, until `poll` returns something other than [`Run::Running`]. Without a task
/// it calls `poll` only if [`next_tick`](Self::next_tick) asks for it, or after `make_safe`. It calls `abort`,
/// `make_safe` and `poll_reading` at any time. No call may block, because the main loop makes each of them
/// between two bytes of the link.
///
/// **A second task.** The node never runs two tasks on one component. The offer chooses what happens to the
/// second one ([`Busy`](ztl_core::link::Busy)):
/// - *Refuse*: the node refuses it with `busy with another task`.
/// - *Queue(n)*: the node checks and accepts it. It waits with at most n - 1 others, and its goal has at most
///   48 bytes. When the running task has ended, the task with the lowest id begins. If `start` then refuses
///   it, it ends as FAILED with that reason.
/// - *Replace*: the node checks and accepts it, and aborts the running task, which ends as ABORTED with
///   `replaced by a later task`. The new task begins when the old one has stopped. A third task replaces the
///   waiting one.
///
/// An abort ends a waiting task at once as ABORTED with `aborted before it began`.
///
/// **When the link is lost** ([`Loss`](ztl_core::link::Loss)), a component with *abort* or *hold* goes to its
/// safe state, with or without a task: a relay that an earlier task switched on goes off. The node calls
/// `make_safe`, then `poll` until it returns [`Run::Aborted`] or [`Run::Completed`], which means that the safe
/// state is reached. [`Run::Failed`] means that it is not, for example because a pin failed: the node calls
/// `make_safe` again at once, then both every 50 ms until the component is safe. All tasks of the component end as FAILED with `link was lost`: a waiting one at once, the
/// running one when the component is safe. With *carry on* nothing changes, and waiting tasks still begin.
///
/// **In an emergency stop** every component goes to its safe state in the same way, and all tasks end as
/// ABORTED with `emergency stop`. A component takes no task until it has reached its safe state; if it never
/// does, its running task never ends.
pub trait Component {
    /// Describes the component and its goals. The gateway asks once a session. Must not change.
    fn offer(&self) -> Offer<'_>;

    /// Checks a goal without moving anything. Called before a task is accepted, also for one that will wait.
    ///
    /// # Errors
    /// [`Refused`]. `why` explains to the author of the goal what is wrong and which goals are valid. The
    /// gateway adds the goal itself.
    fn check(&self, goal: &str, why: &mut Report<'_>) -> Result<(), Refused>;

    /// Starts a task whose goal was checked. Called only while no task runs, and after `make_safe` only when
    /// the safe state is reached.
    ///
    /// # Errors
    /// [`Refused`], with the reason in `why`. Nothing has moved.
    fn start(&mut self, now: Instant, goal: &str, why: &mut Report<'_>) -> Result<(), Refused>;

    /// Advances the task and reports its progress. Any result but [`Run::Running`] ends the task.
    ///
    /// After `make_safe` the node also calls it without a task: [`Run::Running`] means that the safe state is
    /// not reached yet, [`Run::Failed`] that it cannot be reached without another `make_safe`. It may be called
    /// again after that, and must leave the component safe. A component with a [tick](Self::next_tick) is called
    /// without a task too; the return value then says the same.
    fn poll(&mut self, now: Instant, report: &mut Report<'_>) -> Run;

    /// Stops the task as soon as it is safe. A later `poll` returns [`Run::Aborted`], or how else it ended.
    fn abort(&mut self, now: Instant);

    /// Goes to the safe state, with or without a task: the link was lost, or there is an emergency stop. For
    /// [`Loss::Hold`](ztl_core::link::Loss::Hold) that means to keep the position under power.
    ///
    /// What takes time, such as slowing down, continues in `poll` while it returns [`Run::Running`]. Until then
    /// `poll_timeout` or `next_tick` must ask for the next one: a component that asks for none counts as safe.
    /// If `poll` returns [`Run::Failed`], the node calls `make_safe` again, every 50 ms. So an error from before
    /// `make_safe` must not make `poll` fail if the component is safe. Do not continue the task: it ends when the
    /// component is safe, with [`Run::Aborted`] or [`Run::Completed`].
    fn make_safe(&mut self, now: Instant);

    /// When to call `poll` next; the node asks after each `poll` of a task. Also when to call `poll_reading`,
    /// if the offer names topics and there was no reading: the node calls it earlier after any `poll`, in a new
    /// session, and after [`Node::components_mut`](crate::Node::components_mut). With [`Instant::NEVER`] only an
    /// abort, the loss of the link, an emergency stop or a tick causes the next `poll`. Defaults to 10 ms from now.
    fn poll_timeout(&self, now: Instant) -> Instant {
        now + Duration::from_millis(10)
    }

    /// When to call `poll` next with or without a task: for a control loop, a status light, a motor that slows
    /// down after its task has ended. Defaults to [`Instant::NEVER`].
    ///
    /// Return a time that the component stores, and move it on in `poll`: `now` plus the interval. While the
    /// time has passed, every turn of the main loop calls `poll`. Each component has its own interval.
    fn next_tick(&self) -> Instant {
        Instant::NEVER
    }

    /// The result of the last completed task, if it is longer than a report of 48 bytes; empty, the default, if the
    /// report says all.
    ///
    /// The component keeps it unchanged until its next `start`, which the node delays until a gateway has the result: to
    /// the node the component is busy until then. A result longer than
    /// [`Node::LONGEST_RESULT`](crate::Node::LONGEST_RESULT) is cut and ends in `…`.
    ///
    /// ```
    /// # use ztl_mcu::Report;
    /// struct Scanner {
    ///     found: heapless::String<503>,
    /// }
    ///
    /// impl Scanner {
    ///     /// Called by `poll` before it returns `Run::Completed`; `Component::result` returns `&self.found`.
    ///     fn complete(&mut self, positions: &[f32]) {
    ///         let mut report = Report::new(&mut self.found);
    ///         # #[cfg(feature = "serde")]
    ///         let _ = report.value(positions, 1);
    ///         assert!(!report.is_cut());
    ///     }
    /// }
    /// # Scanner { found: heapless::String::new() }.complete(&[1.0]);
    /// ```
    fn result(&self) -> &str {
        ""
    }

    /// Writes the next reading into `buffer`, if one is due and fits. Defaults to `None`.
    ///
    /// Called when the line is free, at most once per
    /// [`reading_interval`](crate::Identity::reading_interval). The buffer has room for the longest reading
    /// that fits a frame, [`Node::LONGEST_READING`](crate::Node::LONGEST_READING). Drop a longer reading,
    /// because it can never be sent.
    fn poll_reading(&mut self, now: Instant, buffer: &mut [u8]) -> Option<Reading> {
        let _ = (now, buffer);
        None
    }
}

impl<T: Component + ?Sized> Component for &mut T {
    fn offer(&self) -> Offer<'_> {
        T::offer(self)
    }

    fn check(&self, goal: &str, why: &mut Report<'_>) -> Result<(), Refused> {
        T::check(self, goal, why)
    }

    fn start(&mut self, now: Instant, goal: &str, why: &mut Report<'_>) -> Result<(), Refused> {
        T::start(self, now, goal, why)
    }

    fn poll(&mut self, now: Instant, report: &mut Report<'_>) -> Run {
        T::poll(self, now, report)
    }

    fn abort(&mut self, now: Instant) {
        T::abort(self, now);
    }

    fn make_safe(&mut self, now: Instant) {
        T::make_safe(self, now);
    }

    fn poll_timeout(&self, now: Instant) -> Instant {
        T::poll_timeout(self, now)
    }

    fn next_tick(&self) -> Instant {
        T::next_tick(self)
    }

    fn result(&self) -> &str {
        T::result(self)
    }

    fn poll_reading(&mut self, now: Instant, buffer: &mut [u8]) -> Option<Reading> {
        T::poll_reading(self, now, buffer)
    }
}
