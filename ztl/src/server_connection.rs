//! Connects scripts to their servers: [`Connection`] over ZeroMQ.

use std::collections::BTreeMap;

use tracing::info;
use ztl_core::TaskId;
use ztl_core::integer::Integer;
use ztl_script::Connect;
use ztl_script::server::{Acceptance, Connected, Connection, Server, ServerAnswer, ServerRequest};
use ztl_std::describe::ScopeDescriptions;
use ztl_std::{
    Offers, RemoteTask, Remotes, RequestError, ServerTask, Status, TriggerError, Triggered, encoded,
};

use crate::connect_options::ConnectOptions;

/// A connection to the scope of one server.
struct ServerConnection {
    remote: RemoteTask,
    /// Whether it may answer which tasks it takes.
    answers_takes: bool,
    /// What its components say of themselves, once that was asked.
    described: Option<ScopeDescriptions>,
    /// Who got the last INIT.
    asked: Option<Server>,
}

/// Connects to a server once.
pub(crate) fn connect_once(remotes: &Remotes, options: &ConnectOptions, name: &str) -> Connected {
    Ok(ServerConnection::new(client(remotes, options, name)?))
}

/// Connects to servers of a run; further connections to a server are clones of the first client.
pub(crate) fn connect(remotes: Remotes, options: ConnectOptions) -> Connect {
    let mut clients: BTreeMap<String, RemoteTask> = BTreeMap::new();
    Box::new(move |name| {
        if let Some(client) = clients.get(name) {
            return Ok(ServerConnection::new(client.clone()));
        }
        info!(target: "remote-config", "Initialising remote task interface '{name}'...");
        let client = client(&remotes, &options, name)?;
        clients.insert(name.to_owned(), client.clone());
        Ok(ServerConnection::new(client))
    })
}

fn client(remotes: &Remotes, options: &ConnectOptions, name: &str) -> Result<RemoteTask, String> {
    let remote = remotes.task(name).map_err(|error| error.to_string())?;
    let client = RemoteTask::connect(&remote.endpoint(), &remote.scope);
    let client = client.map_err(|error| error.to_string())?;
    let client = options.apply(client, remote.keys.as_ref());
    client.map_err(|error| error.to_string())
}

impl ServerConnection {
    fn new(remote: RemoteTask) -> Box<Self> {
        Box::new(Self {
            remote,
            answers_takes: true,
            described: None,
            asked: None,
        })
    }

    /// Who the server is, by its first answer on this connection.
    fn server(&mut self) -> Result<Server, RequestError> {
        Ok(match self.remote.server_info(false)? {
            Some(info) => Server::Ours {
                version: info.version,
                boot: info.boot,
            },
            None => Server::Original,
        })
    }

    fn init(
        &mut self,
        (handler, component, goal): (&str, &str, &str),
        may_start: &dyn Fn() -> bool,
    ) -> ServerAnswer {
        // A server that does not identify itself gets no INIT.
        let server = match self.server() {
            Ok(server) => server,
            Err(error) => {
                return ServerAnswer::Nothing {
                    sent: false,
                    text: error.to_string(),
                };
            }
        };
        let payload = encoded(handler, component, goal);
        self.asked = Some(server.clone());
        // Once it is sent, its answer tells what is to be aborted.
        let told = self.remote.trigger_before(&payload, may_start, || true);
        started(told, server)
    }

    fn state(&mut self, told: Result<Status, RequestError>) -> ServerAnswer {
        match told {
            Ok(Status { state, text }) => ServerAnswer::Task { state, text },
            Err(error @ RequestError::UnknownTask { .. }) => {
                let info = self.remote.server_info(true).ok().flatten();
                ServerAnswer::TaskUnknown {
                    boot: info.map(|info| info.boot),
                    text: error.to_string(),
                }
            }
            Err(error) => failed(&error),
        }
    }

    fn probe(&mut self) -> Result<ServerAnswer, RequestError> {
        let server = self.server()?;
        // No server gives this id, so asking about it has no effect.
        match self.remote.status(TaskId::MAX) {
            Err(error) if error.is_no_scope() => {
                let (endpoint, scope) = (self.remote.endpoint(), self.remote.scope());
                let text = format!("the server at {endpoint} has no scope '{scope}'");
                Ok(ServerAnswer::NoScope { text })
            }
            Err(error) if !error.was_answered() => Err(error),
            _ => Ok(ServerAnswer::There { server }),
        }
    }

