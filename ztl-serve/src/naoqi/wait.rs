//! `naoqi-wait`: a task that is over when the robot raises an event, such as a touch.

use std::sync::Arc;
use std::time::Instant;

use ztl_std::describe::GoalRule;
use ztl_yaml::{Fields, Node};

use super::signal::{Signal, Subscription};
use crate::call::Call;
use crate::kind::{Effect, Job, JobContext, Kind, Outcome, Services, Start, StopReason};
use crate::reader::{ComponentContext, ConfigReader};

/// A wait for an event.
#[derive(Debug)]
pub(crate) struct Wait {
    event: Signal,
    /// Its value; any without.
    is: Option<String>,
}

/// Reads a wait: the event, and `is`.
pub(crate) fn read<'d>(
    reader: &mut ConfigReader<'d>,
    node: &'d Node,
    fields: Option<&mut Fields<'d>>,
    _: ComponentContext<'_>,
) -> Option<Arc<dyn Kind>> {
    let fields = fields?;
    let is = fields.optional("is");
    for key in ["abort", "grace"] {
        if let Some(node) = fields.optional(key) {
            let message = format!("a wait ends at once when it is aborted; leave {key} out");
            reader.yaml.wrong(node, message);
        }
    }
    let event = reader.naoqi_signal("naoqi-event", node);
    let is = is.map(|node| reader.yaml.text(node, "a value, as 1"));
    Some(Arc::new(Wait {
        event: event?,
        is: match is {
            Some(is) => Some(is?.to_owned()),
            None => None,
        },
    }))
}

impl Kind for Wait {
    fn goal_rule(&self) -> GoalRule {
        GoalRule::Nothing
    }

    fn prepare(&self) {
        self.event.prepare();
    }

    fn start(self: Arc<Self>, _: Arc<Call>, task: JobContext, _: &Services) -> Start {
        let wait = Arc::clone(&self);
        let subscription = self.event.subscribe(move |value| {
            let text = value.to_string();
            if wait.is.as_ref().is_none_or(|is| same(&text, is)) {
                task.effect(Effect::End(Outcome::Completed(text)));
            }
        });
        match subscription {
            Ok(subscription) => Start::Running(Box::new(WaitJob {
                _subscription: subscription,
                is_accepted: false,
            })),
            Err(reason) => Start::Ended(Outcome::Rejected(reason)),
        }
    }
}

/// Whether both are the same value; of numbers, `1` and `1.0` are.
fn same(one: &str, other: &str) -> bool {
    let number = |text: &str| text.parse::<f64>().ok();
    one == other || (number(one).is_some() && number(one) == number(other))
}

struct WaitJob {
    /// Ends when it is dropped.
    _subscription: Subscription,
    is_accepted: bool,
}

impl Job for WaitJob {
    fn stop(&mut self, _: Instant, _: StopReason, effects: &mut Vec<Effect>) {
        effects.push(Effect::End(Outcome::Aborted("aborted".to_owned())));
    }

    fn poll_timeout(&self) -> Option<Instant> {
        (!self.is_accepted).then(Instant::now)
    }

    fn handle_timeout(&mut self, _: Instant, effects: &mut Vec<Effect>) {
        if !std::mem::replace(&mut self.is_accepted, true) {
            effects.push(Effect::Accept);
        }
    }
}
