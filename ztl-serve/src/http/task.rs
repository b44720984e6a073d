//! `http`: a request is the task, or begins one that the robot then does. Nothing is sent twice, unless the file says
//! that it may be repeated.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::{Duration, Instant};

use ztl_core::dispatcher::UNKNOWN_OUTCOME;
use ztl_std::describe::{GoalRule, GoalValue};
use ztl_yaml::{Fields, Node};

use super::condition::Condition;
use super::exchange::{Answer, NoAnswer, exchange};
use super::request::{Filled, RequestTemplate};
use crate::call::Call;
use crate::human::human_time;
use crate::kind::{Effect, Job, JobContext, Kind, Outcome, STOP_TIME, Services, Start, StopReason};
use crate::reader::{ComponentContext, ConfigReader};
use crate::value_template::{ValueTemplate, rule_of_paths};

/// How long a task may take, where the file does not say it.
const LIMIT: Duration = Duration::from_secs(30);
/// The longest such time.
const LONGEST: Duration = Duration::from_hours(24);
/// The pause between two questions after progress, where the file does not say it.
const EVERY: Duration = Duration::from_secs(1);
/// The longest such pause.
const LONGEST_EVERY: Duration = Duration::from_mins(1);
/// How long a question after progress may take.
const QUESTION: Duration = Duration::from_secs(5);
/// How long an abort may take.
const ABORT: Duration = Duration::from_secs(5);
/// How often an abort is sent until it is answered.
const ABORTS: usize = 3;
/// The pause between two attempts of a request that may be repeated.
const PAUSE: Duration = Duration::from_millis(200);
/// The most repetitions.
const MOST_REPETITIONS: usize = 10;
/// After this time, a task is accepted without an answer.
const DECIDE: Duration = Duration::from_millis(300);

/// A task over HTTP.
#[derive(Debug)]
pub(crate) struct HttpTask {
    request: RequestTemplate,
    done: Condition,
    result: Option<Vec<String>>,
    limit: Duration,
    /// How often the request may be sent again if there is no answer.
    repeat: usize,
    abort: Option<(RequestTemplate, Condition)>,
    after: After,
}

/// What happens after the answer.
#[derive(Debug)]
enum After {
    Nothing,
    /// The task goes on for this time: seconds, or as `500 ms`.
    Lasts(ValueTemplate),
    Progress {
        request: Box<RequestTemplate>,
        every: Duration,
        until: Condition,
        show: Option<Vec<String>>,
    },
}

/// Reads a task.
pub(crate) fn read<'d>(
    reader: &mut ConfigReader<'d>,
    node: &'d Node,
    _: Option<&mut Fields<'d>>,
    context: ComponentContext<'_>,
) -> Option<Arc<dyn Kind>> {
    let rule = context.rule;
    let what = "post: \"http://{robot}/api/halt\"";
    let mut fields = reader.yaml.fields(node, what)?;
    let request = reader.http_request(node, &mut fields, rule);
    let done = fields.optional("done");
    let done = done.map(|node| reader.http_condition(node));
    let result = fields.optional("result");
    let result = result.map(|node| reader.http_field(node));
    let limit = fields.optional("limit");
    let limit = limit.map(|node| reader.time(node, LONGEST));
    let repeat = fields.optional("repeat");
    let repeat = repeat.map(|node| reader.count(node, MOST_REPETITIONS));
    let abort = fields.optional("abort");
    let abort = abort.map(|node| reader.http_abort(node, rule));
    let (lasts, progress) = (fields.optional("for"), fields.optional("progress"));
    if let (Some(node), Some(_)) = (lasts, progress) {
        reader.yaml.wrong(node, "give only one of: for, progress");
    }
    let after = match (progress, lasts) {
        (Some(node), _) => reader.http_progress(node, rule),
        (None, Some(node)) => reader.value_template(node, rule).map(After::Lasts),
        (None, None) => Some(After::Nothing),
    };
    fields.finish(&mut reader.yaml);
    Some(Arc::new(HttpTask {
        request: request?,
        done: done.unwrap_or(Some(Condition::Success))?,
        result: result.transpose_or()?,
        limit: limit.unwrap_or(Some(LIMIT))?,
        repeat: repeat.unwrap_or(Some(0))?,
        abort: abort.transpose_or()?,
        after: after?,
    }))
}

