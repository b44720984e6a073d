//! Subscriptions, kept up while services come and go; and the queue of signals, which drops the oldest.

use crate::connection::payload;
use crate::message::{Address, Message};
use crate::meta_object::MetaObject;
use crate::value::Value;

use super::functions::{MAIN, REGISTER_EVENT, UNREGISTER_EVENT, registration, value};
use super::pending::Pending;
use super::{CallError, Event, LinkId, Session, SignalOf, SubscriptionId};

/// A wish for a signal.
#[derive(Debug)]
pub(super) struct Subscription {
    of: SignalOf,
    pub(super) stage: Stage,
    /// Whether it was told that signals do not arrive.
    told: bool,
    /// How many signals were dropped since the last.
    dropped: u64,
}

#[derive(Debug)]
pub(super) enum Stage {
    /// For the service.
    Waiting,
    /// For the object that has the signal.
    Asking { link: LinkId },
    /// The service was asked to send signals, under this handle.
    Active {
        link: LinkId,
        address: Address,
        handle: u64,
        signature: String,
    },
}

impl Subscription {
    pub(super) const fn new(of: SignalOf) -> Self {
        Self {
            of,
            stage: Stage::Waiting,
            told: false,
            dropped: 0,
        }
    }
}

/// A signal to be decoded when it is polled.
#[derive(Debug)]
pub(super) struct QueuedSignal {
    subscription: SubscriptionId,
    flags: u8,
    payload: Vec<u8>,
    signature: String,
}

impl Session {
    /// Ends a subscription. Signals of it that wait are dropped.
    pub fn unsubscribe(&mut self, id: SubscriptionId) {
        if let Some(subscription) = self.subscriptions.remove(&id) {
            self.stop(&subscription.stage);
            self.signals.retain(|signal| signal.subscription != id);
            self.signal_bytes = self.signals.iter().map(|signal| signal.payload.len()).sum();
        }
    }

    /// Asks a service that is ready for the signals that are wanted of it.
    pub(super) fn begin_subscriptions(
        &mut self,
        service: &str,
        link: LinkId,
        id: u32,
        meta: &MetaObject,
    ) {
        let wanted: Vec<(SubscriptionId, SignalOf)> = self
            .subscriptions
            .iter()
            .filter(|(_, subscription)| {
                subscription.of.service == service && matches!(subscription.stage, Stage::Waiting)
            })
            .map(|(id, subscription)| (*id, subscription.of.clone()))
            .collect();
        for (subscription, of) in wanted {
            let begun = match &of.object {
                None => self.register(subscription, link, id, MAIN, meta, &of),
                Some((method, arguments)) => meta
                    .fit(service, method, arguments)
                    .map_err(|error| error.to_string())
                    .and_then(|fitted| {
                        let address = Address {
                            service: id,
                            object: MAIN,
                            action: fitted.method.id,
                        };
                        let returns = fitted.method.returns.clone();
                        let pending = Pending::SignalObject(subscription, returns);
                        let asked = self.ask(link, address, fitted.payload, pending);
                        asked.map_err(|_| "too much waits to be sent".to_owned())
                    })
                    .map(|_| {
                        if let Some(wish) = self.subscriptions.get_mut(&subscription) {
                            wish.stage = Stage::Asking { link };
                        }
                    }),
            };
            if let Err(reason) = begun {
                self.not_subscribed(subscription, &reason);
            }
        }
    }

    /// The object that has a signal was returned.
    pub(super) fn on_signal_object(
        &mut self,
        link: LinkId,
        id: SubscriptionId,
        returns: &str,
        answer: Result<Message, CallError>,
    ) {
        let object = match value(answer, returns, &self.options.limits) {
            Ok(Value::Object(object)) => object,
            Ok(_) => return self.not_subscribed(id, "the method returns no object"),
            Err(reason) => return self.not_subscribed(id, &reason),
        };
        let wish = self.subscriptions.get(&id);
        // It may have been given up meanwhile.
        let is_asking = |wish: &&Subscription| matches!(wish.stage, Stage::Asking { link: other } if other == link);
        let Some(of) = wish.filter(is_asking).map(|wish| wish.of.clone()) else {
            return self.release(link, object.service, object.object);
        };
        let (service, number) = (object.service, object.object);
        if let Err(reason) = self.register(id, link, service, number, &object.meta, &of) {
            self.release(link, service, number);
            self.not_subscribed(id, &reason);
        }
    }

    fn register(
        &mut self,
        id: SubscriptionId,
        link: LinkId,
        service: u32,
        object: u32,
        meta: &MetaObject,
        of: &SignalOf,
    ) -> Result<(), String> {
        let signal = meta
            .signal(&of.signal)
            .ok_or_else(|| format!("{} has no signal {}", of.service, of.signal))?;
        let address = Address {
            service,
            object,
            action: signal.id,
        };
        // The robot sends a signal once for each registration, and does not say for which.
        let shared = self
            .subscriptions
            .values()
            .find_map(|other| match &other.stage {
                Stage::Active {
                    link: other_link,
                    address: other_address,
                    handle,
                    ..
                } if *other_link == link && *other_address == address => Some(*handle),
                _ => None,
            });
        let handle = match shared {
            Some(handle) => {
                if let Some(wish) = self.subscriptions.get_mut(&id) {
                    wish.told = false;
                }
                self.events.push_back(Event::Subscribed(id));
                handle
            }
            None => {
                let handle = self.new_id();
                let call = Address {
                    action: REGISTER_EVENT,
                    ..address
                };
                let arguments = registration(service, signal.id, handle);
                let asked = self.ask(link, call, arguments, Pending::Registered(id, handle));
                asked.map_err(|_| "too much waits to be sent".to_owned())?;
                handle
            }
        };
        if let Some(wish) = self.subscriptions.get_mut(&id) {
            wish.stage = Stage::Active {
                link,
                address,
                handle,
                signature: signal.signature.clone(),
            };
        }
        Ok(())
    }

