//! `http-event`: what a robot tells over a WebSocket, or by Server-Sent Events, as a stream.

use std::sync::Arc;

use ztl_std::describe::{CheckedGoal, GoalRule};
use ztl_yaml::{Fields, Node};

use super::condition::{Condition, Of};
use super::events::{EventSource, Heard};
use super::exchange::Answer;
use crate::call::Call;
use crate::kind::{Job, JobContext};
use crate::reader::ConfigReader;
use crate::stream::received::{Inbox, ReceivingJob};

/// Events of a robot.
#[derive(Debug)]
pub(crate) struct EventStream {
    source: EventSource,
    /// Which events count; all without.
    only: Option<Condition>,
    /// What of them is published; all without.
    field: Option<Vec<String>>,
}

impl<'d> ConfigReader<'d> {
    /// Reads events as a stream: where they come from, `only` and `field`.
    pub(crate) fn http_event(
        &mut self,
        node: &'d Node,
        fields: &mut Fields<'d>,
    ) -> Option<EventStream> {
        let rule = &GoalRule::Nothing;
        let what = "get: \"ws://{robot}/pubsub\", field: message";
        let mut event = self.yaml.fields(node, what)?;
        let source = self.http_events(node, &mut event, rule);
        let mut paths = Vec::new();
        if let Some(source) = &source {
            source.goal_paths(&mut paths);
        }
        if !paths.is_empty() {
            self.yaml.wrong(node, "a stream has no goal");
        }
        event.finish(&mut self.yaml);
        let only = fields.optional("only");
        let only = only.map(|node| self.http_condition(node, rule, Of::Event));
        let field = fields.optional("field");
        let field = field.map(|node| self.http_field(node));
        Some(EventStream {
            source: source?,
            only: match only {
                Some(only) => Some(only?),
                None => None,
            },
            field: match field {
                Some(field) => Some(field?),
                None => None,
            },
        })
    }
}

impl EventStream {
    /// The job that receives it. `longest`: most bytes of an event.
    pub(crate) fn job(
        self: &Arc<Self>,
        context: JobContext,
        longest: usize,
        scope: &str,
    ) -> Box<dyn Job> {
        let call = Call {
            id: context.id,
            scope: scope.to_owned(),
            handler: String::new(),
            component: String::new(),
            goal: CheckedGoal {
                text: String::new(),
                fields: None,
            },
            answer: None,
        };
        let stream = Arc::clone(self);
        let subscribe = |inbox: Inbox| {
            let source = &self.source;
            let name = source.name();
            let asked = call.clone();
            source.listen(&asked, longest, move |heard| match heard {
                Heard::Open => {}
                Heard::Event(event) => {
                    if let Some(line) = stream.line(&event, &call) {
                        inbox.push(line);
                    }
                }
                Heard::Closed(reason) => inbox.end(format!("{name}: {reason}")),
            })
        };
        Box::new(ReceivingJob::new(context, subscribe, |line| line))
    }

    /// An event as a line of JSON; `None` if it does not count.
    fn line(&self, event: &Answer, call: &Call) -> Option<Vec<u8>> {
        if let Some(only) = &self.only
            && !only.holds(event, call)
        {
            return None;
        }
        let written = match (&self.field, event.value()) {
            (Some(path), _) => serde_json::to_vec(&event.field(path)?),
            (None, Some(value)) => serde_json::to_vec(value),
            (None, None) => serde_json::to_vec(&event.text()),
        };
        let mut line = written.ok()?;
        line.push(b'\n');
        Some(line)
    }
}
