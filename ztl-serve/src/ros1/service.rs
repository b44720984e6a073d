//! `ros1-service`: calls a service.

use std::sync::Arc;
use std::time::{Duration, Instant};

use ztl_ros1::message::{ServiceType, Value};
use ztl_ros1::{ServiceError, WireType};
use ztl_std::describe::GoalRule;
use ztl_yaml::{Fields, Node};

use super::connection::Connection;
use super::message::{MessageTemplate, rule_of_goals};
use super::shown::ShownMessage;
use super::used_name::UsedType;
use super::{Event, Refusal};
use crate::call::Call;
use crate::kind::{
    CANNOT_ABORT, Effect, Job, JobContext, JobEvent, Kind, Outcome, STOP_TIME, Services, Start,
    StopReason,
};
use crate::reader::{ComponentContext, ConfigReader};

/// How long a service may take, where the file does not say it.
const LIMIT: Duration = Duration::from_secs(10);
/// The longest `limit`.
const LONGEST_LIMIT: Duration = Duration::from_hours(1);

/// A service of a robot.
#[derive(Debug)]
pub(crate) struct Service {
    connection: Arc<Connection>,
    name: String,
    service: ServiceType,
    request: MessageTemplate,
    result: Option<ShownMessage>,
    limit: Duration,
}

/// Reads a service.
pub(crate) fn read<'d>(
    reader: &mut ConfigReader<'d>,
    node: &'d Node,
    fields: Option<&mut Fields<'d>>,
    context: ComponentContext<'_>,
) -> Option<Arc<dyn Kind>> {
    let fields = fields?;
    let example = "type: std_srvs/Trigger";
    let (name, service) = reader.ros1_typed_name(node, fields, "/dock", example, UsedType::service);
    let message = fields.optional("message");
    let result = fields.optional("result");
    let limit = fields.optional("limit");
    let limit = limit.and_then(|node| reader.time(node, LONGEST_LIMIT));
    let service = service?;
    let request = reader.message_or_goal(message, &service.request, context.rule, None);
    let result = result.and_then(|node| reader.shown_message(node, "response", &service.response));
    Some(Arc::new(Service {
        connection: Arc::clone(&reader.ros1.connection),
        name: name?,
        service,
        request,
        result,
        limit: limit.unwrap_or(LIMIT),
    }))
}

impl Service {
    /// The outcome of a task for the answer of its service.
    fn outcome(&self, answer: Result<Vec<u8>, Refusal>) -> Outcome {
        let bytes = match answer {
            Ok(bytes) => bytes,
            Err(Refusal { reason, unknown }) => {
                return match unknown {
                    true => Outcome::Unknown(reason),
                    false => Outcome::Failed(reason),
                };
            }
        };
        let whole = ShownMessage::whole(&self.service.response);
        let shown = self.result.as_ref().unwrap_or(&whole);
        let text = match shown.text(&bytes) {
            Ok(text) => text,
            Err(error) => return Outcome::Unknown(error),
        };
        // By custom, a response with `success` says whether it was done, and `message` why not.
        let response = self.service.response.decode(&bytes).ok();
        let response = response.as_ref();
        match response.and_then(|response| response.field("success")) {
            Some(Value::Bool(false)) => {
                let message = response.and_then(|response| response.field("message"));
                let message = message.and_then(Value::as_text).filter(|it| !it.is_empty());
                Outcome::Failed(message.map_or(text, str::to_owned))
            }
            _ => Outcome::Completed(text),
        }
    }
}

impl Kind for Service {
    fn goal_rule(&self) -> GoalRule {
        rule_of_goals(&self.request.goals())
    }

    fn needs_fields(&self) -> bool {
        self.request.needs_fields()
    }

    /// A service cannot be cancelled.
    fn can_abort(&self) -> bool {
        false
    }

    fn check(&self, call: &Call) -> Result<(), String> {
        self.request.fill(call).map(drop)
    }

    fn start(self: Arc<Self>, call: Arc<Call>, task: JobContext, _: &Services) -> Start {
        let request = self.request.fill(&call);
        let started = request.and_then(|request| Ok((request, self.connection.node()?)));
        let (request, node) = match started {
            Ok(started) => started,
            Err(reason) => return Start::Ended(Outcome::Rejected(reason)),
        };
        let service_type = WireType {
            name: self.service.name.clone(),
            md5: self.service.md5.clone(),
            definition: String::new(),
        };
        task.effect(Effect::Accept);
        node.call(
            &self.name,
            service_type,
            request,
            self.limit,
            move |answer| {
                let answer = answer.map_err(|error| Refusal {
                    unknown: is_unknown(&error),
                    reason: error.to_string(),
                });
                task.event(JobEvent::Ros1(Event::Response(answer)));
            },
        );
        Start::Running(Box::new(ServiceJob {
            service: self,
            leave_at: None,
        }))
    }
}

/// Whether the service may have done what was asked.
fn is_unknown(error: &ServiceError) -> bool {
    match error {
        ServiceError::Net { sent, .. } => *sent,
        ServiceError::Malformed { .. } => true,
        _ => false,
    }
}

struct ServiceJob {
    service: Arc<Service>,
    /// When the server stops without an answer.
    leave_at: Option<Instant>,
}

impl Job for ServiceJob {
    fn stop(&mut self, now: Instant, why: StopReason, effects: &mut Vec<Effect>) {
        match why {
            StopReason::Server => self.leave_at = now.checked_add(STOP_TIME),
            _ => effects.push(Effect::RejectAbort(CANNOT_ABORT.to_owned())),
        }
    }

    fn handle_event(&mut self, _: Instant, event: JobEvent, effects: &mut Vec<Effect>) {
        if let JobEvent::Ros1(Event::Response(answer)) = event {
            effects.push(Effect::End(self.service.outcome(answer)));
        }
    }

    fn poll_timeout(&self) -> Option<Instant> {
        self.leave_at
    }

    fn handle_timeout(&mut self, now: Instant, effects: &mut Vec<Effect>) {
        if self.leave_at.is_some_and(|at| at <= now) {
            self.leave_at = None;
            effects.push(Effect::Leave);
        }
    }
}
