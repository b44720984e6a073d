//! A task of `http` in progress: its thread, which sends the requests, and the supervisor's side.

use std::sync::atomic::Ordering;
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};

use tracing::warn;
use ztl_core::dispatcher::UNKNOWN_OUTCOME;

use super::{After, EndEvent, HttpTask, Progress};
use crate::call::Call;
use crate::http::condition::Condition;
use crate::http::events::{Heard, Listening};
use crate::http::exchange::{Answer, LONGEST, NoAnswer, exchange};
use crate::http::request::{Filled, RequestTemplate};
use crate::http::shared::Shared;
use crate::http::thread::spawn;
use crate::human::human_time;
use crate::kind::{
    CANNOT_ABORT, Effect, Job, JobContext, Kind as _, Outcome, STOP_TIME, Start, StopReason,
};
use crate::log::LOG;

/// How long a question after progress may take.
const QUESTION: Duration = Duration::from_secs(5);
/// How long a robot may take to confirm that it tells events.
const READY: Duration = Duration::from_secs(5);
/// The shortest time between two events that are shown as progress.
const SHOW_EVERY: Duration = Duration::from_millis(100);
/// How long an abort may take.
const ABORT: Duration = Duration::from_secs(5);
/// How often an abort is sent until it is answered.
const ABORTS: usize = 3;
/// The pause between two attempts of a request that may be repeated.
const PAUSE: Duration = Duration::from_millis(200);
/// After this time, a task is accepted without an answer.
const DECIDE: Duration = Duration::from_millis(300);

/// Starts a task whose goal was checked.
pub(super) fn start(kind: Arc<HttpTask>, call: Arc<Call>, task: JobContext) -> Start {
    let run = Arc::new(Run {
        kind,
        call,
        answered: OnceLock::new(),
        task,
        shared: Arc::new(Shared::default()),
    });
    let worker = Arc::clone(&run);
    let spawned = spawn("ztl-http", move || {
        let outcome = worker.certain(worker.run());
        worker.task.effect(Effect::End(outcome));
    });
    match spawned {
        Ok(()) => Start::Running(Box::new(HttpJob {
            run,
            accept_at: Instant::now().checked_add(DECIDE),
            leave_at: None,
        })),
        Err(reason) => Start::Ended(Outcome::Rejected(reason)),
    }
}

/// A task in progress.
struct Run {
    kind: Arc<HttpTask>,
    call: Arc<Call>,
    /// The same, with the answer.
    answered: OnceLock<Call>,
    task: JobContext,
    shared: Arc<Shared>,
}

impl Run {
    /// The call, with the answer once there is one.
    fn call(&self) -> &Call {
        self.answered.get().unwrap_or(&self.call)
    }

    fn run(&self) -> Outcome {
        let kind = &self.kind;
        let until = Instant::now() + kind.limit;
        let event = match &kind.after {
            After::Event(event) => match self.listen(event, until) {
                Ok(listening) => Some((event, listening)),
                Err(outcome) => return outcome,
            },
            _ => None,
        };
        let Some(request) = &kind.request else {
            self.task.effect(Effect::Accept);
            return match event {
                Some((event, listening)) => self.hear_the_end(event, &listening, until),
                None => Outcome::Completed(String::new()),
            };
        };
        let answer = match self.ask(request, until) {
            Ok(answer) => answer,
            Err(NoAnswer {
                reason,
                sent: false,
            }) => {
                let rejected = || Outcome::Rejected(format!("{}: {reason}", request.name()));
                return self
                    .abort_reason()
                    .map_or_else(rejected, StopReason::before_start);
            }
            Err(NoAnswer { reason, .. }) => {
                // The robot may still do it, and what was sent before may have been overtaken.
                let aborted = match self.abort().is_ok() {
                    true => "an abort was sent, but ",
                    false => "",
                };
                let name = request.name();
                return Outcome::Unknown(format!("{aborted}whether {name} was done: {reason}"));
            }
        };
        let mut call = Call::clone(&self.call);
        call.answer = answer.value().cloned();
        let _ = self.answered.set(call);
        self.task.effect(Effect::Accept);
        if let Some((event, _)) = &event
            && !event.names_task()
        {
            // They may tell what was before.
            self.shared.forget_events();
        }
        if let Some(outcome) = self.aborted() {
            return outcome;
        }
        if !kind.done.holds(&answer, self.call()) {
            return Outcome::Failed(answer.failure());
        }
        let result = self.result(&answer);
        match (&kind.after, event) {
            (After::Progress(progress), _) => self.follow(progress, until),
            (_, Some((event, listening))) => self.hear_the_end(event, &listening, until),
            _ => {
                let lasts = kind.lasts(&self.call).unwrap_or_default();
                let end = Instant::now() + lasts;
                while self.shared.wait_until(end) {
                    if let Some(outcome) = self.aborted() {
                        return outcome;
                    }
                }
                Outcome::Completed(result)
            }
        }
    }

