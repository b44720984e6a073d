//! The service directory: which services there are.

use std::time::{Duration, Instant};

use crate::connection::payload;
use crate::endpoint::Endpoint;
use crate::message::Message;
use crate::meta_object::MetaObject;
use crate::value::Value;

use super::functions::{META_OBJECT, REGISTER_EVENT, description, function, registration, value};
use super::pending::Pending;
use super::services::Process;
use super::{Action, CallError, Event, LinkId, Session};

/// The first and the longest pause between two attempts.
const FIRST_PAUSE: Duration = Duration::from_millis(250);
const LONGEST_PAUSE: Duration = Duration::from_secs(4);

/// The longest name of a service that is kept, in bytes.
const LONGEST_NAME: usize = 256;

/// The number of the directory's own service.
const DIRECTORY: u32 = 1;

/// The state of the directory.
#[derive(Debug)]
pub(super) struct Directory {
    pub(super) link: Option<LinkId>,
    /// Where it was reached: with an address in place of its name.
    pub(super) reached: Endpoint,
    /// Whether it has listed its services.
    pub(super) ready: bool,
    /// When to connect, without a link.
    retry_at: Instant,
    pause: Duration,
    /// Why it was not reached the last time.
    pub(super) reason: Option<String>,
    functions: Functions,
    pub(super) process: Option<Process>,
}

/// The numbers and signatures of what is used of it. They differ between versions of libqi.
#[derive(Debug, Default)]
struct Functions {
    service: (u32, String),
    services: (u32, String),
    added: (u32, String),
    removed: (u32, String),
}

impl Directory {
    pub(super) fn new(reached: Endpoint, now: Instant) -> Self {
        Self {
            link: None,
            reached,
            ready: false,
            retry_at: now,
            pause: FIRST_PAUSE,
            reason: None,
            functions: Functions::default(),
            process: None,
        }
    }
}

impl Session {
    pub(super) fn directory_due(&self) -> Option<Instant> {
        let directory = &self.directory;
        directory.link.is_none().then_some(directory.retry_at)
    }

    pub(super) fn directory_timeout(&mut self, now: Instant) {
        if self.directory_due().is_some_and(|at| at <= now) {
            let endpoint = self.options.directory.clone();
            match self.open([endpoint].into(), None, Vec::new(), now) {
                Ok(link) => self.directory.link = Some(link),
                Err(reason) => self.directory_lost(&reason, now),
            }
        }
    }

    /// The handshake is done.
    pub(super) fn directory_ready(&mut self, link: LinkId, now: Instant) {
        let address = function(DIRECTORY, META_OBJECT);
        let payload = vec![0; 4];
        if self
            .ask(link, address, payload, Pending::DirectoryDescription)
            .is_err()
        {
            self.close_directory("it takes no calls", now);
        }
    }

    pub(super) fn on_directory_description(
        &mut self,
        link: LinkId,
        answer: Result<Message, CallError>,
        now: Instant,
    ) {
        let limits = &self.options.limits;
        let functions = description(answer, limits).and_then(|meta| Functions::of(&meta));
        let functions = match functions {
            Ok(functions) => functions,
            Err(reason) => return self.close_directory(&reason, now),
        };
        let mut sent = Vec::new();
        for (signal, _) in [&functions.added, &functions.removed] {
            let handle = self.new_id();
            let payload = registration(DIRECTORY, *signal, handle);
            let address = function(DIRECTORY, REGISTER_EVENT);
            sent.push(self.ask(link, address, payload, Pending::Ignored).is_ok());
        }
        let address = function(DIRECTORY, functions.services.0);
        let asked = self.ask(link, address, Vec::new(), Pending::DirectoryServices);
        sent.push(asked.is_ok());
        self.directory.functions = functions;
        if sent.contains(&false) {
            self.close_directory("it takes no calls", now);
        }
    }

    pub(super) fn on_directory_services(
        &mut self,
        link: LinkId,
        answer: Result<Message, CallError>,
        now: Instant,
    ) {
        let signature = &self.directory.functions.services.1;
        let list = value(answer, signature, &self.options.limits);
        let list = list.map(|list| list.as_list().map(<[Value]>::to_vec));
        let list = match list {
            Ok(Some(list)) => list,
            Ok(None) => return self.close_directory("it lists no services", now),
            Err(reason) => return self.close_directory(&reason, now),
        };
        for info in &list {
            let name = info.field("name", 0).and_then(Value::as_text);
            let id = info.field("serviceId", 1).and_then(Value::as_u32);
            if let (Some(name), Some(id)) = (name, id) {
                self.learn_name(name, id);
                if id == DIRECTORY {
                    self.directory.process = Process::of(info);
                }
            }
        }
        if let Some(link) = self.links.get_mut(&link) {
            link.process.clone_from(&self.directory.process);
        }
        self.directory.ready = true;
        self.directory.pause = FIRST_PAUSE;
        self.directory.reason = None;
        self.events.push_back(Event::Connected);
        self.want_all();
    }

