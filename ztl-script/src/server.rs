//! The only way from a script to a robot: a [`Connection`] to a server, its requests and their answers.

use std::time::Duration;

use ztl_core::State;
use ztl_std::describe::{CheckGoal, ScopeDescriptions, find};
use ztl_std::{Offers, RemoteId};

/// A connection to one server. Whoever plays or checks a script supplies it.
pub trait Connection: Send {
    /// Sends a request and waits for its answer. An INIT is never sent twice, and only while `may_start`, which is to be
    /// called immediately before; otherwise the answer is [`ServerAnswer::Withdrawn`].
    fn request(&mut self, request: &ServerRequest, may_start: &dyn Fn() -> bool) -> ServerAnswer;

    /// What became of the last INIT, which was not answered. It is given up: if it arrives later, it starts nothing. `None`
    /// if its outcome cannot be learnt, or not any more.
    fn outcome(&mut self) -> Option<ServerAnswer> {
        None
    }

    /// The handlers and components that the server lists; `None` if it does not list them.
    fn offers(&mut self) -> Option<Offers>;

    /// Whether the server would accept this task. Starts nothing.
    fn would_accept(&mut self, handler: &str, component: &str, goal: &str) -> Acceptance;
}

/// A new connection to the server with this name, or why there is none.
pub type Connected = Result<Box<dyn Connection>, String>;

/// Whether a server would accept a task.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Acceptance {
    /// It would.
    Yes,
    /// It would not, for this reason.
    No(String),
    /// The server cannot tell.
    Unknown,
}

impl Acceptance {
    /// Whether the goal of a task is what its component says of itself.
    #[must_use]
    pub fn described(
        scope: &ScopeDescriptions,
        handler: &str,
        component: &str,
        goal: &str,
    ) -> Self {
        match find(scope, handler, component).map(|it| it.goal.check(goal, false)) {
            None => Self::Unknown,
            Some(Ok(_)) => Self::Yes,
            Some(Err(why)) => Self::No(why),
        }
    }
}

/// A request to a server.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ServerRequest {
    /// Start a task.
    Init {
        /// The handler.
        handler: String,
        /// The component.
        component: String,
        /// The goal.
        goal: String,
    },
    /// Report the state of a task.
    Status {
        /// The task's id on the server.
        id: RemoteId,
        /// The payload for a server that does not hold answers.
        text: String,
        /// How long a server of this project may hold the answer until the task ends; zero: not at all.
        hold: Duration,
    },
    /// Stop a task.
    Abort {
        /// The task's id on the server.
        id: RemoteId,
    },
    /// Report whether the server is there and serves the scope. Starts nothing.
    Probe,
    /// List the tasks that run in the scope.
    Tasks,
}

impl ServerRequest {
    /// The payload of a STATUS.
    #[must_use]
    pub fn status_payload(text: &str, hold: Duration) -> String {
        match hold.is_zero() {
            true => text.to_owned(),
            false => format!("wait {}", hold.as_millis()),
        }
    }
}

/// What came of a request.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ServerAnswer {
    /// INIT: the server accepted the task.
    Started {
        /// The task's id on the server.
        id: RemoteId,
        /// The server's text.
        text: String,
        /// Who the server is.
        server: Server,
    },
    /// INIT: the server rejected the task.
    Rejected {
        /// The id in the answer.
        id: RemoteId,
        /// The reason.
        text: String,
    },
    /// INIT: it was not carried out and never will be.
    NotStarted {
        /// How that is known.
        text: String,
    },
    /// INIT: it was not sent, because everything was stopped after it had been decided.
    Withdrawn,
    /// STATUS or ABORT: the state of the task.
    Task {
        /// The state.
        state: State,
        /// Progress, result or reason.
        text: String,
    },
    /// ABORT: the handler cannot stop the task, which continues.
    CannotStop {
        /// The state of the task.
        state: State,
        /// The server's text.
        text: String,
    },
    /// The server does not know the task.
    TaskUnknown {
        /// The boot id of the server, if it is one of this project.
        boot: Option<u32>,
        /// The server's text.
        text: String,
    },
    /// Probe: the server is there and serves the scope.
    There {
        /// Who it is.
        server: Server,
    },
    /// Probe: the server is there but does not serve the scope.
    NoScope {
        /// A message for people.
        text: String,
    },
    /// The answer to [`ServerRequest::Tasks`].
    Tasks {
        /// The server's boot id, and the tasks that run or may run in the scope, with their
        /// `handler:component:goal`. `None` if the server cannot list its tasks, as the original's.
        listed: Option<(u32, Vec<(RemoteId, String)>)>,
        /// Why other tasks may run too.
        gaps: Vec<String>,
    },
    /// The server answered that the request did not reach the task. Asking again may help.
    NotTold {
        /// The server's text.
        text: String,
    },
    /// The server answered, and the outcome is unknown: it could not learn the outcome, or the answer is
    /// about another task, has an undefined state or is malformed. Asking again does not help. After an
    /// INIT the task may have been started.
    Unclear {
        /// A message for people.
        text: String,
    },
    /// No answer came.
    Nothing {
        /// Whether the request was sent at all.
        sent: bool,
        /// A message for people.
        text: String,
    },
}

/// Who a server is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Server {
    /// The original's, or another implementation.
    Original,
    /// A server of this project: it holds answers to STATUS.
    Ours {
        /// Its version.
        version: String,
        /// Its boot id, which differs from start to start.
        boot: u32,
    },
}