    /// What has become of it, as far as that is certain.
    fn certain(&self, outcome: Outcome) -> Outcome {
        match outcome {
            Outcome::Completed(text) if self.shared.may_be_aborted.load(Ordering::SeqCst) => {
                Outcome::Unknown(format!(
                    "an abort was sent, which may have ended it early: {text}"
                ))
            }
            outcome => outcome,
        }
    }

    /// Listens for events before the request is sent, so that none is missed.
    fn listen(&self, event: &EndEvent, until: Instant) -> Result<Listening, Outcome> {
        let name = event.source.name();
        let rejected = |reason: &str| Err(Outcome::Rejected(format!("{name}: {reason}")));
        let shared = Arc::clone(&self.shared);
        let listening = event
            .source
            .listen(&self.call, LONGEST, move |heard| shared.hear(heard));
        let listening = match listening {
            Ok(listening) => listening,
            Err(reason) => return rejected(&reason),
        };
        let until = until.min(Instant::now() + READY);
        loop {
            let (abort, heard) = self.shared.wait_for_event(until);
            if let Some(why) = abort {
                return Err(why.before_start());
            }
            match (heard, &event.ready) {
                // A flood of events may have driven out that it is open.
                (Some(Heard::Open | Heard::Event(_)), None) => return Ok(listening),
                (Some(Heard::Event(heard)), Some(ready)) if ready.holds(&heard, &self.call) => {
                    return Ok(listening);
                }
                (Some(Heard::Closed(reason)), _) => return rejected(&reason),
                (Some(_), _) if Instant::now() < until => {}
                (_, None) => return rejected("not connected in time"),
                (_, Some(_)) => {
                    return rejected("no event has confirmed in time that it listens (ready)");
                }
            }
        }
    }

    /// Waits for the event that ends the task.
    fn hear_the_end(&self, event: &EndEvent, _: &Listening, until: Instant) -> Outcome {
        let name = event.source.name();
        for condition in [Some(&event.until), event.failed.as_ref()]
            .into_iter()
            .flatten()
        {
            if let Err(reason) = condition.check(self.call()) {
                let stopped = self.stopped();
                return Outcome::Unknown(format!(
                    "nobody can tell when it is over, {stopped}: {reason}"
                ));
            }
        }
        let mut shown = Shown::default();
        loop {
            let next = shown.due().unwrap_or(until).min(until);
            let (abort, heard) = self.shared.wait_for_event(next);
            if abort.is_some()
                && let Some(outcome) = self.aborted()
            {
                return outcome;
            }
            match heard {
                Some(Heard::Event(heard)) => {
                    let holds = |condition: &Condition| condition.holds(&heard, self.call());
                    if event.failed.as_ref().is_some_and(holds) {
                        return Outcome::Failed(heard.text());
                    }
                    if holds(&event.until) {
                        return Outcome::Completed(self.result(&heard));
                    }
                    let path = event.show.as_deref();
                    if let Some(text) = path.and_then(|path| heard.field(path)?.to_text().ok()) {
                        shown.set(text);
                    }
                }
                Some(Heard::Closed(reason)) => {
                    // The robot may still do it.
                    let stopped = self.stopped();
                    return Outcome::Unknown(format!(
                        "no more events of {name}, {stopped}: {reason}"
                    ));
                }
                Some(Heard::Open) | None => {}
            }
            if Instant::now() >= until {
                let limit = human_time(self.kind.limit);
                return Outcome::Failed(match self.kind.request {
                    None => format!("no such event within {limit}"),
                    Some(_) => format!("not over within {limit}; {}", self.stopped()),
                });
            }
            if let Some(text) = shown.take() {
                self.task.effect(Effect::Progress(text));
            }
        }
    }

