//! `http`: a request is the task, or begins one that the robot then does. Nothing is sent twice, unless the file says
//! that it may be repeated.

mod run;

use std::sync::Arc;
use std::time::Duration;

use ztl_std::describe::{GoalRule, GoalValue};
use ztl_yaml::{Fields, Node};

use super::condition::{Condition, Of};
use super::events::EventSource;
use super::request::{METHODS, RequestTemplate, Schemes};
use crate::call::Call;
use crate::kind::{JobContext, Kind, Outcome, Services, Start};
use crate::reader::{ComponentContext, ConfigReader};
use crate::value_template::{ValueTemplate, rule_of_paths};
use run::start;

/// How long a task may take, where the file does not say it.
const LIMIT: Duration = Duration::from_secs(30);
/// The longest such time.
const LONGEST: Duration = Duration::from_hours(24);
/// The pause between two questions after progress, where the file does not say it.
const EVERY: Duration = Duration::from_secs(1);
/// The longest such pause.
const LONGEST_EVERY: Duration = Duration::from_mins(1);
/// The most repetitions.
const MOST_REPETITIONS: usize = 10;

/// A task over HTTP.
#[derive(Debug)]
pub(crate) struct HttpTask {
    /// Nothing if the task only waits for an event.
    pub(super) request: Option<RequestTemplate>,
    pub(super) done: Condition,
    pub(super) result: Option<Vec<String>>,
    pub(super) limit: Duration,
    /// How often the request may be sent again if there is no answer.
    pub(super) repeat: usize,
    pub(super) abort: Option<(RequestTemplate, Condition)>,
    pub(super) after: After,
}

/// What happens after the answer.
#[derive(Debug)]
pub(super) enum After {
    Nothing,
    /// The task goes on for this time: seconds, or as `500 ms`.
    Lasts(ValueTemplate),
    Progress(Box<Progress>),
    Event(Box<EndEvent>),
}

/// A request that is sent again and again until the robot has done it.
#[derive(Debug)]
pub(super) struct Progress {
    pub(super) request: RequestTemplate,
    pub(super) every: Duration,
    pub(super) until: Condition,
    pub(super) show: Option<Vec<String>>,
}

/// Events, one of which says that the robot has done it.
#[derive(Debug)]
pub(super) struct EndEvent {
    pub(super) source: EventSource,
    /// The event after which the request is sent.
    pub(super) ready: Option<Condition>,
    pub(super) until: Condition,
    pub(super) failed: Option<Condition>,
    pub(super) show: Option<Vec<String>>,
}

