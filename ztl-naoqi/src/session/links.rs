//! Connections: from the first endpoint that is tried to the loss of the connection.

use std::collections::VecDeque;
use std::net::IpAddr;
use std::time::{Duration, Instant};

use crate::connection::{Connection, Happened, OutputFull, error_text};
use crate::endpoint::Endpoint;
use crate::message::{Address, Kind, Message};
use crate::table::Table;

use super::pending::Pending;
use super::services::{Process, ServiceState};
use super::signals::Stage;
use super::{Action, CallError, Event, LinkId, Session};

/// How long a connection and its handshake may take.
const OPENING: Duration = Duration::from_secs(4);
/// After this time without a message, the peer is asked whether it is there.
const QUIET: Duration = Duration::from_secs(5);
/// How long its answer may take.
const PROBE: Duration = Duration::from_secs(5);
/// The most answers that are awaited on a connection; the calls under way are fewer.
const MOST_PENDING: usize = 8192;
/// The function that lists the names of properties, which libqi answers without asking the object.
const PROPERTIES: u32 = 7;

/// A connection.
#[derive(Debug)]
pub(super) struct Link {
    pub(super) endpoint: Endpoint,
    /// Where else the process listens.
    others: VecDeque<Endpoint>,
    /// Where the process could not be reached, and why.
    failures: Vec<String>,
    pub(super) process: Option<Process>,
    /// None while it is being opened.
    pub(super) connection: Option<Connection>,
    pub(super) ready: bool,
    opened: Instant,
    heard: Instant,
    probed: Option<Instant>,
    pub(super) pending: Table<u32, Pending>,
}

impl Session {
    /// A connection was opened, to this address.
    pub fn handle_connected(&mut self, link: LinkId, peer: IpAddr, now: Instant) {
        if self.directory.link == Some(link) {
            self.directory.reached.host = peer.to_canonical().to_string();
        }
        let credentials = self.options.credentials.clone();
        let limits = self.options.limits;
        if let Some(link) = self.links.get_mut(&link) {
            link.connection = Some(Connection::new(credentials, limits));
            link.heard = now;
        }
    }

    /// Bytes have arrived. Their work is bounded by their number, except that the last byte of a message decodes it.
    pub fn handle_bytes(&mut self, id: LinkId, bytes: &[u8], now: Instant) {
        if let Some(link) = self.links.get_mut(&id) {
            link.heard = now;
            link.probed = None;
            if let Some(connection) = &mut link.connection {
                connection.handle_input(bytes);
            }
        }
        loop {
            let link = self.links.get_mut(&id);
            let Some(connection) = link.and_then(|link| link.connection.as_mut()) else {
                break;
            };
            match connection.poll() {
                Ok(Some(Happened::Ready)) => self.on_ready(id, now),
                Ok(Some(Happened::NewToken(token))) => self.on_new_token(token),
                Ok(Some(Happened::Message(message))) => self.on_message(id, message, now),
                Ok(None) => break,
                Err(reason) => {
                    self.actions.push_back(Action::Close(id));
                    self.on_lost(id, &reason, now);
                }
            }
        }
        self.close_unused();
    }

    /// A connection could not be opened, or was closed.
    pub fn handle_closed(&mut self, id: LinkId, reason: &str, now: Instant) {
        self.on_lost(id, reason, now);
        self.close_unused();
    }

