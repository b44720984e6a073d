//! `naoqi-event` and `naoqi-signal`: what a robot tells, as a stream.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

use tracing::{debug, warn};
use ztl_naoqi::{Client, Event, SignalOf, SubscriptionHandle, Value};
use ztl_yaml::Node;

use super::connection::Robot;
use super::names::What;
use crate::kind::{Effect, Job, JobContext, Outcome, StopReason};
use crate::log::LOG;
use crate::reader::ConfigReader;
use crate::stream::waiting::Waiting;

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

/// A signal as a line of JSON: its value, or the list of its values.
fn line(values: Value) -> Vec<u8> {
    let written = match &values {
        Value::Tuple(_, items) => match &**items {
            [only] => serde_json::to_vec(only),
            _ => serde_json::to_vec(&values),
        },
        _ => serde_json::to_vec(&values),
    };
    // JSON has no keys that are lists.
    let text = || serde_json::to_vec(&values.to_string()).unwrap_or_default();
    let mut line = written.unwrap_or_else(|_| text());
    line.push(b'\n');
    line
}

/// A subscription for a stream.
pub(crate) struct SignalJob {
    waiting: Arc<Mutex<Waiting>>,
    /// `Err`: why there is none.
    subscription: Result<(Client, SubscriptionHandle), String>,
    is_accepted: bool,
}

impl SignalJob {
    pub(crate) fn new(signal: &Arc<Signal>, context: JobContext) -> Self {
        let waiting = Arc::new(Mutex::new(Waiting::default()));
        let (shared, told) = (Arc::clone(&waiting), Arc::clone(signal));
        let subscription = signal.robot.client().map(|client| {
            // A flood is told once.
            let mut is_told = false;
            let each = move |event| match event {
                Event::Signal {
                    values, dropped, ..
                } => {
                    let name = &told.name;
                    if dropped > 0 && !std::mem::replace(&mut is_told, true) {
                        warn!(target: LOG, "{dropped} signals {name} were dropped, since too many came at once.");
                    }
                    match values {
                        Ok(values) => {
                            let line = line(values);
                            let mut waiting =
                                shared.lock().unwrap_or_else(PoisonError::into_inner);
                            if waiting.push(line) {
                                context.mailbox.wake();
                            }
                        }
                        Err(error) => debug!(target: LOG, "A signal {name} cannot be read: {error}"),
                    }
                }
                Event::Unsubscribed { reason, .. } => {
                    let name = &told.name;
                    warn!(target: LOG, "No signals {name} until they are found again: {reason}");
                }
                _ => {}
            };
            let subscription = client.subscribe(signal.of.clone(), each);
            (client, subscription)
        });
        Self {
            waiting,
            subscription,
            is_accepted: false,
        }
    }
}

impl Job for SignalJob {
    fn stop(&mut self, _: Instant, _: StopReason, effects: &mut Vec<Effect>) {
        effects.push(Effect::End(Outcome::Aborted(String::new())));
    }

    fn poll_timeout(&self) -> Option<Instant> {
        let is_due = !self.is_accepted || self.subscription.is_err();
        is_due.then(Instant::now)
    }

    fn handle_timeout(&mut self, _: Instant, effects: &mut Vec<Effect>) {
        if !std::mem::replace(&mut self.is_accepted, true) {
            effects.push(Effect::Accept);
        }
        if let Err(reason) = &self.subscription {
            return effects.push(Effect::End(Outcome::Failed(reason.clone())));
        }
        let waiting = self.waiting.lock();
        let messages = waiting.unwrap_or_else(PoisonError::into_inner).take();
        effects.extend(messages.into_iter().map(Effect::Output));
    }
}

impl Drop for SignalJob {
    fn drop(&mut self) {
        if let Ok((client, subscription)) = &self.subscription {
            client.unsubscribe(*subscription);
        }
    }
}