    /// Aborts what the robot may still do. Returns what has become of it.
    fn stopped(&self) -> &'static str {
        match self.abort() {
            Ok(()) => "it was aborted",
            Err(_) => "it may still run",
        }
    }

    /// Sends the request, again only if the file says that this may be done.
    fn ask(&self, request: &RequestTemplate, until: Instant) -> Result<Answer, NoAnswer> {
        let mut left = self.kind.repeat;
        let mut sent = false;
        // An abort that comes now is sent besides, or seen here.
        self.shared.is_asking.store(true, Ordering::SeqCst);
        if self.abort_reason().is_some() {
            let reason = String::new();
            return Err(NoAnswer { reason, sent });
        }
        loop {
            // A secret may have vanished since the goal was checked.
            let request = request.fill(&self.call).map_err(|reason| NoAnswer {
                reason,
                sent: false,
            })?;
            let answer = self.exchange(&request, until).map_err(|error| NoAnswer {
                sent: error.sent || sent,
                ..error
            });
            sent = answer.as_ref().is_err_and(|error| error.sent);
            let ends = left == 0 || Instant::now() + PAUSE >= until;
            if answer.is_ok() || ends || self.shared.wait_until(Instant::now() + PAUSE) {
                return answer;
            }
            left -= 1;
        }
    }

    /// Asks for progress until the robot has done it.
    fn follow(&self, progress: &Progress, until: Instant) -> Outcome {
        let limit = human_time(self.kind.limit);
        let mut told = String::new();
        let mut silent = None;
        loop {
            let next = (Instant::now() + progress.every).min(until);
            if self.shared.wait_until(next)
                && let Some(outcome) = self.aborted()
            {
                return outcome;
            }
            if Instant::now() >= until {
                // The robot may still do it.
                let stopped = self.stopped();
                return match silent {
                    Some(reason) => Outcome::Unknown(format!(
                        "no answer about its progress within {limit}, {stopped}: {reason}"
                    )),
                    None => Outcome::Failed(format!("not over within {limit}; {stopped}")),
                };
            }
            let is_short = until.saturating_duration_since(Instant::now()) < QUESTION;
            let request = progress.request.fill(self.call());
            let answer = request
                .map_err(|reason| NoAnswer {
                    reason,
                    sent: false,
                })
                .and_then(|request| {
                    let until = until.min(Instant::now() + QUESTION);
                    self.exchange(&request, until)
                });
            // What it says now may be because of an abort that came meanwhile.
            if let Some(outcome) = self.aborted() {
                return outcome;
            }
            let text = match &answer {
                Ok(answer) => {
                    silent = None;
                    if progress.until.holds(answer, self.call()) {
                        return Outcome::Completed(self.result(answer));
                    }
                    let show = progress.show.as_deref();
                    let shown = show.and_then(|path| answer.field(path)?.to_text().ok());
                    shown.unwrap_or_else(|| answer.text())
                }
                // The task's limit has cut the last question short: that says nothing about the robot.
                Err(_) if is_short && silent.is_none() && Instant::now() >= until => continue,
                Err(error) => {
                    silent = Some(error.to_string());
                    format!("{UNKNOWN_OUTCOME}{error}")
                }
            };
            if text != told {
                told.clone_from(&text);
                self.task.effect(Effect::Progress(text));
            }
        }
    }

    /// The field that is the result, or the whole answer.
    fn result(&self, answer: &Answer) -> String {
        let Some(path) = &self.kind.result else {
            return answer.text();
        };
        let field = answer.field(path).and_then(|field| field.to_text().ok());
        field.unwrap_or_else(|| {
            let (id, path) = (self.task.id, path.join("."));
            warn!(target: LOG, "Task {id}: the answer has no field '{path}', so that all of it is the result.");
            answer.text()
        })
    }

    fn exchange(&self, request: &Filled, until: Instant) -> Result<Answer, NoAnswer> {
        let is_asking = &self.shared.is_asking;
        is_asking.store(true, Ordering::SeqCst);
        let answer = exchange(request, until);
        is_asking.store(false, Ordering::SeqCst);
        answer
    }

    fn abort_reason(&self) -> Option<StopReason> {
        self.shared.lock().abort
    }

    /// Aborts the task, if it is to be aborted; nothing if that is not possible, so that it goes on.
    fn aborted(&self) -> Option<Outcome> {
        let why = self.abort_reason()?;
        match self.abort() {
            Ok(()) => Some(Outcome::Aborted(why.to_string())),
            Err(reason) => {
                self.shared.lock().abort = None;
                let text = format!("cannot abort: {reason}");
                self.task.effect(Effect::Progress(text));
                self.task.effect(Effect::RejectAbort(reason));
                None
            }
        }
    }

    /// Sends the abort, again if there is no answer.
    fn abort(&self) -> Result<(), String> {
        let Some((request, done)) = &self.kind.abort else {
            return match self.kind.request {
                // It only listens.
                None => Ok(()),
                Some(_) => Err("it has no abort".to_owned()),
            };
        };
        let until = Instant::now() + ABORT;
        let filled = request.fill(self.call())?;
        let mut reason = String::new();
        for attempt in 0..ABORTS {
            if attempt > 0 {
                // The robot may be busy with the request that is aborted.
                std::thread::sleep(PAUSE);
            }
            match exchange(&filled, until) {
                Ok(answer) if done.holds(&answer, self.call()) => {
                    self.shared.may_be_aborted.store(true, Ordering::SeqCst);
                    return Ok(());
                }
                Ok(answer) => reason = answer.failure(),
                Err(error) => {
                    let may_be = &self.shared.may_be_aborted;
                    may_be.fetch_or(error.sent, Ordering::SeqCst);
                    reason = error.to_string();
                }
            }
        }
        Err(format!("{}: {reason}", request.name()))
    }
}

