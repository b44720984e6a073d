//! Whose record the server may evict, as its clients' requests show (`docs/protocol.md`, 9.5).

use ztl_core::dispatcher::{Body, KEEP_INIT};
use ztl_core::envelope::{ClientId, Envelope};
use ztl_core::integer::Integer;
use ztl_core::{Instant, Message, Request};

use super::questions::plain;
use super::state::{First, LastInit, Model, SCOPES};

impl Model {
    pub(in crate::dispatcher) fn is_impossible(
        &self,
        (envelope, _): (Envelope, u64),
        body: Body<'_>,
    ) -> bool {
        let Body::One(bytes) = body else {
            return false;
        };
        let Ok(message) = Message::parse(bytes) else {
            return false;
        };
        // Nor does a client ask about an INIT that it has not sent.
        let ahead = self.about(envelope, message);
        let ahead = ahead.is_some_and(|(_, number)| number > envelope.number);
        ahead || !is_init(message) && self.places.is_impossible(envelope)
    }

    /// The client and number of the INIT that a request is or asks about.
    pub(super) fn about(
        &self,
        envelope: Envelope,
        message: Message<'_>,
    ) -> Option<(ClientId, u64)> {
        let client = envelope.client;
        if message.scope == "$ztl" {
            let number = message.payload.strip_prefix("outcome ")?;
            let number = Integer::parse(number).ok()?.value()?;
            return Some((client, u64::try_from(number).ok()?));
        }
        let asked = is_init(message) && SCOPES.contains(&message.scope);
        asked.then_some((client, envelope.number))
    }

    /// A client asks about a task: if its last INIT started it, the client has the reply.
    pub(super) fn on_asked_about(&mut self, envelope: Envelope, message: Message<'_>) {
        let (Some(Request::Status | Request::Abort), Ok(id)) = (request(message), message.number())
        else {
            return;
        };
        if let Some(last) = self.inits.get_mut(&envelope.client)
            && let First::Started(task) = last.first
            && SCOPES.contains(&message.scope)
        {
            last.received |= self.tasks[task].id.to_string() == plain(id);
        }
    }

    /// Whether the server may evict the record early.
    pub(super) fn is_released(&self, init: &LastInit) -> bool {
        match init.first {
            // Its client has the reply, or the INIT was rejected.
            First::Started(task) => {
                let refused = self.tasks[task].refused.is_some();
                init.until.is_some() && (init.received || refused)
            }
            First::Refused(_) | First::Void => true,
        }
    }

    /// Another client's INIT needs a record, so another record may be evicted.
    pub(super) fn make_room(&mut self, client: ClientId) {
        let released = self
            .inits
            .iter()
            .filter(|(other, init)| **other != client && self.is_released(init));
        let until = released.filter_map(|(_, init)| init.until).max();
        let known = self.inits.contains_key(&client) && self.places.until.is_none();
        if !known && self.inits.len() >= self.limits.held {
            self.places.until = self.places.until.max(until);
        }
    }

    /// A client is told that there is no room for its INIT.
    pub(super) fn assert_no_place(&mut self, now: Instant, ask: usize) {
        let ask = &self.asks[ask];
        let client = ask.envelope.expect("only our clients need a place").client;
        let forgot = self.places.until.is_some_and(|until| now < until) && !ask.surely_new;
        let last = self.inits.get(&client);
        assert!(
            last.is_none_or(|last| self.is_released(last)),
            "it has a place: {ask:?}"
        );
        let all_needed = self.needed(client) == self.limits.held;
        assert!(
            forgot || all_needed,
            "there is a place, and its INIT is new: {ask:?}"
        );
        // The INIT may arrive again once there is room, or for the first time if it was to be given up.
        self.places.until = self.places.until.max(Some(now + KEEP_INIT));
    }

    /// How many records of other clients must be kept.
    fn needed(&self, client: ClientId) -> usize {
        let others = self.inits.iter().filter(|(other, _)| **other != client);
        others.filter(|(_, init)| !self.is_released(init)).count()
    }
}

fn request(message: Message<'_>) -> Option<Request> {
    Request::from_code(message.code().ok()?.value()?)
}

pub(super) fn is_init(message: Message<'_>) -> bool {
    request(message) == Some(Request::Init)
}