    /// Asks whether its handler would accept a task.
    fn takes(&mut self, payload: &str) -> Acceptance {
        if !self.answers_takes {
            return Acceptance::Unknown;
        }
        let answer = match self.remote.ask_server(&format!("takes {payload}")) {
            Ok(answer) => answer.unwrap_or_default(),
            // The question is longer than the task.
            Err(RequestError::TooLong { .. }) => return Acceptance::Unknown,
            Err(_) => String::new(),
        };
        let scopes: Option<BTreeMap<String, Option<String>>> = serde_json::from_str(&answer).ok();
        match scopes.and_then(|mut scopes| scopes.remove(self.remote.scope())) {
            Some(Some(why)) => Acceptance::No(why),
            Some(None) => Acceptance::Yes,
            None => {
                self.answers_takes = false;
                Acceptance::Unknown
            }
        }
    }

    /// The tasks that run or may run in the scope, whoever started them.
    fn tasks(&mut self) -> Result<ServerAnswer, RequestError> {
        let Some(known) = self.remote.tasks()? else {
            return Ok(ServerAnswer::Tasks {
                listed: None,
                gaps: Vec::new(),
            });
        };
        let here = |task: &&ServerTask| task.may_run && task.scope == self.remote.scope();
        let here = known.tasks.iter().filter(here);
        let here = here.map(|task| (task.id.clone(), task.task().to_owned()));
        Ok(ServerAnswer::Tasks {
            listed: known.boot.map(|boot| (boot, here.collect())),
            gaps: known.gaps,
        })
    }
}

impl Connection for ServerConnection {
    fn request(&mut self, request: &ServerRequest, may_start: &dyn Fn() -> bool) -> ServerAnswer {
        match request {
            ServerRequest::Init {
                handler,
                component,
                goal,
            } => self.init((handler, component, goal), may_start),
            ServerRequest::Status { id, text, hold } => {
                let payload = ServerRequest::status_payload(text, *hold);
                let told = self.remote.status_with(id, &payload);
                self.state(told)
            }
            ServerRequest::Abort { id } => match self.remote.abort(id) {
                Ok(status) if status.is_abort_rejected() => ServerAnswer::CannotStop {
                    state: status.state,
                    text: status.text,
                },
                told => self.state(told),
            },
            ServerRequest::Probe => self.probe().unwrap_or_else(|error| failed(&error)),
            ServerRequest::Tasks => self.tasks().unwrap_or_else(|error| failed(&error)),
        }
    }

    fn outcome(&mut self) -> Option<ServerAnswer> {
        let told = self.remote.ask_outcome()?;
        Some(started(told, self.asked.clone()?))
    }

    fn offers(&mut self) -> Option<Offers> {
        let mut description = self.remote.describe().ok()??;
        description.scopes.remove(self.remote.scope())
    }

    fn would_accept(&mut self, handler: &str, component: &str, goal: &str) -> Acceptance {
        let payload = encoded(handler, component, goal);
        if let Err(error) = self.remote.check_length(&payload) {
            return Acceptance::No(error.to_string());
        }
        let told = match self.takes(&payload) {
            Acceptance::No(why) => return Acceptance::No(why),
            told => told,
        };
        // A server takes any task for what it forwards, and may describe which are right.
        let ask = || self.remote.describe_scope().unwrap_or_default();
        let scope = self.described.get_or_insert_with(ask);
        match Acceptance::described(scope, handler, component, goal) {
            Acceptance::Unknown => told,
            said => said,
        }
    }
}

/// What became of an INIT.
fn started(told: Result<Triggered, TriggerError>, server: Server) -> ServerAnswer {
    match told {
        Ok(task) => ServerAnswer::Started {
            id: task.id,
            text: task.reply,
            server,
        },
        Err(TriggerError::Rejected { id, reason }) => ServerAnswer::Rejected { id, text: reason },
        Err(TriggerError::GivenUp) => ServerAnswer::Withdrawn,
        Err(error @ TriggerError::NeverCame) => ServerAnswer::NotStarted {
            text: error.to_string(),
        },
        // The goal is too long: its author has to change it.
        Err(TriggerError::Request(error @ RequestError::TooLong { .. })) => {
            ServerAnswer::Rejected {
                id: Integer::MINUS_ONE.into(),
                text: error.to_string(),
            }
        }
        Err(TriggerError::Request(error)) => failed(&error),
    }
}

/// The answer to a request that told nothing about its task.
fn failed(error: &RequestError) -> ServerAnswer {
    let text = error.to_string();
    match error {
        RequestError::NotTold { .. } => ServerAnswer::NotTold { text },
        error if error.was_answered() => ServerAnswer::Unclear { text },
        error => ServerAnswer::Nothing {
            sent: !error.nothing_was_sent(),
            text,
        },
    }
}
