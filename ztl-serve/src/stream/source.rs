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
    /// Whether anyone subscribes.
    is_heard: Arc<AtomicBool>,
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
        is_heard: Arc<AtomicBool>,
    ) -> Self {
        Self {
            outlet: Outlet::new(Arc::clone(config), publisher, Arc::clone(&is_heard)),
            is_heard,
            splitter: Splitter::new(config.framing, config.longest),
            config: Arc::clone(config),
            running: None,
            start_at: now,
            pause: PAUSE.0,
            leave_at: None,
        }
    }

    /// Whether anyone subscribes, or that does not matter.
    fn is_wanted(&self) -> bool {
        self.config.when_watched.is_none() || self.is_heard.load(Ordering::Acquire)
    }

    /// Whether to start the program now.
    pub(super) fn is_due(&self, now: Instant) -> bool {
        self.running.is_none() && self.start_at <= now && self.is_wanted()
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
    pub(super) fn poll_timeout(&self) -> Option<Instant> {
        let is_waiting = self.running.is_none() && self.is_wanted();
        let start_at = is_waiting.then_some(self.start_at);
        let times = [start_at, self.leave_at, self.outlet.poll_timeout()];
        times.into_iter().flatten().min()
    }

    /// Does what is due. Returns what is to be done for the job.
    pub(super) fn handle_timeout(&mut self, now: Instant, check: bool) -> Vec<Effect> {
        self.outlet.handle_timeout(now);
        let mut effects = self.with_job(now, |job, effects| job.turn(now, check, effects));
        let may_leave = self.running.as_ref().is_some_and(|it| !it.is_stopping);
        self.leave_at = match self.config.when_watched {
            Some(time) if may_leave && !self.is_wanted() => self.leave_at.or(now.checked_add(time)),
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
            Outcome::Failed(how)
            | Outcome::Unknown(how)
            | Outcome::Rejected(how)
            | Outcome::Aborted(how) => how,
        };
        let pause = human_time(self.pause);
        warn!(target: LOG, "Stream {topic} has ended, and begins again in {pause}: {how}");
        self.start_at = now + self.pause;
        self.pause = (self.pause * 2).min(PAUSE.1);
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use ztl_yaml::Document;

    use super::*;
    use crate::Config;

    struct Nothing;

    impl Job for Nothing {
        fn stop(&mut self, _: Instant, _: StopReason, effects: &mut Vec<Effect>) {
            effects.push(Effect::End(Outcome::Aborted(String::new())));
        }
    }

    /// A stream with this setting, and what tells whether anyone subscribes.
    fn source(now: Instant, setting: &str) -> (Source, Arc<AtomicBool>) {
        let text = format!("streams: {{/r: {{s: {{run: [x], frame: line, {setting}}}}}}}");
        let document = Document::parse("robot.yaml", text.as_bytes()).expect("YAML");
        let config = Config::read(&document, Path::new("/")).expect("a stream");
        let [config] = config.streams.as_slice() else {
            panic!("{config:?}");
        };
        let publisher = Publisher::bind("tcp://127.0.0.1:*", "/r").expect("a port");
        let is_heard = Arc::new(AtomicBool::new(false));
        let source = Source::new(now, config, publisher, Arc::clone(&is_heard));
        (source, is_heard)
    }

    fn start(source: &mut Source, now: Instant) {
        assert!(source.is_due(now));
        let id = TaskId::new(1).expect("an id");
        source.started(now, id, Box::new(Nothing));
        assert!(!source.is_due(now));
    }

    #[test]
    fn pauses_become_longer_until_a_program_has_run_well() {
        let mut now = Instant::now();
        let (mut source, _) = source(now, "latest: no");
        // The program runs for a time, and the pause after that is of a length.
        let mut pause = |runs: Duration| {
            start(&mut source, now);
            source.with_job(now, |_, effects| effects.push(Effect::Accept));
            now += runs;
            source.with_job(now, |_, effects| {
                effects.push(Effect::End(Outcome::Failed("exit code 1".to_owned())));
            });
            let due = source.poll_timeout().expect("a start");
            let pause = due - now;
            now = due;
            pause.as_millis()
        };
        let short = WELL - Duration::from_millis(1);
        let pauses: Vec<u128> = (0..9).map(|_| pause(short)).collect();
        let longest = PAUSE.1.as_millis();
        assert_eq!(
            pauses,
            [
                500, 1000, 2000, 4000, 8000, 16_000, longest, longest, longest
            ]
        );
        assert_eq!([pause(WELL), pause(short)], [500, 1000]);
    }

    #[test]
    fn a_program_that_nobody_subscribes_to_stops_after_its_time() {
        let now = Instant::now();
        let at = |millis| now + Duration::from_millis(millis);
        let (mut source, is_heard) = source(now, "when-watched: 1 s");
        assert!(!source.is_due(now));
        assert_eq!(source.poll_timeout(), None);
        is_heard.store(true, Ordering::Release);
        start(&mut source, now);
        let runs = |source: &mut Source, millis| {
            source.handle_timeout(at(millis), false);
            source.job().is_some()
        };
        assert!(runs(&mut source, 5000));
        is_heard.store(false, Ordering::Release);
        assert!(runs(&mut source, 5000));
        assert_eq!(source.poll_timeout(), Some(at(6000)));
        is_heard.store(true, Ordering::Release);
        assert!(runs(&mut source, 5999));
        is_heard.store(false, Ordering::Release);
        assert!(runs(&mut source, 6000));
        assert!(runs(&mut source, 6999));
        assert!(!runs(&mut source, 7000));
        assert!(!source.is_due(at(7000)));
        // Stopped on purpose, so there is no pause.
        is_heard.store(true, Ordering::Release);
        start(&mut source, at(7000));
    }
}