/// `Some(None)`: there is a mistake.
trait TransposeOr<T> {
    fn transpose_or(self) -> Option<Option<T>>;
}

impl<T> TransposeOr<T> for Option<Option<T>> {
    fn transpose_or(self) -> Option<Option<T>> {
        match self {
            Some(None) => None,
            Some(some) => Some(some),
            None => Some(None),
        }
    }
}

impl<'d> ConfigReader<'d> {
    fn http_abort(
        &mut self,
        node: &'d Node,
        rule: &GoalRule,
    ) -> Option<(RequestTemplate, Condition)> {
        let what = "post: \"http://{robot}/api/halt\"";
        let mut fields = self.yaml.fields(node, what)?;
        let request = self.http_request(node, &mut fields, rule);
        let done = fields.optional("done");
        let done = done.map_or(Some(Condition::Success), |node| self.http_condition(node));
        fields.finish(&mut self.yaml);
        Some((request?, done?))
    }

    fn http_progress(&mut self, node: &'d Node, rule: &GoalRule) -> Option<After> {
        let what =
            "get: \"http://{robot}/api/state\", every: 500 ms, until: {field: state, is: idle}";
        let mut fields = self.yaml.fields(node, what)?;
        let request = self.http_request(node, &mut fields, rule);
        let every = fields.optional("every");
        let every = every.map_or(Some(EVERY), |node| self.time(node, LONGEST_EVERY));
        let until = fields.required("until", "until: {field: state, is: idle}");
        let until = until.and_then(|node| self.http_condition(node));
        let show = fields.optional("show");
        let show = show.map(|node| self.http_field(node));
        fields.finish(&mut self.yaml);
        Some(After::Progress {
            request: Box::new(request?),
            every: every?,
            until: until?,
            show: show.transpose_or()?,
        })
    }
}

impl HttpTask {
    fn requests(&self) -> impl Iterator<Item = &RequestTemplate> {
        let abort = self.abort.as_ref().map(|(request, _)| request);
        let progress = match &self.after {
            After::Progress { request, .. } => Some(&**request),
            _ => None,
        };
        [&self.request].into_iter().chain(abort).chain(progress)
    }

    /// How long the task goes on after its answer.
    fn lasts(&self, call: &Call) -> Result<Duration, String> {
        let After::Lasts(template) = &self.after else {
            return Ok(Duration::ZERO);
        };
        let value = template.fill(call)?;
        let time = match &value {
            GoalValue::Integer(seconds) => Duration::try_from_secs_f64(*seconds as f64).ok(),
            GoalValue::Float(seconds) => Duration::try_from_secs_f64(*seconds).ok(),
            GoalValue::Text(text) => humantime::parse_duration(text).ok(),
            _ => None,
        };
        let time = time.filter(|time| *time <= LONGEST);
        time.ok_or_else(|| {
            let value = value.to_text().unwrap_or_default();
            format!("'{value}' is not a time: expected seconds, or as 500 ms, at most 24 h")
        })
    }
}

impl Kind for HttpTask {
    fn goal_rule(&self) -> GoalRule {
        let mut paths: Vec<&[String]> = Vec::new();
        self.requests()
            .for_each(|request| paths.extend(request.goal_paths()));
        if let After::Lasts(template) = &self.after {
            template.goal_paths(&mut paths);
        }
        match paths.is_empty() || paths.iter().any(|path| !path.is_empty()) {
            true => rule_of_paths(&paths),
            false => GoalRule::Any,
        }
    }

    /// Most of what a robot does, it can do only once at a time.
    fn at_once(&self) -> usize {
        1
    }

    fn needs_fields(&self) -> bool {
        let lasts = match &self.after {
            After::Lasts(template) => template.needs_fields(),
            _ => false,
        };
        lasts || self.requests().any(RequestTemplate::needs_fields)
    }

    fn can_abort(&self) -> bool {
        self.abort.is_some()
    }