/// Reads a task.
pub(crate) fn read<'d>(
    reader: &mut ConfigReader<'d>,
    node: &'d Node,
    beside: Option<&mut Fields<'d>>,
    context: ComponentContext<'_>,
) -> Option<Arc<dyn Kind>> {
    let rule = context.rule;
    reader.http_keys_beside(beside?);
    let what = "post: \"http://{robot}/api/halt\"";
    let mut fields = reader.yaml.fields(node, what)?;
    let methods = METHODS.map(|(key, _)| key);
    let request = match !fields.has_one_of(&methods) && fields.has_one_of(&["event"]) {
        true => Some(None),
        false => reader
            .http_request(&mut fields, rule, Schemes::Requests)
            .map(Some),
    };
    let done = fields.optional("done");
    let repeat = fields.optional("repeat");
    let has_request = !matches!(request, Some(None));
    for (node, key) in [(done, "done"), (repeat, "repeat")] {
        if let (Some(node), false) = (node, has_request) {
            let message = format!("{key} is about a request, and there is none; leave it out");
            reader.yaml.wrong(node, message);
        }
    }
    let done = done.map(|node| reader.http_condition(node, rule, Of::Answer));
    let result = fields.optional("result");
    let result = result.map(|node| reader.http_field(node));
    let limit = fields.optional("limit");
    let limit = limit.map(|node| reader.time(node, LONGEST));
    let repeat = repeat.map(|node| reader.count(node, MOST_REPETITIONS));
    let abort = fields.optional("abort");
    let abort = abort.map(|node| reader.with_answer(|reader| reader.http_abort(node, rule)));
    let after = ["for", "progress", "event"].map(|key| Some((key, fields.optional(key)?)));
    let mut after = after.into_iter().flatten();
    let first = after.next();
    if let Some((_, second)) = after.next() {
        let message = "give only one of: for, progress, event";
        reader.yaml.wrong(second, message);
    }
    let after = match first {
        Some(("for", node)) => reader.http_lasts(node, rule).map(After::Lasts),
        Some(("progress", node)) => {
            let progress = reader.with_answer(|reader| reader.http_progress(node, rule));
            progress.map(Box::new).map(After::Progress)
        }
        Some((_, node)) => {
            let event = reader.http_end_event(node, rule, has_request);
            event.map(Box::new).map(After::Event)
        }
        None => Some(After::Nothing),
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
    /// Tells of keys that belong into `http` and stand beside it.
    fn http_keys_beside(&mut self, fields: &mut Fields<'d>) {
        for key in [
            "json", "form", "headers", "bearer", "basic", "done", "result", "limit", "repeat",
            "for", "progress", "event", "abort",
        ] {
            if let Some(node) = fields.optional(key) {
                let message =
                    format!("this stands beside http; write it inside: http: {{…, {key}: …}}");
                self.yaml.wrong(node, message);
            }
        }
    }

    /// Reads what is used after the answer.
    fn with_answer<T>(&mut self, read: impl FnOnce(&mut Self) -> T) -> T {
        self.knows_answer = true;
        let value = read(self);
        self.knows_answer = false;
        value
    }

    /// Reads how long a task lasts.
    fn http_lasts(&mut self, node: &'d Node, rule: &GoalRule) -> Option<ValueTemplate> {
        let template = self.value_template(node, rule)?;
        if let ValueTemplate::Fixed(value) = &template
            && let Err(mistake) = duration(value)
        {
            self.yaml.wrong(node, mistake);
        }
        Some(template)
    }

    fn http_abort(
        &mut self,
        node: &'d Node,
        rule: &GoalRule,
    ) -> Option<(RequestTemplate, Condition)> {
        if node.is_plainly("no") {
            let message = "without abort, clients cannot abort; leave it out";
            self.yaml.wrong(node, message);
            return None;
        }
        let what = "post: \"http://{robot}/api/halt\"";
        let mut fields = self.yaml.fields(node, what)?;
        let request = self.http_request(&mut fields, rule, Schemes::Requests);
        let done = fields.optional("done");
        let done = done.map_or(Some(Condition::Success), |node| {
            self.http_condition(node, rule, Of::Answer)
        });
        fields.finish(&mut self.yaml);
        Some((request?, done?))
    }

    fn http_progress(&mut self, node: &'d Node, rule: &GoalRule) -> Option<Progress> {
        let what =
            "get: \"http://{robot}/api/state\", every: 500 ms, until: {field: state, is: idle}";
        let mut fields = self.yaml.fields(node, what)?;
        let request = self.http_request(&mut fields, rule, Schemes::Requests);
        let every = fields.optional("every");
        let every = every.map_or(Some(EVERY), |node| self.time(node, LONGEST_EVERY));
        let until = fields.required("until", "until: {field: state, is: idle}");
        let until = until.and_then(|node| self.http_condition(node, rule, Of::Answer));
        let show = fields.optional("show");
        let show = show.map(|node| self.http_field(node));
        fields.finish(&mut self.yaml);
        Some(Progress {
            request: request?,
            every: every?,
            until: until?,
            show: show.transpose_or()?,
        })
    }

    fn http_end_event(
        &mut self,
        node: &'d Node,
        rule: &GoalRule,
        has_request: bool,
    ) -> Option<EndEvent> {
        let what = "get: \"ws://{robot}/pubsub\", until: {field: state, is: idle}";
        let mut fields = self.yaml.fields(node, what)?;
        let source = self.http_events(node, &mut fields, rule);
        let ready = fields.optional("ready");
        let ready = ready.map(|node| self.http_condition(node, rule, Of::Event));
        let until = fields.required("until", "until: {field: state, is: idle}");
        let failed = fields.optional("failed");
        let read = |reader: &mut Self| {
            (
                until.and_then(|node| reader.http_condition(node, rule, Of::Event)),
                failed.map(|node| reader.http_condition(node, rule, Of::Event)),
            )
        };
        let (until, failed) = match has_request {
            true => self.with_answer(read),
            false => read(self),
        };
        let show = fields.optional("show");
        let show = show.map(|node| self.http_field(node));
        fields.finish(&mut self.yaml);
        Some(EndEvent {
            source: source?,
            ready: ready.transpose_or()?,
            until: until?,
            failed: failed.transpose_or()?,
            show: show.transpose_or()?,
        })
    }
}

impl EndEvent {
    /// Whether only events of this task end it.
    pub(super) fn names_task(&self) -> bool {
        let failed = self.failed.as_ref();
        self.until.names_task() && failed.is_none_or(Condition::names_task)
    }
}

impl HttpTask {
    fn requests(&self) -> impl Iterator<Item = &RequestTemplate> {
        let abort = self.abort.as_ref().map(|(request, _)| request);
        let progress = match &self.after {
            After::Progress(progress) => Some(&progress.request),
            _ => None,
        };
        self.request.iter().chain(abort).chain(progress)
    }

    fn conditions(&self) -> impl Iterator<Item = &Condition> {
        let abort = self.abort.as_ref().map(|(_, done)| done);
        let after = match &self.after {
            After::Progress(progress) => [Some(&progress.until), None, None],
            After::Event(event) => [
                event.ready.as_ref(),
                Some(&event.until),
                event.failed.as_ref(),
            ],
            After::Nothing | After::Lasts(_) => [None; 3],
        };
        let after = after.into_iter().flatten();
        [&self.done].into_iter().chain(abort).chain(after)
    }

    fn goal_paths(&self) -> Vec<&[String]> {
        let mut paths: Vec<&[String]> = Vec::new();
        self.requests()
            .for_each(|request| paths.extend(request.goal_paths()));
        self.conditions().for_each(|it| it.goal_paths(&mut paths));
        match &self.after {
            After::Lasts(template) => template.goal_paths(&mut paths),
            After::Event(event) => event.source.goal_paths(&mut paths),
            After::Nothing | After::Progress(_) => {}
        }
        paths
    }

    /// How long the task goes on after its answer.
    pub(super) fn lasts(&self, call: &Call) -> Result<Duration, String> {
        let After::Lasts(template) = &self.after else {
            return Ok(Duration::ZERO);
        };
        duration(&template.fill(call)?)
    }
}

/// A time: seconds, or as `500 ms`.
fn duration(value: &GoalValue) -> Result<Duration, String> {
    let time = match value {
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

impl Kind for HttpTask {
    fn goal_rule(&self) -> GoalRule {
        let paths = self.goal_paths();
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
        self.goal_paths().iter().any(|path| !path.is_empty())
    }

    fn can_abort(&self) -> bool {
        self.abort.is_some() || self.request.is_none()
    }

    fn check(&self, call: &Call) -> Result<(), String> {
        self.lasts(call)?;
        // What needs the answer is checked after it.
        let mut requests = self.requests().filter(|request| !request.uses_answer());
        requests.try_for_each(|request| request.fill(call).map(drop))?;
        let mut conditions = self.conditions().filter(|it| !it.uses_answer());
        conditions.try_for_each(|it| it.check(call))?;
        match &self.after {
            After::Event(event) => event.source.check(call),
            _ => Ok(()),
        }
    }

    fn start(self: Arc<Self>, call: Arc<Call>, task: JobContext, _: &Services) -> Start {
        match self.check(&call) {
            Ok(()) => start(self, call, task),
            Err(reason) => Start::Ended(Outcome::Rejected(reason)),
        }
    }
}
