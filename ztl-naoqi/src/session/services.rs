//! Services: where they are, and what they say of themselves.

use std::sync::Arc;
use std::time::{Duration, Instant};

use crate::endpoint::reachable;
use crate::message::Message;
use crate::meta_object::MetaObject;
use crate::value::Value;

use super::functions::{META_OBJECT, description, function, value};
use super::pending::Pending;
use super::{CallError, CallId, LinkId, Session};

/// The pause until a service is looked for again, when signals of it are wanted.
const PAUSE: Duration = Duration::from_secs(2);

/// A process of the robot.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Process {
    machine: String,
    id: u32,
}

impl Process {
    /// The process of a service, from its entry in the directory.
    pub(super) fn of(info: &Value) -> Option<Self> {
        Some(Self {
            machine: info.field("machineId", 2)?.as_text()?.to_owned(),
            id: info.field("processId", 3)?.as_u32()?,
        })
    }
}

/// A service that calls or subscriptions use.
#[derive(Debug, Default)]
pub(super) struct Service {
    pub(super) state: ServiceState,
    /// Calls to send once it is ready.
    pub(super) waiting: Vec<CallId>,
    /// When to look for it again.
    retry_at: Option<Instant>,
}

/// How far it is known.
#[derive(Debug, Default)]
pub(super) enum ServiceState {
    #[default]
    Unknown,
    /// The directory was asked where it is.
    Resolving,
    /// The connection to its process is being opened.
    Linking { link: LinkId, id: u32 },
    /// It was asked what it is.
    Describing { link: LinkId, id: u32 },
    /// It takes calls.
    Ready {
        link: LinkId,
        id: u32,
        meta: Arc<MetaObject>,
    },
}

impl ServiceState {
    pub(super) fn link(&self) -> Option<LinkId> {
        match self {
            Self::Unknown | Self::Resolving => None,
            Self::Linking { link, .. }
            | Self::Describing { link, .. }
            | Self::Ready { link, .. } => Some(*link),
        }
    }

    fn id(&self) -> Option<u32> {
        match self {
            Self::Unknown | Self::Resolving => None,
            Self::Linking { id, .. } | Self::Describing { id, .. } | Self::Ready { id, .. } => {
                Some(*id)
            }
        }
    }
}

impl Session {
    pub(super) fn services_due(&self) -> Option<Instant> {
        self.services
            .values()
            .filter_map(|service| service.retry_at)
            .min()
    }

    pub(super) fn services_timeout(&mut self, now: Instant) {
        let due = |service: &Service| service.retry_at.is_some_and(|at| at <= now);
        let services = self.services.iter();
        let due: Vec<String> = services
            .filter(|(_, service)| due(service))
            .map(|(name, _)| name.clone())
            .collect();
        for name in due {
            if let Some(service) = self.services.get_mut(&name) {
                service.retry_at = None;
            }
            self.want(&name);
        }
    }

    /// Finds out about a service that calls or subscriptions wait for, and goes on with them.
    pub(super) fn want(&mut self, name: &str) {
        match self.services.get_or_default(name).state {
            ServiceState::Unknown => {
                if self.resolve(name)
                    && let Some(service) = self.services.get_mut(name)
                {
                    service.state = ServiceState::Resolving;
                }
            }
            ServiceState::Ready { .. } => self.on_service_ready(name),
            _ => {}
        }
    }

    /// As [`want`](Self::want), for all services.
    pub(super) fn want_all(&mut self) {
        let names: Vec<String> = self.services.keys().cloned().collect();
        for name in names {
            self.want(&name);
        }
    }

    /// The directory has told where a service is.
    pub(super) fn on_resolved(
        &mut self,
        name: String,
        answer: Result<Message, CallError>,
        now: Instant,
    ) {
        let is_resolving = |service: &Service| matches!(service.state, ServiceState::Resolving);
        if !self.services.get(&name).is_some_and(is_resolving) {
            return;
        }
        if let Err(CallError::Failed(_)) = answer {
            let reason = format!("no service {name} at {}", self.options.directory);
            return self.unavailable(&name, &reason, now);
        }
        let info = value(answer, self.service_info(), &self.options.limits);
        let linked = info.and_then(|info| self.link_to(&name, &info, now));
        match linked {
            Ok(ServiceState::Linking { link, id }) => {
                if let Some(service) = self.services.get_mut(&name) {
                    service.state = ServiceState::Linking { link, id };
                }
                if self.links.get(&link).is_some_and(|link| link.ready) {
                    self.describe_waiting(link, now);
                }
            }
            Ok(_) => {}
            Err(reason) => self.unavailable(&name, &reason, now),
        }
    }

    /// The connection to a service's process: an open one, or a new one.
    fn link_to(&mut self, name: &str, info: &Value, now: Instant) -> Result<ServiceState, String> {
        let unreadable = || format!("the directory's answer about {name} cannot be read");
        let id = info.field("serviceId", 1).and_then(Value::as_u32);
        let id = id.ok_or_else(unreadable)?;
        let process = Process::of(info).ok_or_else(unreadable)?;
        let endpoints = info.field("endpoints", 4).and_then(Value::as_list);
        let endpoints = endpoints.ok_or_else(unreadable)?;
        let endpoints: Vec<&str> = endpoints.iter().filter_map(Value::as_text).collect();
        let same = |link: &super::Link| link.process.as_ref() == Some(&process);
        let open = self.links.iter().find(|(_, link)| same(link));
        if let Some((link, _)) = open {
            return Ok(ServiceState::Linking { link: *link, id });
        }
        let candidates = reachable(&endpoints, &self.directory.reached);
        if candidates.is_empty() {
            let all = endpoints.join(", ");
            return Err(format!(
                "{name} cannot be reached from here: it listens at {all}"
            ));
        }
        let link = self.open(candidates.into(), Some(process), Vec::new(), now)?;
        Ok(ServiceState::Linking { link, id })
    }

