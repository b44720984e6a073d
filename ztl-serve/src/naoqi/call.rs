//! `naoqi`: a call of a method is the task. Nothing is called twice: what was sent and lost is an unknown outcome.

use std::sync::Arc;
use std::time::{Duration, Instant};

use ztl_naoqi::{Call as NaoqiCall, CallError, CallHandle, Cancel, Client, MetaObject, Value};
use ztl_std::describe::GoalRule;
use ztl_yaml::{Fields, Node, NodeValue};

use super::Event;
use super::arguments::{Argument, Arguments, fit};
use super::connection::Robot;
use super::names::What;
use crate::call::Call;
use crate::human::human_time;
use crate::kind::{
    CANNOT_ABORT, Effect, Job, JobContext, JobEvent, Kind, Outcome, STOP_TIME, Services, Start,
    StopReason,
};
use crate::reader::{ComponentContext, ConfigReader};

/// How long a call waits for the description of its service.
const WAIT: Duration = Duration::from_secs(1);
/// How long a method may take to end after an abort, where the file does not say it.
const GRACE: Duration = Duration::from_secs(2);
/// The longest such time.
const LONGEST_GRACE: Duration = Duration::from_mins(1);

/// What an example of a method looks like.
const METHOD: &str = "a service and its method, as ALTextToSpeech.say";

/// A method, and its arguments.
#[derive(Debug, Clone)]
struct Target {
    service: String,
    method: String,
    arguments: Arguments,
}

/// How a task is aborted.
#[derive(Debug)]
enum Abort {
    /// The call is cancelled.
    Cancel,
    /// This is called, and if that is not enough, the call is cancelled.
    Call(Target),
    /// Not at all.
    No,
}

/// A method of a robot.
#[derive(Debug)]
pub(crate) struct MethodCall {
    robot: Arc<Robot>,
    target: Target,
    abort: Abort,
    grace: Duration,
}

/// Reads a method.
pub(crate) fn read<'d>(
    reader: &mut ConfigReader<'d>,
    node: &'d Node,
    fields: Option<&mut Fields<'d>>,
    context: ComponentContext<'_>,
) -> Option<Arc<dyn Kind>> {
    let fields = fields?;
    let arguments = fields.optional("arguments");
    let abort = fields.optional("abort");
    let grace = fields.optional("grace");
    let target = reader.naoqi_target(node, arguments, context.rule);
    let abort_node = abort;
    let abort = abort.map(|node| reader.naoqi_abort(node, context.rule));
    let grace_time = grace.and_then(|node| reader.time(node, LONGEST_GRACE));
    if let (Some(node), Some(Some(Abort::No))) = (grace, &abort) {
        let message = "grace has no effect with abort: no; leave it out";
        reader.yaml.wrong(node, message);
    }
    let target = target?;
    let abort = match abort {
        Some(abort) => abort?,
        None => Abort::Cancel,
    };
    let what = |target: &Target| What::Method(target.method.clone(), target.arguments.clone());
    reader.naoqi_uses(node, &target.service, what(&target));
    if let (Some(node), Abort::Call(target)) = (abort_node, &abort) {
        reader.naoqi_uses(node, &target.service, what(target));
    }
    Some(Arc::new(MethodCall {
        robot: Arc::clone(&reader.naoqi.robot),
        target,
        abort,
        grace: grace_time.unwrap_or(GRACE),
    }))
}

impl<'d> ConfigReader<'d> {
    fn naoqi_target(
        &mut self,
        node: &'d Node,
        arguments: Option<&'d Node>,
        rule: &GoalRule,
    ) -> Option<Target> {
        let name = self.naoqi_name(node, METHOD);
        let arguments = arguments.map(|node| self.naoqi_arguments(node, rule));
        let (service, method) = name?;
        Some(Target {
            service,
            method,
            arguments: match arguments {
                Some(arguments) => arguments?,
                None => Arguments::default(),
            },
        })
    }

    fn naoqi_abort(&mut self, node: &'d Node, rule: &GoalRule) -> Option<Abort> {
        if node.is_plainly("no") {
            return Some(Abort::No);
        }
        if let NodeValue::Map(_) = node.value {
            let what = "naoqi: ALMotion.stopMove, arguments: []";
            let mut fields = self.yaml.fields(node, what)?;
            let method = fields.required("naoqi", "naoqi: ALMotion.stopMove");
            let arguments = fields.optional("arguments");
            fields.finish(&mut self.yaml);
            return self.naoqi_target(method?, arguments, rule).map(Abort::Call);
        }
        self.naoqi_target(node, None, rule).map(Abort::Call)
    }
}

impl Target {
    /// What is called, in the types that the method takes.
    fn call(&self, meta: &MetaObject, arguments: Vec<Argument>) -> Result<NaoqiCall, String> {
        let values = fit(meta, &self.service, &self.method, arguments)?;
        Ok(NaoqiCall::new(&self.service, &self.method, values))
    }