    /// When to call [`handle_timeout`](Self::handle_timeout) next.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Instant> {
        let links = self
            .links
            .iter()
            .map(|(id, link)| link.due(self.can_probe(*id)));
        let others = [self.directory_due(), self.services_due(), self.calls_due()];
        links.chain(others.into_iter().flatten()).min()
    }

    /// Does what is due.
    pub fn handle_timeout(&mut self, now: Instant) {
        let ids: Vec<LinkId> = self.links.keys().copied().collect();
        for id in ids {
            let can_probe = self.can_probe(id);
            let Some(link) = self.links.get_mut(&id) else {
                continue;
            };
            if link.due(can_probe) > now {
                continue;
            }
            let target = self.probe_target(id);
            let Some(link) = self.links.get_mut(&id) else {
                continue;
            };
            match (link.ready, link.probed, target) {
                (true, None, Some(target)) => {
                    link.probed = Some(now);
                    // A peer that takes nothing is not there.
                    let _ = self.ask(id, target, Vec::new(), Pending::Ignored);
                }
                (ready, _, _) => {
                    let reason = match ready {
                        true => "it does not answer",
                        false => "no answer in time",
                    };
                    self.actions.push_back(Action::Close(id));
                    self.on_lost(id, reason, now);
                }
            }
        }
        self.directory_timeout(now);
        self.services_timeout(now);
        self.calls_timeout(now);
        self.close_unused();
    }

    /// Opens a connection to the first of these endpoints.
    pub(super) fn open(
        &mut self,
        mut endpoints: VecDeque<Endpoint>,
        process: Option<Process>,
        failures: Vec<String>,
        now: Instant,
    ) -> Result<LinkId, String> {
        if self.links.len() >= self.options.limits.connections {
            return Err("too many connections".to_owned());
        }
        let Some(endpoint) = endpoints.pop_front() else {
            return Err(failures.join("; "));
        };
        let id = LinkId(self.new_id());
        self.actions
            .push_back(Action::Connect(id, endpoint.clone()));
        let link = Link {
            endpoint,
            others: endpoints,
            failures,
            process,
            connection: None,
            ready: false,
            opened: now,
            heard: now,
            probed: None,
            pending: Table::default(),
        };
        self.links.insert(id, link);
        Ok(id)
    }

    /// Sends a call whose answer is for `pending`.
    pub(super) fn ask(
        &mut self,
        link: LinkId,
        address: Address,
        payload: Vec<u8>,
        pending: Pending,
    ) -> Result<u32, OutputFull> {
        let link = self.links.get_mut(&link).ok_or(OutputFull)?;
        let connection = link.connection.as_mut().ok_or(OutputFull)?;
        // A peer that never answers must not take memory for what is asked.
        if link.pending.len() >= MOST_PENDING {
            return Err(OutputFull);
        }
        let id = connection.send(Kind::Call, address, payload)?;
        link.pending.insert(id, pending);
        Ok(id)
    }

    /// Has an object that a method has returned be freed.
    pub(super) fn release(&mut self, link: LinkId, service: u32, object: u32) {
        let connection = self
            .links
            .get_mut(&link)
            .and_then(|link| link.connection.as_mut());
        if let Some(connection) = connection {
            let address = Address {
                service,
                object,
                action: 3,
            };
            // A peer that takes nothing keeps its objects until the connection is closed.
            let _ = connection.send(Kind::Post, address, service.to_le_bytes().to_vec());
        }
    }

    fn on_new_token(&mut self, token: String) {
        if let Some(credentials) = &mut self.options.credentials {
            credentials.token.clone_from(&token);
        }
        self.events.push_back(Event::NewToken(token));
    }

    fn on_ready(&mut self, id: LinkId, now: Instant) {
        if let Some(link) = self.links.get_mut(&id) {
            link.ready = true;
        }
        if self.directory.link == Some(id) {
            self.directory_ready(id, now);
        }
        self.describe_waiting(id, now);
    }

    fn on_message(&mut self, id: LinkId, message: Message, now: Instant) {
        if message.kind == Kind::Event {
            if self.directory.link == Some(id) && message.address.service == 1 {
                self.directory_signal(&message, now);
            }
            self.on_signal(id, message);
            return;
        }
        if !matches!(message.kind, Kind::Reply | Kind::Error | Kind::Canceled) {
            return;
        }
        let pending = self
            .links
            .get_mut(&id)
            .and_then(|link| link.pending.remove(&message.id));
        let Some(pending) = pending else {
            return;
        };
        let limits = &self.options.limits;
        let answer = match message.kind {
            Kind::Reply => Ok(message),
            Kind::Canceled => Err(CallError::Canceled),
            _ => Err(CallError::Failed(error_text(&message, limits))),
        };
        match pending {
            Pending::Ignored => {}
            Pending::DirectoryDescription => self.on_directory_description(id, answer, now),
            Pending::DirectoryServices => self.on_directory_services(id, answer, now),
            Pending::Resolved(service) => self.on_resolved(service, answer, now),
            Pending::Description(service) => self.on_description(id, &service, answer, now),
            Pending::Call(call) => self.on_answer(id, call, answer),
            Pending::SignalObject(subscription, returns) => {
                self.on_signal_object(id, subscription, &returns, answer);
            }
            Pending::Registered(subscription, handle) => {
                self.on_registered(subscription, handle, answer);
            }
        }
    }

    /// The connection is of no use any more: tries the next endpoint, or ends what depends on it.
    pub(super) fn on_lost(&mut self, id: LinkId, reason: &str, now: Instant) {
        let Some(mut link) = self.links.remove(&id) else {
            return;
        };
        let refused = link.connection.as_ref().and_then(Connection::refused);
        let reason = match refused {
            Some(refused) => format!("{}: {reason} after: {refused}", link.endpoint),
            None => format!("{}: {reason}", link.endpoint),
        };
        if !link.ready {
            link.failures.push(reason.clone());
            if !link.others.is_empty() {
                if let Ok(next) = self.open(link.others, link.process, link.failures, now) {
                    self.relink(id, next);
                    return;
                }
            } else if link.failures.len() > 1 {
                return self.end_link(id, &link.failures.join("; "), link.pending, now);
            }
        }
        self.end_link(id, &reason, link.pending, now);
    }

    fn end_link(&mut self, id: LinkId, reason: &str, pending: Table<u32, Pending>, now: Instant) {
        for pending in pending.into_values() {
            if let Pending::Call(call) = pending {
                let reason = format!("the connection was lost: {reason}");
                self.end(call, Err(CallError::Unknown(reason)));
            }
        }
        let is_directory = self.directory.link == Some(id);
        if is_directory {
            self.directory_lost(reason, now);
        }
        self.services_lost(id, reason, now);
    }

    /// Closes connections that nothing depends on.
    fn close_unused(&mut self) {
        let is_used = |id: &LinkId, link: &Link| {
            let by_service = |service: &super::Service| service.state.link() == Some(*id);
            let by_signal = |subscription: &super::Subscription| match &subscription.stage {
                Stage::Waiting => false,
                Stage::Asking { link } | Stage::Active { link, .. } => link == id,
            };
            self.directory.link == Some(*id)
                || !link.pending.is_empty()
                || self.services.values().any(by_service)
                || self.subscriptions.values().any(by_signal)
        };
        let links = self.links.iter();
        let unused: Vec<LinkId> = links
            .filter(|(id, link)| !is_used(id, link))
            .map(|(id, _)| *id)
            .collect();
        for id in unused {
            self.links.remove(&id);
            self.actions.push_back(Action::Close(id));
        }
    }

    /// The object to ask whether the peer is alive.
    fn probe_target(&self, id: LinkId) -> Option<Address> {
        let service = match self.directory.link == Some(id) {
            true => Some(1),
            false => self
                .services
                .values()
                .find_map(|service| match service.state {
                    ServiceState::Ready {
                        link, id: number, ..
                    } if link == id => Some(number),
                    _ => None,
                }),
        };
        service.map(|service| Address {
            service,
            object: 1,
            action: PROPERTIES,
        })
    }

    fn can_probe(&self, id: LinkId) -> bool {
        self.probe_target(id).is_some()
    }
}

impl Link {
    /// When it must be ready, be asked, or have answered.
    fn due(&self, can_probe: bool) -> Instant {
        // Beyond what an `Instant` can count only on a broken clock.
        let after = |from: Instant, wait| from.checked_add(wait).unwrap_or(from);
        match (self.ready, self.probed) {
            (false, _) => after(self.opened, OPENING),
            (true, Some(probed)) => after(probed, PROBE),
            (true, None) if can_probe => after(self.heard, QUIET),
            // Nothing can be asked: calls of a service that is gone end by themselves.
            (true, None) => after(self.heard, Duration::from_secs(24 * 3600)),
        }
    }
}
