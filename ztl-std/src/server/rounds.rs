//! The loop of the server's thread: waits, takes reports and requests, and does what is due.

use std::io;
use std::sync::PoisonError;
use std::time::Duration;

use tracing::warn;
#[cfg(feature = "publish")]
use ztl_core::State;
use ztl_core::dispatcher::TaskEvent;
use ztl_core::memory::Memory;
#[cfg(feature = "publish")]
use ztl_core::memory::Scope;
use ztl_core::tasks::Tasks;
use ztl_core::{Instant, TaskId};

use super::clock::now;
use super::engine::{Engine, answer};
use super::incoming::Received;
use super::reporter::Report;
use crate::log_targets::TASKS;

/// Most requests, and most reports, handled per turn.
const BATCH: usize = 64;

/// How long a server keeps answering after its handlers stopped tasks, for all clients that ask every 100 ms.
const LINGER: Duration = Duration::from_millis(250);
/// The same while there is an end that no client has been told yet: a client, or its network, may be slow.
const LINGER_UNTOLD: Duration = Duration::from_secs(2);

impl Engine {
    /// Serves until it is stopped.
    pub(super) fn run(mut self) -> io::Result<()> {
        let mut more = false;
        while !self.waker.stopped() {
            let longest = if more { Duration::ZERO } else { Duration::MAX };
            more = self.turn(longest)?;
        }
        self.stop_handlers()
    }

    /// Waits for something to do, at most for `longest`, and does it; returns whether there may be more reports.
    fn turn(&mut self, longest: Duration) -> io::Result<bool> {
        let mut next = self.wait(longest)?;
        self.waker.on_awake();
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
        while let Some(received) = next {
            match received {
                #[cfg(feature = "libzmq")]
                Received::Wake => {}
                Received::Request(request) => self.serve(request),
                Received::Dropped(why) => self.dropped.log(now(), why),
            }
            taken += 1;
            if taken == BATCH {
                break;
            }
            next = self.router.receive()?;
        }
        if std::mem::take(&mut self.started) {
            for handler in &mut self.handlers {
                handler.all_started();
            }
        }
        for needed in self.inbox.take_claims() {
            let place = (needed.until, needed.id);
            self.claims.insert(place, (needed.claim, needed.reason));
        }
        let now = now();
        while let Some(claim) = self.claims.first_entry()
            && claim.key().0 <= now
        {
            let ((_, id), (claim, reason)) = claim.remove_entry();
            if claim.reject() {
                self.on_event(now, id, TaskEvent::Rejected { reason });
            }
        }
        let (router, untold) = (&mut self.router, &mut self.untold);
        self.dispatcher.handle_timeout(now, &mut |peer, reply| {
            answer(router, untold, peer, reply);
        });
        self.abort_tasks_of_gone_clients(now);
        Ok(more)
    }

    fn abort_tasks_of_gone_clients(&mut self, now: Instant) {
        let tasks = self.dispatcher.memory().tasks();
        let runs = |id| tasks.get(id).is_some_and(|task| !task.state.is_final());
        for id in self.clients.gone(now, runs) {
            warn!(target: TASKS, "The client that started task '{id}' is gone, so it is aborted.");
            let scope = tasks.get(id).map(|task| usize::from(task.extra.0));
            if let Some(handler) = scope.and_then(|scope| self.handlers.get_mut(scope)) {
                handler.abort(id);
            }
        }
    }

    /// Handlers stop their tasks when they are dropped; clients are answered meanwhile.
    fn stop_handlers(&mut self) -> io::Result<()> {
        let running = self.dispatcher.memory().tasks().iter();
        let running = running.filter(|(_, task)| !task.state.is_final());
        self.untold = running.map(|(id, _)| id).collect();
        let mut handlers = std::mem::take(&mut self.handlers);
        let longest = handlers.iter_mut().map(|handler| handler.stop()).max();
        let stopping = std::thread::Builder::new().spawn(move || drop(handlers));
        // If no thread could be started, the handlers were dropped on this one.
        let stops = || stopping.as_ref().is_ok_and(|thread| !thread.is_finished());
        let end = now() + longest.unwrap_or_default();
        let pause = Duration::from_millis(10);
        let mut reported = false;
        while now() < end && stops() {
            self.turn(pause)?;
            reported |= self.reported;
        }
        let stopped = now();
        loop {
            // At least once: the last reports may have come since the turn before.
            self.turn(pause)?;
            reported |= self.reported;
            let longest = match self.owes_an_end() {
                true => LINGER_UNTOLD,
                false => LINGER,
            };
            if !reported || now() >= stopped + longest {
                return Ok(());
            }
        }
    }