    fn name(&self) -> String {
        format!("{}.{}", self.service, self.method)
    }
}

impl Kind for MethodCall {
    fn goal_rule(&self) -> GoalRule {
        self.target.arguments.goal_rule()
    }

    /// Most of what a robot does, it can do only once at a time.
    fn at_once(&self) -> usize {
        1
    }

    fn needs_fields(&self) -> bool {
        let of_abort = match &self.abort {
            Abort::Call(target) => target.arguments.needs_fields(),
            Abort::Cancel | Abort::No => false,
        };
        self.target.arguments.needs_fields() || of_abort
    }

    fn can_abort(&self) -> bool {
        !matches!(self.abort, Abort::No)
    }

    /// What ends it has its time first, then the cancellation.
    fn stop_time(&self) -> Duration {
        let grace = match self.abort {
            Abort::Call(_) => self.grace * 2,
            Abort::Cancel => self.grace,
            Abort::No => Duration::ZERO,
        };
        STOP_TIME.max(grace)
    }

    fn check(&self, call: &Call) -> Result<(), String> {
        self.target.arguments.fill(call).map(drop)
    }

    fn prepare(&self) {
        // Connects. If that fails, each task says why.
        let _ = self.robot.client();
    }

    fn start(self: Arc<Self>, call: Arc<Call>, task: JobContext, _: &Services) -> Start {
        let filled = self.target.arguments.fill(&call);
        let filled = filled.and_then(|arguments| Ok((arguments, self.robot.client()?)));
        let (arguments, client) = match filled {
            Ok(filled) => filled,
            Err(reason) => return Start::Ended(Outcome::Rejected(reason)),
        };
        let told = task.clone();
        client.describe_then(&self.target.service, WAIT, move |about| {
            told.event(JobEvent::Naoqi(Event::Described(about)));
        });
        Start::Running(Box::new(CallJob {
            method: self,
            call,
            task,
            client,
            stage: Stage::Asking(arguments),
            asked: None,
            abort: AbortStage::Idle,
            aborts_under_way: 0,
            was_told: false,
            stop_by: None,
            leave_at: None,
        }))
    }
}

enum Stage {
    /// The service says what it takes; nothing was sent.
    Asking(Vec<Argument>),
    Called(CallHandle),
}

#[derive(Debug, PartialEq)]
enum AbortStage {
    Idle,
    /// The method that aborts was called.
    Calling,
    /// It has returned.
    Called,
    /// The call was cancelled.
    Canceling,
}

/// A call under way.
struct CallJob {
    method: Arc<MethodCall>,
    call: Arc<Call>,
    task: JobContext,
    client: Client,
    stage: Stage,
    /// Why it is aborted, if it is.
    asked: Option<StopReason>,
    abort: AbortStage,
    /// How many calls that abort it have not ended.
    aborts_under_way: usize,
    /// Whether one has ended well.
    was_told: bool,
    /// When the method should have ended after an abort.
    stop_by: Option<Instant>,
    /// When the server stops without an end of the call.
    leave_at: Option<Instant>,
}

impl Job for CallJob {
    fn stop(&mut self, now: Instant, why: StopReason, effects: &mut Vec<Effect>) {
        let Stage::Called(_) = self.stage else {
            return effects.push(Effect::End(why.before_start()));
        };
        if why == StopReason::Server {
            self.leave_at = now.checked_add(self.method.stop_time());
        }
        if let Abort::No = self.method.abort {
            return effects.push(Effect::RejectAbort(CANNOT_ABORT.to_owned()));
        }
        self.asked.get_or_insert(why);
        if self.abort == AbortStage::Idle {
            self.begin_abort(now, effects);
        }
    }

    fn handle_event(&mut self, now: Instant, event: JobEvent, effects: &mut Vec<Effect>) {
        let JobEvent::Naoqi(event) = event else {
            return;
        };
        if let Event::AbortEnded(result) = &event {
            self.aborts_under_way = self.aborts_under_way.saturating_sub(1);
            self.was_told |= result.is_ok();
        }
        match event {
            Event::Described(about) => self.on_described(about, effects),
            Event::Ended(result) => effects.push(Effect::End(self.outcome(result))),
            // The answer to an abort that was given up must not stand in the way of the next.
            Event::AbortEnded(_) if self.abort != AbortStage::Calling => {}
            Event::AbortEnded(Ok(_)) => self.abort = AbortStage::Called,
            Event::AbortEnded(Err(error)) => {
                effects.push(Effect::Progress(format!("cannot abort: {error}")));
                self.cancel(now);
            }
            Event::Canceled(Cancel::Impossible) => self.give_up_abort(effects),
            Event::Canceled(_) => {}
        }
    }

