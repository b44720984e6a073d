//! Calls of services. Each has a connection of its own.

use std::fmt;
use std::sync::Arc;
use std::time::{Duration, Instant};

use super::rpc::CallError;
use super::{Engine, Role};
use crate::WireType;
use crate::node::fit::fits;
use crate::node::net::ConnectionId;
use crate::node::net_error::NetError;
use crate::tcpros::{FrameError, Frames, Header, LONGEST_HEADER, frame};
use crate::uri::Address;
use crate::xmlrpc::Value;

/// The longest answer, in bytes.
const LONGEST: usize = 64 * 1024 * 1024;

/// The longest time that a call may take.
const LONGEST_CALL: Duration = Duration::from_secs(24 * 3600);

/// Called once with the encoded response.
pub(crate) type OnResponse = Box<dyn FnOnce(Result<Vec<u8>, ServiceError>) + Send>;

/// Why a service has not answered.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum ServiceError {
    /// The master does not name it, or cannot be asked.
    NotFound {
        /// The service.
        service: String,
        /// What the master says.
        error: CallError,
    },
    /// The connection failed. If the request was sent, it is unknown whether the service has carried it out.
    Net {
        /// What failed.
        error: NetError,
        /// Whether the request was sent.
        sent: bool,
    },
    /// The service refuses the connection, for example because its type differs.
    Refused {
        /// Its reason.
        reason: String,
    },
    /// The service has failed.
    Failed {
        /// Its reason.
        reason: String,
    },
    /// The answer is not TCPROS.
    Malformed {
        /// What is wrong.
        error: String,
    },
}

impl fmt::Display for ServiceError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NotFound { service, error } => write!(f, "service {service}: {error}"),
            Self::Net { error, sent: false } => write!(f, "{error}; nothing was sent"),
            Self::Net { error, sent: true } => {
                write!(
                    f,
                    "{error}; the request was sent, so its outcome is unknown"
                )
            }
            Self::Refused { reason } => write!(f, "the service refuses the call: {reason}"),
            Self::Failed { reason } => write!(f, "the service has failed: {reason}"),
            Self::Malformed { error } => write!(f, "malformed answer of the service: {error}"),
        }
    }
}

impl std::error::Error for ServiceError {}

/// A call in progress.
pub(crate) struct ServiceCall {
    /// The request, until the service has accepted the connection.
    request: Option<Vec<u8>>,
    frames: Frames,
    /// Whether the service succeeded, once the first byte of its answer has arrived.
    done: Option<bool>,
    md5: String,
    limit: Duration,
    then: OnResponse,
}

impl ServiceCall {
    /// The connection is closed.
    pub(crate) fn end(self, error: NetError) {
        let sent = self.request.is_none();
        (self.then)(Err(ServiceError::Net { error, sent }));
    }
}

impl Engine {
    /// Calls a service. `ty` has the name and the MD5 sum of the service's type.
    pub(crate) fn call_service(
        &mut self,
        now: Instant,
        service: &str,
        ty: WireType,
        request: Vec<u8>,
        limit: Duration,
        then: OnResponse,
    ) {
        let limit = limit.min(LONGEST_CALL);
        let deadline = now + limit;
        let params = [self.name[..].into(), service.into()];
        let service = service.to_owned();
        let found = move |engine: &mut Self, now: Instant, answer: Result<Value, CallError>| {
            let uri = match answer {
                Ok(value) => value.as_str().unwrap_or_default().to_owned(),
                Err(error) => return then(Err(ServiceError::NotFound { service, error })),
            };
            let Some(address) = Address::parse(&uri, "rosrpc") else {
                let error = CallError::Address { uri };
                return then(Err(ServiceError::NotFound { service, error }));
            };
            let header = Header::new([
                ("callerid", &engine.name[..]),
                ("service", &service),
                ("type", &ty.name),
                ("md5sum", &ty.md5),
            ]);
            let id = engine.net.open(now, address, deadline);
            engine.net.send(id, Arc::from(header.encode()), 2);
            let call = ServiceCall {
                request: Some(request),
                frames: Frames::default(),
                done: None,
                md5: ty.md5,
                limit,
                then,
            };
            engine.roles.insert(id, Role::Service(Box::new(call)));
        };
        let master = self.master.clone();
        self.rpc(
            now,
            &master,
            "lookupService",
            &params,
            limit,
            Box::new(found),
        );
    }

    pub(crate) fn on_service_bytes(
        &mut self,
        id: ConnectionId,
        mut call: Box<ServiceCall>,
        bytes: &[u8],
    ) -> Option<Role> {
        call.frames.handle_bytes(bytes);
        let answer = loop {
            match call.step() {
                Ok(Step::Later) => return Some(Role::Service(call)),
                Ok(Step::Send(request)) => {
                    // A request that is late must not be carried out after its task has ended.
                    self.net.limit(id, call.limit);
                    self.net.send(id, Arc::from(frame(&request)), 2);
                }
                Ok(Step::Response(response)) => break Ok(response),
                Err(error) => break Err(error),
            }
        };
        self.net.close(id);
        (call.then)(answer);
        None
    }
}

enum Step {
    Later,
    Send(Vec<u8>),
    Response(Vec<u8>),
}

impl ServiceCall {
    /// What the bytes that have arrived mean.
    fn step(&mut self) -> Result<Step, ServiceError> {
        let malformed = |error: FrameError| ServiceError::Malformed {
            error: error.to_string(),
        };
        if self.request.is_some() {
            let Some(content) = self.frames.poll_frame(LONGEST_HEADER).map_err(malformed)? else {
                return Ok(Step::Later);
            };
            let header = Header::parse(content).map_err(malformed)?;
            let reason = header.get("error").to_owned();
            if !reason.is_empty() {
                return Err(ServiceError::Refused { reason });
            }
            let theirs = header.get("md5sum");
            if !fits(&self.md5, theirs) {
                let reason = format!("its MD5 sum is {theirs}, and not {}", self.md5);
                return Err(ServiceError::Refused { reason });
            }
            let request = self.request.take().unwrap_or_default();
            return Ok(Step::Send(request));
        }
        let done = match self.done {
            Some(done) => done,
            None => match self.frames.poll_byte() {
                Some(byte) => *self.done.insert(byte != 0),
                None => return Ok(Step::Later),
            },
        };
        match self.frames.poll_frame(LONGEST).map_err(malformed)? {
            None => Ok(Step::Later),
            Some(content) if done => Ok(Step::Response(content.to_vec())),
            Some(content) => Err(ServiceError::Failed {
                reason: String::from_utf8_lossy(content).into_owned(),
            }),
        }
    }
}
