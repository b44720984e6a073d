//! Calls: waiting for their service, under way, ended.

use std::sync::Arc;
use std::time::{Duration, Instant};

use crate::connection::payload;
use crate::message::{Address, Message};
use crate::meta_object::{MetaObject, Object};
use crate::value::Value;

use super::functions::MAIN;
use super::pending::Pending;
use super::{CallError, CallId, Cancel, Event, LinkId, Session};

/// How long the answer of a service that was removed may take: it comes from another process than the removal.
const GRACE: Duration = Duration::from_millis(500);

/// A call that has not ended.
#[derive(Debug)]
pub(super) struct PendingCall {
    service: String,
    stage: CallStage,
}

#[derive(Debug)]
enum CallStage {
    Waiting {
        /// The method and its arguments; nothing to ask for a description.
        method: Option<(String, Vec<Value>)>,
        until: Instant,
    },
    Sent {
        link: LinkId,
        message: u32,
        address: Address,
        /// The signature of the result.
        returns: String,
        /// When to give up.
        until: Option<Instant>,
    },
}

impl Session {
    pub(super) fn begin(
        &mut self,
        service: String,
        method: Option<(String, Vec<Value>)>,
        wait: Duration,
        now: Instant,
    ) -> Result<CallId, CallError> {
        if self.calls.len() >= self.options.limits.calls {
            return Err(CallError::NotSent(
                "too many calls are under way".to_owned(),
            ));
        }
        let call = CallId(self.new_id());
        // A time that an `Instant` cannot hold is never over.
        let far = Duration::from_secs(365 * 24 * 3600);
        let until = now.checked_add(wait.min(far)).unwrap_or(now);
        let stage = CallStage::Waiting { method, until };
        let name = service.clone();
        self.calls.insert(call, PendingCall { service, stage });
        self.services.get_or_default(&name).waiting.push(call);
        self.want(&name);
        Ok(call)
    }

    /// Cancels a call. It ends as [`CallError::Canceled`], or as it would have ended if the service ignores that.
    pub fn cancel(&mut self, call: CallId) -> Cancel {
        let Some(pending) = self.calls.get(&call) else {
            return Cancel::Ended;
        };
        let CallStage::Sent {
            link,
            message,
            address,
            ..
        } = pending.stage
        else {
            self.end(call, Err(CallError::Canceled));
            return Cancel::Ended;
        };
        let connection = self
            .links
            .get_mut(&link)
            .and_then(|link| link.connection.as_mut());
        match connection.is_some_and(|connection| connection.cancel(message, address)) {
            true => Cancel::Asked,
            false => Cancel::Impossible,
        }
    }

    pub(super) fn calls_due(&self) -> Option<Instant> {
        let calls = self.calls.values();
        let due = calls.filter_map(|call| match call.stage {
            CallStage::Waiting { until, .. } => Some(until),
            CallStage::Sent { until, .. } => until,
        });
        due.min()
    }

    pub(super) fn calls_timeout(&mut self, now: Instant) {
        let mut ended = Vec::new();
        for (id, call) in self.calls.iter() {
            match &call.stage {
                CallStage::Waiting { until, .. } if *until <= now => {
                    let directory = &self.options.directory;
                    let reason = match (&self.directory.reason, self.directory.ready) {
                        // It begins with the endpoint.
                        (Some(reason), _) => format!("not connected to {reason}"),
                        (None, false) => format!("not connected to {directory}"),
                        (None, true) => format!("{} did not answer in time", call.service),
                    };
                    ended.push((*id, CallError::NotSent(reason)));
                }
                CallStage::Sent {
                    until: Some(until), ..
                } if *until <= now => {
                    let reason = format!("{} was removed", call.service);
                    ended.push((*id, CallError::Unknown(reason)));
                }
                _ => {}
            }
        }
        for (call, error) in ended {
            self.end(call, Err(error));
        }
    }

    /// Sends a call to its service.
    pub(super) fn start(
        &mut self,
        call: CallId,
        link: LinkId,
        service: u32,
        meta: &Arc<MetaObject>,
    ) {
        let Some(pending) = self.calls.get(&call) else {
            return;
        };
        let CallStage::Waiting { method, .. } = &pending.stage else {
            return;
        };
        let Some((method, arguments)) = method else {
            self.calls.remove(&call);
            let result = Ok(Arc::clone(meta));
            self.events.push_back(Event::Described { call, result });
            return;
        };
        let fitted = match meta.fit(&pending.service, method, arguments) {
            Ok(fitted) => fitted,
            Err(error) => return self.end(call, Err(CallError::Arguments(error))),
        };
        let address = Address {
            service,
            object: MAIN,
            action: fitted.method.id,
        };
        let returns = fitted.method.returns.clone();
        match self.ask(link, address, fitted.payload, Pending::Call(call)) {
            Ok(message) => {
                if let Some(pending) = self.calls.get_mut(&call) {
                    pending.stage = CallStage::Sent {
                        link,
                        message,
                        address,
                        returns,
                        until: None,
                    };
                }
            }
            Err(_) => {
                let reason = "too much waits to be sent".to_owned();
                self.end(call, Err(CallError::NotSent(reason)));
            }
        }
    }

    /// A service was removed while calls of it were under way.
    pub(super) fn calls_removed(&mut self, name: &str, id: u32, now: Instant) {
        for call in self.calls.values_mut().filter(|call| call.service == name) {
            if let CallStage::Sent { address, until, .. } = &mut call.stage
                && address.service == id
            {
                *until = now.checked_add(GRACE);
            }
        }
    }

    pub(super) fn on_answer(
        &mut self,
        link: LinkId,
        call: CallId,
        answer: Result<Message, CallError>,
    ) {
        let Some(CallStage::Sent { returns, .. }) = self.calls.get(&call).map(|call| &call.stage)
        else {
            return;
        };
        let limits = &self.options.limits;
        let result = answer.and_then(|message| {
            let value = payload(message.flags, &message.payload, returns, limits);
            value.map_err(CallError::Unreadable)
        });
        if let Ok(value) = &result {
            let mut objects = Vec::new();
            value.for_each_object(&mut |object: &Object| {
                objects.push((object.service, object.object));
            });
            for (service, object) in objects {
                self.release(link, service, object);
            }
        }
        self.end(call, result);
    }

    /// Ends a call, once.
    pub(super) fn end(&mut self, call: CallId, result: Result<Value, CallError>) {
        let Some(pending) = self.calls.remove(&call) else {
            return;
        };
        match pending.stage {
            CallStage::Waiting { method, .. } => {
                if let Some(service) = self.services.get_mut(&pending.service) {
                    service.waiting.retain(|waiting| *waiting != call);
                }
                self.drop_unused(&pending.service);
                if let (None, Err(error)) = (method, &result) {
                    let result = Err(error.clone());
                    self.events.push_back(Event::Described { call, result });
                    return;
                }
            }
            CallStage::Sent { link, message, .. } => {
                // A late answer is ignored.
                if let Some(link) = self.links.get_mut(&link) {
                    link.pending.remove(&message);
                }
            }
        }
        self.events.push_back(Event::Ended { call, result });
    }
}
