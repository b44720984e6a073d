//! The rounds of the server's thread: it waits, takes reports and requests, and does what is due.

use std::sync::PoisonError;
use std::time::Duration;

use tracing::warn;
use ztl_core::Instant;
use ztl_core::dispatcher::TaskEvent;
use ztl_core::memory::Memory;
use ztl_core::tasks::Tasks;

use super::report::{self, Report};
use super::router::Received;
use super::{LOG, TaskServer, now};

/// Requests, and reports of handlers, taken before the others are looked at again.
const BATCH: usize = 64;

/// How long a stopped server goes on after its handlers have stopped, when tasks were stopped, so that clients that ask every 100 ms
/// hear of it.
const LAST_WORDS: Duration = Duration::from_millis(250);

impl TaskServer {
    /// Waits for something, at most for `longest`, and serves it; says whether there is more.
    pub(super) fn turn(&mut self, longest: Duration) -> Result<bool, zmq::Error> {
        let mut next = self.wait(longest)?;
        self.waker.awake();
        let mut limits = self
            .next_limits
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        if let Some(limits) = limits.take() {
            self.dispatcher.set_keep(limits.keep);
            self.dispatcher.memory_mut().set_limits(limits);
        }
        drop(limits);
        let more = self.take_reports();
        let mut taken = 0;
        while let Some((frames, who)) = next {
            match who {
                _ if report::is_ring(&frames) => {}
                Some(who) => self.serve(frames, who),
                None => self.dropped.tell(now(), "of somebody unknown"),
            }
            taken += 1;
            if taken == BATCH || !self.started {
                break;
            }
            next = self.router.receive(&self.door, zmq::DONTWAIT)?;
        }
        if std::mem::take(&mut self.started) {
            for handler in &mut self.handlers {
                handler.all_started();
            }
        }
        let Self {
            dispatcher,
            router,
            claims,
            ..
        } = self;
        let now = now();
        while let Some(claim) = claims.first_entry()
            && claim.key().0 <= now
        {
            let ((_, id), (claim, reason)) = claim.remove_entry();
            if claim.refuse() {
                let refused = TaskEvent::Rejected { reason };
                dispatcher.handle_event(now, id, refused, &mut |peer, reply| {
                    router.answer(peer, reply);
                });
            }
        }
        dispatcher.handle_timeout(now, &mut |peer, reply| router.answer(peer, reply));
        self.abort_for_those_who_are_gone(now);
        Ok(more)
    }

    fn abort_for_those_who_are_gone(&mut self, now: Instant) {
        let tasks = self.dispatcher.memory().tasks();
        let runs = |id| tasks.get(id).is_some_and(|task| !task.state.is_final());
        for id in self.touch.gone(now, runs) {
            warn!(target: LOG, "The client that started task '{id}' is gone, so it is aborted.");
            let scope = tasks.get(id).map(|task| usize::from(task.extra.0));
            if let Some(handler) = scope.and_then(|scope| self.handlers.get_mut(scope)) {
                handler.abort(id);
            }
        }
    }

    /// Handlers stop their tasks as they are dropped; meanwhile clients are told.
    pub(super) fn stop_handlers(&mut self) -> Result<(), zmq::Error> {
        let mut handlers = std::mem::take(&mut self.handlers);
        let longest = handlers.iter_mut().map(|handler| handler.stop()).max();
        let stopping = std::thread::Builder::new().spawn(move || drop(handlers));
        // Without a thread they were dropped, and so stopped, right here.
        let Ok(stopping) = stopping else {
            return Ok(());
        };
        let end = now() + longest.unwrap_or_default();
        let pause = Duration::from_millis(10);
        let mut told = false;
        while now() < end && !stopping.is_finished() {
            self.turn(pause)?;
            told |= self.reported;
        }
        let end = now() + LAST_WORDS;
        while (told || self.reported) && now() < end {
            told = true;
            self.turn(pause)?;
        }
        Ok(())
    }

    /// Until a request, a report or the dispatcher's next wake-up, at most for `longest`; the request.
    fn wait(&self, longest: Duration) -> Result<Option<Received>, zmq::Error> {
        let claims = self.claims.keys().next().map(|(at, _)| *at);
        let wakes = [
            self.dispatcher.poll_timeout(),
            self.touch.poll_timeout(),
            claims,
        ];
        let wake = wakes.into_iter().flatten().min();
        let time = wake.map_or(longest, |wake| wake.since(now()).min(longest));
        if time.is_zero() || !self.waker.may_sleep() {
            return self.router.receive(&self.door, zmq::DONTWAIT);
        }
        let timeout = match time {
            Duration::MAX => -1,
            time => i32::try_from(time.as_micros().div_ceil(1000))
                .unwrap_or(i32::MAX)
                .min(3_600_000),
        };
        self.router.wait_at_most(timeout)?;
        self.router.receive(&self.door, 0)
    }

    /// Takes a bounded number of reports; says whether there may be more.
    fn take_reports(&mut self) -> bool {
        let Self {
            dispatcher,
            router,
            inbox,
            touch,
            claims,
            ..
        } = self;
        let mut taken = 0;
        let now = now();
        while taken < BATCH
            && let Some((id, report)) = inbox.next()
        {
            taken += 1;
            match report {
                Report::NeedsClient(client, silence) => touch.watch(now, client, id, silence),
                Report::NeedsClaim(claim, within, reason) => {
                    claims.insert((now + within, id), (claim, reason));
                }
                report => report.tell(|event| {
                    dispatcher.handle_event(now, id, event, &mut |peer, reply| {
                        router.answer(peer, reply);
                    });
                }),
            }
        }
        self.reported = taken > 0;
        taken == BATCH
    }
}
