//! Keeps the registration with the master up, also with a master that was restarted and has forgotten everything.
//!
//! One call at a time, so that they arrive in order. Once all is registered, the master is asked every second whether it
//! still knows this node.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::{Duration, Instant};

use super::Engine;
use super::rpc::CallError;
use crate::xmlrpc::Value;

/// How often the master is asked whether it knows this node, and the pause after a failed call.
const CHECK: Duration = Duration::from_secs(1);

/// How long the master may take to answer.
pub(crate) const LIMIT: Duration = Duration::from_secs(5);

/// How long a node that stops waits for its calls.
pub(crate) const STOP: Duration = Duration::from_secs(2);

/// The state of the registration.
#[derive(Debug, Default)]
pub(crate) struct Registrar {
    calling: bool,
    /// Whether the master knew this node at the last check.
    known: bool,
    /// No call before this.
    not_before: Option<Instant>,
    /// Topics to unregister: the method and its parameters after the node's name.
    farewells: VecDeque<(&'static str, Vec<Value>)>,
    /// Why the last call failed.
    obstacle: Option<CallError>,
    /// The last reason why the master does not register a topic.
    refusal: Option<String>,
}

impl Registrar {
    /// Why the master does not answer.
    pub(crate) const fn obstacle(&self) -> Option<&CallError> {
        self.obstacle.as_ref()
    }
}

/// What to register next.
enum Next {
    /// Unregister it first.
    Renewal(Arc<str>),
    Publication(Arc<str>, String),
    Subscription(Arc<str>, String),
    Check,
}

impl Engine {
    /// Calls the master if a registration or a check is due.
    pub(crate) fn turn_registrar(&mut self, now: Instant) {
        if self.registrar.calling {
            return;
        }
        if let Some(at) = self.registrar.not_before.filter(|at| *at > now) {
            return self.net.wake_by(at);
        }
        if let Some((method, params)) = self.registrar.farewells.pop_front() {
            return self.call_master(now, method, params, |engine, _, answer| {
                engine.note_answer(answer);
            });
        }
        if self.stopping.is_some() {
            return;
        }
        match self.next_registration(now) {
            Next::Renewal(topic) => {
                let params = vec![topic[..].into(), self.api_uri[..].into()];
                self.call_master(
                    now,
                    "unregisterPublisher",
                    params,
                    move |engine, now, answer| {
                        let publication = engine.publications.get_mut(&topic);
                        if let (Some(publication), Ok(_) | Err(CallError::Refused { .. })) =
                            (publication, &answer)
                        {
                            publication.on_unregistered(now);
                        }
                        engine.note_answer(answer);
                    },
                );
            }
            Next::Publication(topic, name) => {
                let params = vec![topic[..].into(), name[..].into(), self.api_uri[..].into()];
                self.call_master(
                    now,
                    "registerPublisher",
                    params,
                    move |engine, now, answer| {
                        if engine.on_registered(now, &topic, answer).is_some()
                            && let Some(publication) = engine.publications.get_mut(&topic)
                        {
                            publication.registered = true;
                        }
                    },
                );
            }
            Next::Subscription(topic, name) => {
                let params = vec![topic[..].into(), name[..].into(), self.api_uri[..].into()];
                self.call_master(
                    now,
                    "registerSubscriber",
                    params,
                    move |engine, now, answer| {
                        if let Some(publishers) = engine.on_registered(now, &topic, answer) {
                            if let Some(subscription) = engine.subscriptions.get_mut(&topic) {
                                subscription.registered = true;
                            }
                            engine.on_publishers(now, &topic, &uris(&publishers));
                        }
                    },
                );
            }
            Next::Check => {
                let own = vec![self.name[..].into()];
                self.call_master(now, "lookupNode", own, |engine, now, answer| {
                    let known =
                        answer.as_ref().ok().and_then(Value::as_str) == Some(&engine.api_uri);
                    if !known {
                        engine.forget_registrations();
                    }
                    match answer {
                        // A master without memory answers so.
                        Ok(_) | Err(CallError::Refused { .. }) => {
                            engine.note(Ok(()));
                            engine.refresh_clock(now);
                        }
                        Err(error) => engine.note(Err(error)),
                    }
                    let anything =
                        !engine.publications.is_empty() || !engine.subscriptions.is_empty();
                    // Registers again at once, but not again and again with a master that never knows this node.
                    let was_known = std::mem::replace(&mut engine.registrar.known, known);
                    if known || !was_known || !anything {
                        engine.registrar.not_before = Some(now + CHECK);
                    }
                });
            }
        }
    }

    /// Tells the master that the topic has one publisher or subscriber less.
    pub(crate) fn unregister(&mut self, method: &'static str, topic: &str) {
        let params = vec![topic.into(), self.api_uri[..].into()];
        self.registrar.farewells.push_back((method, params));
    }