    /// Another endpoint of the process is tried.
    pub(super) fn relink(&mut self, from: LinkId, to: LinkId) {
        for service in self.services.values_mut() {
            if let ServiceState::Linking { link, .. } = &mut service.state
                && *link == from
            {
                *link = to;
            }
        }
    }

    /// A connection is ready: asks the services behind it what they are.
    pub(super) fn describe_waiting(&mut self, link: LinkId, now: Instant) {
        let linking = |service: &Service| match service.state {
            ServiceState::Linking { link: other, id } if other == link => Some(id),
            _ => None,
        };
        let services = self.services.iter();
        let waiting: Vec<(String, u32)> = services
            .filter_map(|(name, service)| Some((name.clone(), linking(service)?)))
            .collect();
        for (name, id) in waiting {
            let address = function(id, META_OBJECT);
            let pending = Pending::Description(name.clone());
            match self.ask(link, address, vec![0; 4], pending) {
                Ok(_) => {
                    if let Some(service) = self.services.get_mut(&name) {
                        service.state = ServiceState::Describing { link, id };
                    }
                }
                Err(_) => self.unavailable(&name, "too much waits to be sent", now),
            }
        }
    }

    /// The description of a service has arrived.
    pub(super) fn on_description(
        &mut self,
        link: LinkId,
        name: &str,
        answer: Result<Message, CallError>,
        now: Instant,
    ) {
        let Some(service) = self.services.get_mut(name) else {
            return;
        };
        let ServiceState::Describing { link: asked, id } = service.state else {
            return;
        };
        if asked != link {
            return;
        }
        match description(answer, &self.options.limits) {
            Ok(meta) => {
                let meta = Arc::new(meta);
                service.state = ServiceState::Ready { link, id, meta };
                self.on_service_ready(name);
            }
            Err(reason) => self.unavailable(name, &format!("{name}: {reason}"), now),
        }
    }

    fn on_service_ready(&mut self, name: &str) {
        let Some(service) = self.services.get_mut(name) else {
            return;
        };
        let ServiceState::Ready { link, id, meta } = &service.state else {
            return;
        };
        let (link, id, meta) = (*link, *id, Arc::clone(meta));
        service.retry_at = None;
        for call in std::mem::take(&mut service.waiting) {
            self.start(call, link, id, &meta);
        }
        self.begin_subscriptions(name, link, id, &meta);
    }

    /// A service cannot be used now: ends the calls that wait for it.
    fn unavailable(&mut self, name: &str, reason: &str, now: Instant) {
        let Some(mut service) = self.services.remove(name) else {
            return;
        };
        for call in std::mem::take(&mut service.waiting) {
            self.end(call, Err(CallError::NotSent(reason.to_owned())));
        }
        if self.end_subscriptions(name, reason) {
            service.state = ServiceState::Unknown;
            service.retry_at = now.checked_add(PAUSE);
            self.services.insert(name.to_owned(), service);
        }
    }

    /// A connection was lost.
    pub(super) fn services_lost(&mut self, link: LinkId, reason: &str, now: Instant) {
        let services = self.services.iter();
        let lost: Vec<String> = services
            .filter(|(_, service)| service.state.link() == Some(link))
            .map(|(name, _)| name.clone())
            .collect();
        for name in lost {
            self.unavailable(&name, reason, now);
        }
    }

    /// The directory is lost: its numbers for services mean nothing any more.
    pub(super) fn forget_services(&mut self) {
        let services = self.services.iter();
        let names: Vec<String> = services
            .filter(|(_, service)| !matches!(service.state, ServiceState::Unknown))
            .map(|(name, _)| name.clone())
            .collect();
        for name in names {
            self.forget(&name, "the service directory was lost");
        }
    }

    pub(super) fn on_added(&mut self, name: &str, id: u32) {
        let Some(service) = self.services.get(name) else {
            return;
        };
        if service.state.id().is_some_and(|other| other != id) {
            self.forget(name, "it was registered again");
        }
        if self.services.contains_key(name) {
            self.want(name);
        }
    }

    pub(super) fn on_removed(&mut self, name: &str, id: u32, now: Instant) {
        self.calls_removed(name, id, now);
        let state = self.services.get(name).map(|service| &service.state);
        if state.is_some_and(|state| state.id() == Some(id)) {
            self.forget(name, "the service was removed");
        }
    }

    /// A service is not where it was. Calls that were not sent wait until it is found again, or their time is over.
    fn forget(&mut self, name: &str, reason: &str) {
        if let Some(service) = self.services.get_mut(name) {
            service.state = ServiceState::Unknown;
            service.retry_at = None;
        }
        if !self.end_subscriptions(name, reason) {
            self.drop_unused(name);
        }
    }

    /// Forgets a service that nothing waits for.
    pub(super) fn drop_unused(&mut self, name: &str) {
        let unused = |service: &Service| {
            service.waiting.is_empty() && matches!(service.state, ServiceState::Unknown)
        };
        if self.services.get(name).is_some_and(unused) && !self.is_subscribed(name) {
            self.services.remove(name);
        }
    }
}