    /// A signal of the directory: a service was added or removed.
    pub(super) fn directory_signal(&mut self, message: &Message, now: Instant) {
        let functions = &self.directory.functions;
        let action = message.address.action;
        let signal = [&functions.added, &functions.removed];
        let Some((_, signature)) = signal.into_iter().find(|(id, _)| *id == action) else {
            return;
        };
        let is_added = action == functions.added.0;
        let limits = &self.options.limits;
        let Ok(values) = payload(message.flags, &message.payload, signature, limits) else {
            return;
        };
        let id = values.field("", 0).and_then(Value::as_u32);
        let name = values.field("", 1).and_then(Value::as_text);
        let (Some(id), Some(name)) = (id, name) else {
            return;
        };
        if is_added {
            if self.learn_name(name, id) && self.directory.ready {
                self.events.push_back(Event::ServiceAdded(name.to_owned()));
            }
            self.on_added(name, id);
        } else {
            if self.known.get(name) == Some(&id) {
                self.known.remove(name);
                self.events
                    .push_back(Event::ServiceRemoved(name.to_owned()));
            }
            self.on_removed(name, id, now);
        }
    }

    /// Whether it is news, and there is room for it.
    fn learn_name(&mut self, name: &str, id: u32) -> bool {
        let has_room = name.len() <= LONGEST_NAME
            && (self.known.len() < self.options.limits.services || self.known.contains_key(name));
        has_room && self.known.insert(name.to_owned(), id) != Some(id)
    }

    /// Asks where a service is. False if the directory cannot be asked now.
    pub(super) fn resolve(&mut self, service: &str) -> bool {
        let (true, Some(link)) = (self.directory.ready, self.directory.link) else {
            return false;
        };
        let mut payload = Vec::new();
        let length = u32::try_from(service.len()).unwrap_or(u32::MAX);
        payload.extend(length.to_le_bytes());
        payload.extend(service.as_bytes());
        let address = function(DIRECTORY, self.directory.functions.service.0);
        let pending = Pending::Resolved(service.to_owned());
        self.ask(link, address, payload, pending).is_ok()
    }

    /// The signature of what [`resolve`](Self::resolve) brings.
    pub(super) fn service_info(&self) -> &str {
        &self.directory.functions.service.1
    }

    fn close_directory(&mut self, reason: &str, now: Instant) {
        if let Some(link) = self.directory.link {
            self.actions.push_back(Action::Close(link));
            self.on_lost(link, reason, now);
        }
    }

    pub(super) fn directory_lost(&mut self, reason: &str, now: Instant) {
        let directory = &mut self.directory;
        directory.link = None;
        directory.ready = false;
        directory.process = None;
        directory.retry_at = now.checked_add(directory.pause).unwrap_or(now);
        directory.pause = (directory.pause * 2).min(LONGEST_PAUSE);
        // Each attempt fails for the same reason: that is no news.
        if directory.reason.as_deref() != Some(reason) {
            directory.reason = Some(reason.to_owned());
            let reason = reason.to_owned();
            self.events.push_back(Event::Disconnected { reason });
        }
        self.known.clear();
        self.forget_services();
    }
}

impl Functions {
    fn of(meta: &MetaObject) -> Result<Self, String> {
        let missing = |name| format!("its service directory has no {name}");
        let method = |name: &'static str| {
            let found = meta.overloads(name).next();
            let found = found.map(|method| (method.id, method.returns.clone()));
            found.ok_or_else(|| missing(name))
        };
        let signal = |name: &'static str| {
            let found = meta.signal(name);
            let found = found.map(|signal| (signal.id, signal.signature.clone()));
            found.ok_or_else(|| missing(name))
        };
        Ok(Self {
            service: method("service")?,
            services: method("services")?,
            added: signal("serviceAdded")?,
            removed: signal("serviceRemoved")?,
        })
    }
}