    /// Whether a task has ended since the server began to stop, and no client has been told so.
    fn owes_an_end(&self) -> bool {
        let tasks = self.dispatcher.memory().tasks();
        let ended = |id| tasks.get(id).is_some_and(|task| task.state.is_final());
        self.untold.iter().any(|id| ended(*id))
    }

    /// Waits for a request, a report or the next deadline, at most for `longest`; returns the request.
    fn wait(&mut self, longest: Duration) -> io::Result<Option<Received>> {
        let claims = self.claims.keys().next().map(|(at, _)| *at);
        let wakes = [
            self.dispatcher.poll_timeout(),
            self.clients.poll_timeout(),
            claims,
        ];
        let wake = wakes.into_iter().flatten().min();
        let time = wake.map_or(longest, |wake| wake.since(now()).min(longest));
        match time.is_zero() || !self.waker.may_sleep() {
            true => self.router.look(),
            false => self.router.wait(time),
        }
    }

    /// Takes a bounded number of reports; returns whether there may be more.
    fn take_reports(&mut self) -> bool {
        let mut taken = 0;
        let now = now();
        while taken < BATCH
            && let Some((id, report)) = self.inbox.next()
        {
            taken += 1;
            match report {
                Report::NeedsClient(client, silence) => {
                    self.clients.watch(now, client, id, silence);
                }
                Report::Reserve(ready) => self.reserve(ready),
                Report::Begun(scope, payload, by_device) => {
                    self.on_begun(id, scope, &payload, by_device);
                }
                report => report.handle(|event| self.on_event(now, id, event)),
            }
        }
        self.reported = taken > 0;
        taken == BATCH
    }

    /// Passes on what happened to a task.
    fn on_event(&mut self, now: Instant, id: TaskId, event: TaskEvent<'_>) {
        #[cfg(feature = "publish")]
        let before = self.before(id, &event);
        let (router, untold) = (&mut self.router, &mut self.untold);
        self.dispatcher
            .handle_event(now, id, event, &mut |peer, reply| {
                answer(router, untold, peer, reply);
            });
        self.dispatcher.memory_mut().recount(id);
        #[cfg(feature = "publish")]
        if let Some(before) = before {
            self.publish_change(id, before);
        }
    }

    /// What is needed to publish an event, if events are published.
    #[cfg(feature = "publish")]
    fn before(&self, id: TaskId, event: &TaskEvent<'_>) -> Option<BeforeEvent> {
        self.events.as_ref()?;
        let task = self.dispatcher.memory().tasks().get(id)?;
        Some(BeforeEvent {
            scope: task.extra,
            state: task.state,
            is_progress: matches!(event, TaskEvent::Progress { .. }),
            rejection: match event {
                TaskEvent::Rejected { reason } => Some((*reason).to_owned()),
                TaskEvent::Threw { message } => Some((*message).to_owned()),
                _ => None,
            },
        })
    }

    /// Publishes a task's state if it has changed, or its progress.
    #[cfg(feature = "publish")]
    fn publish_change(&mut self, id: TaskId, before: BeforeEvent) {
        let Some(events) = &mut self.events else {
            return;
        };
        let memory = self.dispatcher.memory();
        let scope = memory.scope_name(before.scope);
        match (memory.tasks().get(id), before.rejection) {
            (Some(task), _)
                if task.state != before.state || before.is_progress && !task.state.is_final() =>
            {
                events.on_changed(scope, id, task.state, task.text.as_ref());
            }
            // The table forgets what was rejected.
            (None, Some(reason)) => events.on_changed(scope, id, State::Rejected, &reason),
            _ => {}
        }
    }
}

/// A task before something happened to it.
#[cfg(feature = "publish")]
struct BeforeEvent {
    scope: Scope,
    state: State,
    is_progress: bool,
    rejection: Option<String>,
}
