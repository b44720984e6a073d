//! `naoqi-event` and `naoqi-signal`: what a robot tells, as a stream.

use std::sync::Arc;

use tracing::{debug, warn};
use ztl_naoqi::{Client, Event, SignalOf, SubscriptionHandle, Value};
use ztl_yaml::Node;

use super::connection::Robot;
use super::names::What;
use crate::kind::{Job, JobContext};
use crate::log::LOG;
use crate::reader::ConfigReader;
use crate::stream::received::{Inbox, ReceivingJob};

/// An event of the robot's memory, or a signal or property of a service.
#[derive(Debug)]
pub(crate) struct Signal {
    robot: Arc<Robot>,
    of: SignalOf,
    /// What the file calls it.
    name: String,
}

impl<'d> ConfigReader<'d> {
    /// Reads an event or a signal as a stream, by its key.
    pub(crate) fn naoqi_signal(&mut self, key: &str, node: &'d Node) -> Option<Signal> {
        let (of, name) = match key {
            "naoqi-event" => {
                let name = self
                    .yaml
                    .parsed(node, "an event, as FrontTactilTouched", |text| {
                        let is_odd = |c: char| c.is_whitespace() || c.is_control();
                        match text.is_empty() || text.contains(is_odd) {
                            true => Err(format!("'{text}' is not an event, as FrontTactilTouched")),
                            false => Ok(text.to_owned()),
                        }
                    })?;
                self.naoqi_uses(node, "ALMemory", What::Service);
                (SignalOf::memory(&name), name)
            }
            _ => {
                let what = "a service and its signal, as ALBehaviorManager.behaviorStarted";
                let (service, signal) = self.naoqi_name(node, what)?;
                self.naoqi_uses(node, &service, What::Signal(signal.clone()));
                let name = format!("{service}.{signal}");
                (SignalOf::service(&service, &signal), name)
            }
        };
        Some(Signal {
            robot: Arc::clone(&self.naoqi.robot),
            of,
            name,
        })
    }
}

/// What a signal brings: its value, or the list of its values.
fn value(values: Value) -> Value {
    let only = match &values {
        Value::Tuple(_, items) => match &**items {
            [only] => Some(only.clone()),
            _ => None,
        },
        _ => None,
    };
    only.unwrap_or(values)
}

/// A value as a line of JSON.
fn line(value: &Value) -> Vec<u8> {
    // JSON has no keys that are lists.
    let text = || serde_json::to_vec(&value.to_string()).unwrap_or_default();
    let mut line = serde_json::to_vec(value).unwrap_or_else(|_| text());
    line.push(b'\n');
    line
}

impl Signal {
    /// Connects, so that it is there when it is needed.
    pub(super) fn prepare(&self) {
        // If that fails, each task says why.
        let _ = self.robot.client();
    }

    /// Has each value passed on, of several their list.
    ///
    /// # Errors
    /// Why the client cannot start.
    pub(super) fn subscribe(
        &self,
        mut on: impl FnMut(Value) + Send + 'static,
    ) -> Result<Subscription, String> {
        let client = self.robot.client()?;
        let name = self.name.clone();
        // A flood is told once.
        let mut is_told = false;
        let each = move |event| match event {
            Event::Signal {
                values, dropped, ..
            } => {
                if dropped > 0 && !std::mem::replace(&mut is_told, true) {
                    warn!(target: LOG, "{dropped} signals {name} were dropped, since too many came at once.");
                }
                match values {
                    Ok(values) => on(value(values)),
                    Err(error) => {
                        debug!(target: LOG, "A signal {name} cannot be read: {error}")
                    }
                }
            }
            Event::Unsubscribed { reason, .. } => {
                warn!(target: LOG, "No signals {name} until they are found again: {reason}");
            }
            _ => {}
        };
        let handle = client.subscribe(self.of.clone(), each);
        Ok(Subscription { client, handle })
    }

    /// The job that receives it as a stream.
    pub(crate) fn job(self: &Arc<Self>, context: JobContext) -> Box<dyn Job> {
        let subscribe = |inbox: Inbox| self.subscribe(move |value| inbox.push(line(&value)));
        Box::new(ReceivingJob::new(context, subscribe, |line| line))
    }
}

/// Ends when it is dropped.
pub(super) struct Subscription {
    client: Client,
    handle: SubscriptionHandle,
}

impl Drop for Subscription {
    fn drop(&mut self) {
        self.client.unsubscribe(self.handle);
    }
}