    fn check(&self, call: &Call) -> Result<(), String> {
        self.lasts(call)?;
        let mut requests = self.requests();
        requests.try_for_each(|request| request.fill(call).map(drop))
    }

    fn start(self: Arc<Self>, call: Arc<Call>, task: JobContext, _: &Services) -> Start {
        if let Err(reason) = self.check(&call) {
            return Start::Ended(Outcome::Rejected(reason));
        }
        let shared = Arc::new(Shared::new());
        let run = Run {
            kind: self,
            call,
            task,
            shared: Arc::clone(&shared),
        };
        let run = Arc::new(run);
        let worker = Arc::clone(&run);
        let spawned = spawn("ztl-http", move || {
            let outcome = worker.run();
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
}

fn spawn(name: &str, work: impl FnOnce() + Send + 'static) -> Result<(), String> {
    let thread = std::thread::Builder::new().name(name.to_owned());
    let spawned = thread.spawn(work).map(drop);
    spawned.map_err(|error| format!("cannot start a thread: {error}"))
}

/// What a task's thread and the supervisor's know of it.
#[derive(Debug)]
struct Shared {
    /// Whether it is to be aborted.
    abort: Mutex<bool>,
    changed: Condvar,
    /// Whether the task's thread waits for an answer, so that it cannot abort.
    is_asking: AtomicBool,
}

impl Shared {
    fn new() -> Self {
        Self {
            abort: Mutex::new(false),
            changed: Condvar::new(),
            is_asking: AtomicBool::new(true),
        }
    }

    fn set_abort(&self, value: bool) {
        *self.abort.lock().unwrap_or_else(PoisonError::into_inner) = value;
        self.changed.notify_all();
    }

    /// Waits until this time, or until the task is to be aborted. Returns whether it is.
    fn wait_until(&self, until: Instant) -> bool {
        let mut abort = self.abort.lock().unwrap_or_else(PoisonError::into_inner);
        while !*abort {
            let left = until.saturating_duration_since(Instant::now());
            if left.is_zero() {
                break;
            }
            let waited = self.changed.wait_timeout(abort, left);
            abort = waited.unwrap_or_else(PoisonError::into_inner).0;
        }
        *abort
    }
}

/// A task in progress.
struct Run {
    kind: Arc<HttpTask>,
    call: Arc<Call>,
    task: JobContext,
    shared: Arc<Shared>,
}

impl Run {
    fn run(&self) -> Outcome {
        let kind = &self.kind;
        let until = Instant::now() + kind.limit;
        let answer = self.ask(until);
        let answer = match answer {
            Ok(answer) => answer,
            Err(NoAnswer { sent: false, .. }) if self.is_aborted() => {
                return StopReason::Client.before_start();
            }
            Err(NoAnswer {
                reason,
                sent: false,
            }) => {
                return Outcome::Rejected(format!("{}: {reason}", kind.request.name()));
            }
            Err(NoAnswer { reason, .. }) => {
                // What was sent before may have been overtaken.
                let aborted = match self.is_aborted() && self.abort().is_ok() {
                    true => "an abort was sent, but ",
                    false => "",
                };
                let name = kind.request.name();
                return Outcome::Failed(format!(
                    "{UNKNOWN_OUTCOME}{aborted}whether {name} was done: {reason}"
                ));
            }
        };
        self.task.effect(Effect::Accept);
        if let Some(outcome) = self.aborted() {
            return outcome;
        }
        if !kind.done.holds(&answer) {
            return Outcome::Failed(format!("status {}: {}", answer.status, answer.text()));
        }
        let result = self.result(&answer);
        match &kind.after {
            After::Nothing => Outcome::Completed(result),
            After::Lasts(_) => {
                let lasts = kind.lasts(&self.call).unwrap_or_default();
                let end = Instant::now() + lasts;
                while self.shared.wait_until(end) {
                    if let Some(outcome) = self.aborted() {
                        return outcome;
                    }
                }
                Outcome::Completed(result)
            }
            After::Progress {
                request,
                every,
                until: over,
                show,
            } => self.follow((request, *every), over, show.as_deref(), until),
        }
    }

    /// Sends the request, again only if the file says that this may be done.
    fn ask(&self, until: Instant) -> Result<Answer, NoAnswer> {
        let mut left = self.kind.repeat;
        let mut sent = false;
        if self.is_aborted() {
            let reason = String::new();
            return Err(NoAnswer { reason, sent });
        }
        loop {
            // A secret may have vanished since the goal was checked.
            let request = self.kind.request.fill(&self.call);
            let request = request.map_err(|reason| NoAnswer {
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
    fn follow(
        &self,
        (request, every): (&RequestTemplate, Duration),
        over: &Condition,
        show: Option<&[String]>,
        until: Instant,
    ) -> Outcome {
        let limit = human_time(self.kind.limit);
        let mut told = String::new();
        let mut silent = None;
        loop {
            let next = (Instant::now() + every).min(until);
            if self.shared.wait_until(next)
                && let Some(outcome) = self.aborted()
            {
                return outcome;
            }
            if Instant::now() >= until {
                // The robot may still do it.
                let stopped = match self.abort() {
                    Ok(()) => "it was aborted",
                    Err(_) => "it may still run",
                };
                return match silent {
                    Some(reason) => Outcome::Failed(format!(
                        "{UNKNOWN_OUTCOME}no answer about its progress within {limit}, {stopped}: {reason}"
                    )),
                    None => Outcome::Failed(format!("not over within {limit}; {stopped}")),
                };
            }
            let request = request.fill(&self.call);
            let answer = request
                .map_err(|reason| NoAnswer {
                    reason,
                    sent: false,
                })
                .and_then(|request| {
                    let until = until.min(Instant::now() + QUESTION);
                    self.exchange(&request, until)
                });
            let text = match &answer {
                Ok(answer) => {
                    silent = None;
                    if over.holds(answer) {
                        return Outcome::Completed(self.result(answer));
                    }
                    let shown = show.and_then(|path| answer.field(path)?.to_text().ok());
                    shown.unwrap_or_else(|| answer.text())
                }
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

    fn result(&self, answer: &Answer) -> String {
        let path = self.kind.result.as_deref();
        let field = path.and_then(|path| answer.field(path)?.to_text().ok());
        field.unwrap_or_else(|| answer.text())
    }

    fn exchange(&self, request: &Filled, until: Instant) -> Result<Answer, NoAnswer> {
        let is_asking = &self.shared.is_asking;
        is_asking.store(true, Ordering::Release);
        let answer = exchange(request, until);
        is_asking.store(false, Ordering::Release);
        answer
    }

    fn is_aborted(&self) -> bool {
        self.shared.wait_until(Instant::now())
    }

    /// Aborts the task, if it is to be aborted; nothing if that is not possible, so that it goes on.
    fn aborted(&self) -> Option<Outcome> {
        if !self.is_aborted() {
            return None;
        }
        match self.abort() {
            Ok(()) => Some(Outcome::Aborted("aborted".to_owned())),
            Err(reason) => {
                self.shared.set_abort(false);
                let text = format!("cannot abort: {reason}");
                self.task.effect(Effect::Progress(text));
                self.task.effect(Effect::RejectAbort);
                None
            }
        }
    }

    /// Sends the abort, again if there is no answer.
    fn abort(&self) -> Result<(), String> {
        let (request, done) = self.kind.abort.as_ref().ok_or("it has no abort")?;
        let until = Instant::now() + ABORT;
        let filled = request.fill(&self.call)?;
        let mut reason = String::new();
        for attempt in 0..ABORTS {
            if attempt > 0 {
                // The robot may be busy with the request that is aborted.
                std::thread::sleep(PAUSE);
            }
            match exchange(&filled, until) {
                Ok(answer) if done.holds(&answer) => return Ok(()),
                Ok(answer) => reason = format!("status {}: {}", answer.status, answer.text()),
                Err(error) => reason = error.to_string(),
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
        if self.run.kind.abort.is_none() {
            return effects.push(Effect::RejectAbort);
        }
        self.run.shared.set_abort(true);
        if !self.run.shared.is_asking.load(Ordering::Acquire) {
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
        });
        if let Err(reason) = spawned {
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