    pub(super) fn on_registered(
        &mut self,
        id: SubscriptionId,
        registered: u64,
        answer: Result<Message, CallError>,
    ) {
        let Some(wish) = self.subscriptions.get_mut(&id) else {
            return;
        };
        // It may have been registered elsewhere meanwhile.
        if !matches!(wish.stage, Stage::Active { handle, .. } if handle == registered) {
            return;
        }
        if let Err(error) = answer {
            let stage = std::mem::replace(&mut wish.stage, Stage::Waiting);
            self.stop(&stage);
            return self.not_subscribed(id, &error.to_string());
        }
        wish.told = false;
        self.events.push_back(Event::Subscribed(id));
    }

    /// A signal has arrived.
    pub(super) fn on_signal(&mut self, link: LinkId, message: Message) {
        let Message {
            flags,
            address,
            payload,
            ..
        } = message;
        let mut queued = Vec::new();
        for (id, subscription) in self.subscriptions.iter() {
            if let Stage::Active {
                link: other,
                address: of,
                signature,
                ..
            } = &subscription.stage
                && *other == link
                && *of == address
            {
                queued.push((*id, signature.clone()));
            }
        }
        for (subscription, signature) in queued {
            self.signal_bytes = self.signal_bytes.saturating_add(payload.len());
            self.signals.push_back(QueuedSignal {
                subscription,
                flags,
                payload: payload.clone(),
                signature,
            });
        }
        let limits = self.options.limits;
        while self.signals.len() > limits.signals || self.signal_bytes > limits.signal_bytes {
            let Some(dropped) = self.signals.pop_front() else {
                break;
            };
            self.signal_bytes = self.signal_bytes.saturating_sub(dropped.payload.len());
            if let Some(subscription) = self.subscriptions.get_mut(&dropped.subscription) {
                subscription.dropped = subscription.dropped.saturating_add(1);
            }
        }
    }

    pub(super) fn next_signal(&mut self) -> Option<Event> {
        let signal = self.signals.pop_front()?;
        self.signal_bytes = self.signal_bytes.saturating_sub(signal.payload.len());
        let subscription = self.subscriptions.get_mut(&signal.subscription);
        let dropped = subscription.map_or(0, |wish| std::mem::take(&mut wish.dropped));
        let limits = &self.options.limits;
        Some(Event::Signal {
            subscription: signal.subscription,
            values: payload(signal.flags, &signal.payload, &signal.signature, limits),
            dropped,
        })
    }

    /// The service of subscriptions cannot be used now. False if nobody subscribes to its signals.
    pub(super) fn end_subscriptions(&mut self, service: &str, reason: &str) -> bool {
        let subscriptions = self.subscriptions.iter();
        let wanted: Vec<SubscriptionId> = subscriptions
            .filter(|(_, subscription)| subscription.of.service == service)
            .map(|(id, _)| *id)
            .collect();
        for id in &wanted {
            if let Some(subscription) = self.subscriptions.get_mut(id) {
                let stage = std::mem::replace(&mut subscription.stage, Stage::Waiting);
                self.stop(&stage);
            }
            self.not_subscribed(*id, reason);
        }
        !wanted.is_empty()
    }

    pub(super) fn is_subscribed(&self, service: &str) -> bool {
        let mut wishes = self.subscriptions.values();
        wishes.any(|wish| wish.of.service == service)
    }

    fn not_subscribed(&mut self, id: SubscriptionId, reason: &str) {
        let Some(wish) = self.subscriptions.get_mut(&id) else {
            return;
        };
        wish.stage = Stage::Waiting;
        // Each attempt fails for the same reason.
        if !std::mem::replace(&mut wish.told, true) {
            self.events.push_back(Event::Unsubscribed {
                subscription: id,
                reason: reason.to_owned(),
            });
        }
    }

    /// Asks the robot to stop sending signals, unless another subscription needs them.
    fn stop(&mut self, stage: &Stage) {
        let Stage::Active {
            link,
            address,
            handle,
            ..
        } = stage
        else {
            return;
        };
        let is_shared = self.subscriptions.values().any(|other| {
            matches!(&other.stage, Stage::Active { handle: shared, .. } if shared == handle)
        });
        if is_shared {
            return;
        }
        let call = Address {
            action: UNREGISTER_EVENT,
            ..*address
        };
        // libqi ignores this request as a post. A peer that does not read it keeps sending; signals without a subscription are ignored.
        let arguments = registration(address.service, address.action, *handle);
        let _ = self.ask(*link, call, arguments, Pending::Ignored);
        if address.object != MAIN {
            self.release(*link, address.service, address.object);
        }
    }
}
