//! One stream: when its program runs, and what becomes of its output.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use tracing::{debug, warn};
use ztl_core::TaskId;
use ztl_std::Publisher;

use super::StreamConfig;
use super::outlet::Outlet;
use super::splitter::Splitter;
use crate::human::human_time;
use crate::kind::{Effect, Job, Outcome, StopReason};
use crate::log::LOG;

/// Shortest and longest pause before a program is started again.
const PAUSE: (Duration, Duration) = (Duration::from_millis(500), Duration::from_secs(30));
/// After a program has run for so long, the next pause is the shortest.
const WELL: Duration = Duration::from_secs(10);

/// A program that runs.
struct Running {
    /// Of this start.
    id: TaskId,
    job: Box<dyn Job>,
    since: Instant,
    is_stopping: bool,
}

pub(super) struct Source {
    pub(super) config: Arc<StreamConfig>,
    /// Whether anyone subscribes, or that does not matter.
    is_watched: Arc<AtomicBool>,
    outlet: Outlet,
    splitter: Splitter,
    running: Option<Running>,
    /// When the program may be started.
    start_at: Instant,
    /// The pause after the next end.
    pause: Duration,
    /// When to stop the program, since nobody subscribes.
    leave_at: Option<Instant>,
}

impl Source {
    pub(super) fn new(
        now: Instant,
        config: &Arc<StreamConfig>,
        publisher: Publisher,
        is_watched: Arc<AtomicBool>,
    ) -> Self {
        Self {
            is_watched,
            outlet: Outlet::new(Arc::clone(config), publisher),
            splitter: Splitter::new(config.framing, config.longest),
            config: Arc::clone(config),
            running: None,
            start_at: now,
            pause: PAUSE.0,
            leave_at: None,
        }
    }

    /// Whether to start the program now.
    pub(super) fn is_due(&self, now: Instant) -> bool {
        self.running.is_none() && self.start_at <= now && self.is_watched.load(Ordering::Acquire)
    }

    /// The program is being started.
    pub(super) fn started(&mut self, now: Instant, id: TaskId, job: Box<dyn Job>) {
        debug!(target: LOG, "Stream {} begins.", self.config.topic());
        self.splitter = Splitter::new(self.config.framing, self.config.longest);
        self.running = Some(Running {
            id,
            job,
            since: now,
            is_stopping: false,
        });
    }

    pub(super) fn job(&self) -> Option<(TaskId, &dyn Job)> {
        let running = self.running.as_ref()?;
        Some((running.id, running.job.as_ref()))
    }

    /// Stops the program, if it runs.
    pub(super) fn stop(&mut self, now: Instant) -> Vec<Effect> {
        if let Some(running) = &mut self.running {
            running.is_stopping = true;
        }
        self.with_job(now, |job, effects| {
            job.stop(now, StopReason::Server, effects);
        })
    }

    /// When to call [`handle_timeout`](Self::handle_timeout), or to start the program.
    pub(super) fn poll_timeout(&self, now: Instant) -> Option<Instant> {
        let is_waiting = self.running.is_none() && self.is_watched.load(Ordering::Acquire);
        let start_at = (is_waiting && now < self.start_at).then_some(self.start_at);
        let times = [start_at, self.leave_at, self.outlet.poll_timeout()];
        times.into_iter().flatten().min()
    }

    /// Does what is due. Returns what is to be done for the job.
    pub(super) fn handle_timeout(&mut self, now: Instant, check: bool) -> Vec<Effect> {
        self.outlet.handle_timeout(now);
        let mut effects = self.with_job(now, |job, effects| {
            if check {
                job.check_process();
            }
            job.handle_timeout(now, effects);
        });
        let may_leave = self.running.as_ref().is_some_and(|it| !it.is_stopping);
        self.leave_at = match self.config.when_watched {
            Some(time) if may_leave && !self.is_watched.load(Ordering::Acquire) => {
                self.leave_at.or(now.checked_add(time))
            }
            _ => None,
        };
        if self.leave_at.is_some_and(|at| at <= now) {
            debug!(target: LOG, "Stream {}: nobody subscribes.", self.config.topic());
            self.leave_at = None;
            effects.extend(self.stop(now));
        }
        effects
    }

    /// Calls the job and takes its output and its end. Returns its other effects.
    pub(super) fn with_job(
        &mut self,
        now: Instant,
        call: impl FnOnce(&mut dyn Job, &mut Vec<Effect>),
    ) -> Vec<Effect> {
        let mut effects = Vec::new();
        if let Some(running) = &mut self.running {
            call(running.job.as_mut(), &mut effects);
        }
        let mut others = Vec::new();
        for effect in effects {
            match effect {
                Effect::Output(bytes) => {
                    let outlet = &mut self.outlet;
                    self.splitter
                        .push(&bytes, |piece| outlet.handle(now, piece));
                }
                Effect::Accept => {
                    if let Some(running) = &mut self.running {
                        running.since = now;
                    }
                }
                Effect::End(outcome) => self.on_end(now, outcome),
                other => others.push(other),
            }
        }
        others
    }

    /// The program has ended, or has not started.
    fn on_end(&mut self, now: Instant, outcome: Outcome) {
        let topic = self.config.topic();
        let running = self.running.take();
        if running.as_ref().is_some_and(|running| running.is_stopping) {
            debug!(target: LOG, "Stream {topic} has stopped.");
            self.start_at = now;
            return;
        }
        if running.is_some_and(|running| now >= running.since + WELL) {
            self.pause = PAUSE.0;
        }
        let how = match &outcome {
            Outcome::Completed(_) => "exit code 0",
            Outcome::Failed(how) | Outcome::Rejected(how) | Outcome::Aborted(how) => how,
        };
        let pause = human_time(self.pause);
        warn!(target: LOG, "Stream {topic} has ended, and begins again in {pause}: {how}");
        self.start_at = now + self.pause;
        self.pause = (self.pause * 2).min(PAUSE.1);
    }
}