    /// Whether all is said that had to be, after the node was stopped.
    pub(crate) fn has_stopped(&mut self, now: Instant) -> bool {
        let idle = !self.registrar.calling && self.registrar.farewells.is_empty();
        self.stopping
            .is_some_and(|limit| limit <= now || idle && self.net.has_settled())
    }

    /// Begins to stop.
    pub(crate) fn stop(&mut self, now: Instant) {
        self.stopping = Some(now + STOP);
        let publications = self.publications.values_mut();
        let subscribers = publications.flat_map(|of| std::mem::take(&mut of.subscribers));
        for id in subscribers.map(|(id, _)| id) {
            self.roles.remove(&id);
            self.net.close_when_sent(now, id);
        }
        self.registrar.not_before = None;
        for topic in self.publications.keys().cloned().collect::<Vec<_>>() {
            self.unregister("unregisterPublisher", &topic);
        }
        for topic in self.subscriptions.keys().cloned().collect::<Vec<_>>() {
            self.unregister("unregisterSubscriber", &topic);
        }
    }

    fn next_registration(&mut self, now: Instant) -> Next {
        for (topic, publication) in &self.publications {
            match publication.renewal() {
                Some(at) if at > now => self.net.wake_by(at),
                Some(_) => return Next::Renewal(Arc::clone(topic)),
                None => {}
            }
        }
        let publication = self.publications.iter().find(|(_, of)| !of.registered);
        if let Some((topic, publication)) = publication {
            return Next::Publication(Arc::clone(topic), publication.ty.name.clone());
        }
        let subscription = self.subscriptions.iter().find(|(_, of)| !of.registered);
        match subscription {
            Some((topic, of)) => Next::Subscription(Arc::clone(topic), of.ty.name.clone()),
            None => Next::Check,
        }
    }

    fn call_master(
        &mut self,
        now: Instant,
        method: &str,
        params: Vec<Value>,
        then: impl FnOnce(&mut Self, Instant, Result<Value, CallError>) + Send + 'static,
    ) {
        self.registrar.calling = true;
        let mut all = vec![self.name[..].into()];
        all.extend(params);
        let then = move |engine: &mut Self, now: Instant, answer: Result<Value, CallError>| {
            engine.registrar.calling = false;
            if let Err(error) = &answer
                && !matches!(error, CallError::Refused { .. })
            {
                // It may be a new master.
                engine.forget_registrations();
                engine.registrar.farewells.clear();
                engine.registrar.not_before = Some(now + CHECK);
            }
            then(engine, now, answer);
        };
        let master = self.master.clone();
        self.rpc(now, &master, method, &all, LIMIT, Box::new(then));
    }

    fn on_registered(
        &mut self,
        now: Instant,
        topic: &str,
        answer: Result<Value, CallError>,
    ) -> Option<Value> {
        match answer {
            Ok(value) => {
                self.note(Ok(()));
                Some(value)
            }
            Err(error) => {
                self.registrar.not_before = Some(now + CHECK);
                match error {
                    // It answers.
                    CallError::Refused { reason } => {
                        let text = format!("the ROS master does not register {topic}: {reason}");
                        if self.registrar.refusal.as_ref() != Some(&text) {
                            tracing::warn!("{text}");
                        }
                        self.registrar.refusal = Some(text);
                        self.note(Ok(()));
                    }
                    error => self.note(Err(error)),
                }
                None
            }
        }
    }

    /// Notes that the master answers, if it does; a refusal is an answer.
    fn note_answer(&mut self, answer: Result<Value, CallError>) {
        self.note(match answer {
            Ok(_) | Err(CallError::Refused { .. }) => Ok(()),
            Err(error) => Err(error),
        });
    }

    fn note(&mut self, answer: Result<(), CallError>) {
        let obstacle = answer.err();
        match &obstacle {
            Some(error) if self.registrar.obstacle.is_none() => {
                tracing::warn!("the ROS master {} does not answer: {error}", self.master);
            }
            None if self.registrar.obstacle.is_some() => {
                tracing::warn!("the ROS master {} answers again", self.master);
            }
            _ => {}
        }
        self.registrar.obstacle = obstacle;
    }

    fn forget_registrations(&mut self) {
        self.publications
            .values_mut()
            .for_each(|of| of.registered = false);
        self.subscriptions
            .values_mut()
            .for_each(|of| of.registered = false);
        self.clock.known = false;
    }
}

/// The texts of a list.
pub(crate) fn uris(value: &Value) -> Vec<String> {
    let items = value.as_array().unwrap_or_default();
    items
        .iter()
        .filter_map(Value::as_str)
        .map(str::to_owned)
        .collect()
}