/// The supervisor's side of a task.
struct HttpJob {
    run: Arc<Run>,
    accept_at: Option<Instant>,
    /// When the server stops without an end.
    leave_at: Option<Instant>,
}

impl Job for HttpJob {
    fn stop(&mut self, now: Instant, why: StopReason, effects: &mut Vec<Effect>) {
        if why == StopReason::Server {
            self.leave_at = now.checked_add(STOP_TIME);
        }
        if !self.run.kind.can_abort() {
            return effects.push(Effect::RejectAbort(CANNOT_ABORT.to_owned()));
        }
        self.run.shared.abort(why);
        let request = self.run.kind.abort.as_ref().map(|(request, _)| request);
        let needs_answer = request.is_none_or(RequestTemplate::uses_answer);
        if needs_answer && self.run.answered.get().is_none() {
            return;
        }
        let shared = &self.run.shared;
        if !shared.is_asking.load(Ordering::SeqCst)
            || shared.is_aborting.swap(true, Ordering::SeqCst)
        {
            return;
        }
        // The robot may act before it answers, and then stops at once. The task's thread aborts again after the answer,
        // since an abort may overtake the request.
        let run = Arc::clone(&self.run);
        let spawned = spawn("ztl-http-abort", move || {
            if let Err(reason) = run.abort() {
                let text = format!("cannot abort yet: {reason}");
                run.task.effect(Effect::Progress(text));
            }
            run.shared.is_aborting.store(false, Ordering::SeqCst);
        });
        if let Err(reason) = spawned {
            self.run.shared.is_aborting.store(false, Ordering::SeqCst);
            effects.push(Effect::Progress(format!("cannot abort yet: {reason}")));
        }
    }

    fn poll_timeout(&self) -> Option<Instant> {
        self.accept_at.into_iter().chain(self.leave_at).min()
    }

    fn handle_timeout(&mut self, now: Instant, effects: &mut Vec<Effect>) {
        if self.accept_at.is_some_and(|at| at <= now) {
            self.accept_at = None;
            effects.push(Effect::Accept);
        }
        if self.leave_at.is_some_and(|at| at <= now) {
            self.leave_at = None;
            effects.push(Effect::Leave);
        }
    }
}

/// What is shown as progress, not too often.
#[derive(Debug, Default)]
struct Shown {
    told: String,
    waiting: Option<String>,
    next: Option<Instant>,
}

impl Shown {
    fn set(&mut self, text: String) {
        self.waiting = Some(text);
    }

    /// When to call [`take`](Self::take).
    fn due(&self) -> Option<Instant> {
        self.next.filter(|_| self.waiting.is_some())
    }

    /// The text, if it is new, and the last one was some time ago.
    fn take(&mut self) -> Option<String> {
        let now = Instant::now();
        if self.next.is_some_and(|next| now < next) {
            return None;
        }
        let text = self.waiting.take().filter(|text| *text != self.told)?;
        self.told.clone_from(&text);
        self.next = now.checked_add(SHOW_EVERY);
        Some(text)
    }
}