    fn poll_timeout(&self) -> Option<Instant> {
        self.stop_by.into_iter().chain(self.leave_at).min()
    }

    fn handle_timeout(&mut self, now: Instant, effects: &mut Vec<Effect>) {
        if self.leave_at.is_some_and(|at| at <= now) {
            self.leave_at = None;
            return effects.push(Effect::Leave);
        }
        if self.stop_by.is_none_or(|at| at > now) {
            return;
        }
        self.stop_by = None;
        match self.abort {
            AbortStage::Calling | AbortStage::Called => {
                self.cancel(now);
            }
            AbortStage::Idle | AbortStage::Canceling => self.give_up_abort(effects),
        }
    }
}

impl CallJob {
    /// The service has said what it takes: calls it.
    fn on_described(
        &mut self,
        about: Result<Arc<MetaObject>, CallError>,
        effects: &mut Vec<Effect>,
    ) {
        let Stage::Asking(arguments) = &mut self.stage else {
            return;
        };
        let arguments = std::mem::take(arguments);
        let target = &self.method.target;
        let call = about.map_err(|error| error.to_string());
        let call = call.and_then(|meta| target.call(&meta, arguments));
        let call = match call {
            Ok(call) => call,
            Err(reason) => return effects.push(Effect::End(Outcome::Rejected(reason))),
        };
        let task = self.task.clone();
        // A service that has gone meanwhile is not waited for: what aborts could be called before this.
        let handle = self.client.call(call, Duration::ZERO, move |result| {
            task.event(JobEvent::Naoqi(Event::Ended(result)));
        });
        self.stage = Stage::Called(handle);
        effects.push(Effect::Accept);
    }

    fn begin_abort(&mut self, now: Instant, effects: &mut Vec<Effect>) {
        let Abort::Call(target) = &self.method.abort else {
            return self.cancel(now);
        };
        let arguments = match target.arguments.fill(&self.call) {
            Ok(arguments) => arguments,
            Err(reason) => {
                effects.push(Effect::Progress(format!("cannot abort: {reason}")));
                return self.cancel(now);
            }
        };
        self.abort = AbortStage::Calling;
        self.aborts_under_way += 1;
        self.stop_by = now.checked_add(self.method.grace);
        let (client, target, task) = (self.client.clone(), target.clone(), self.task.clone());
        let wait = self.method.grace;
        // The service is known in most cases, so that this takes no time.
        self.client
            .describe_then(&target.service.clone(), wait, move |about| {
                let told = move |result| task.event(JobEvent::Naoqi(Event::AbortEnded(result)));
                let call = about
                    .and_then(|meta| target.call(&meta, arguments).map_err(CallError::NotSent));
                match call {
                    Ok(call) => {
                        client.call(call, wait, told);
                    }
                    Err(error) => told(Err(error)),
                }
            });
    }

    fn cancel(&mut self, now: Instant) {
        let Stage::Called(handle) = self.stage else {
            return;
        };
        self.abort = AbortStage::Canceling;
        self.stop_by = now.checked_add(self.method.grace);
        let task = self.task.clone();
        self.client.cancel(handle, move |told| {
            task.event(JobEvent::Naoqi(Event::Canceled(told)));
        });
    }

    /// The method goes on in spite of the abort.
    fn give_up_abort(&mut self, effects: &mut Vec<Effect>) {
        let name = self.method.target.name();
        let grace = human_time(self.method.grace);
        self.abort = AbortStage::Idle;
        self.stop_by = None;
        let text = format!("{name} goes on: it has not ended within {grace} after an abort");
        effects.push(Effect::Progress(text.clone()));
        effects.push(Effect::RejectAbort(text));
    }

    fn outcome(&self, result: Result<Value, CallError>) -> Outcome {
        let aborted = || {
            let by_robot = || "cancelled by the robot".to_owned();
            self.asked.map_or_else(by_robot, |why| why.to_string())
        };
        // A method that was told to end by another one returns as if nothing had happened.
        let was_told = self.was_told || self.aborts_under_way > 0;
        match result {
            Ok(_) | Err(CallError::Failed(_)) if was_told => Outcome::Aborted(aborted()),
            Ok(value) => Outcome::Completed(value.to_string()),
            Err(CallError::Failed(text)) => Outcome::Failed(text),
            Err(CallError::Canceled) => Outcome::Aborted(aborted()),
            Err(CallError::Unknown(reason)) => {
                let name = self.method.target.name();
                Outcome::Unknown(format!("whether {name} was done: {reason}"))
            }
            // It has returned, so it was done.
            Err(error @ CallError::Unreadable(_)) => Outcome::Completed(error.to_string()),
            Err(error) => Outcome::Rejected(error.to_string()),
        }
    }
}
