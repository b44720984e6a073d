//! Questions and ABORTs to one server that are under way at the same time.

use std::borrow::Cow;
use std::time::Duration;

use super::connection::{Connection, Open, Question};
use super::error::RequestError;
use super::remote_task::RemoteTask;
use super::status::Status;
use crate::remote_id::RemoteId;
use crate::scope;

/// Questions and ABORTs to one server that are under way at the same time, over one connection, each with a key of the
/// caller's. An ABORT waits neither for the answer to a question nor for that to another ABORT.
///
/// ```no_run
/// # use std::time::Duration;
/// # fn example(robot: ztl_std::RemoteTask) -> Result<(), ztl_std::RequestError> {
/// let mut requests = robot.into_parallel();
/// requests.ask_server("list", "tasks");
/// requests.abort("first", "/lab", &7.into())?;
/// while !requests.is_empty() {
///     for (key, answer) in requests.wait(Duration::from_secs(1)) {
///         println!("{key}: {answer:?}");
///     }
/// }
/// # Ok(())
/// # }
/// ```
pub struct ParallelRequests<K> {
    connection: Connection,
    open: Open<K>,
}

impl RemoteTask {
    /// Sends requests at the same time, over this client's connection and with its timeout.
    #[must_use]
    pub fn into_parallel<K>(self) -> ParallelRequests<K> {
        ParallelRequests {
            connection: self.connection,
            open: Open::new(),
        }
    }
}

impl<K> ParallelRequests<K> {
    /// Asks to stop a task. The answer is what [`RemoteTask::abort`] returns.
    ///
    /// # Errors
    /// [`RequestError::Scope`] if the scope contains `;`; there is no other answer then.
    pub fn abort(&mut self, key: K, scope: &str, id: &RemoteId) -> Result<(), RequestError> {
        if let Some(mistake) = scope::cannot_be_asked(scope) {
            return Err(RequestError::Scope(mistake));
        }
        let (scope, id) = (scope.to_owned(), id.clone());
        self.open.ask(key, Question::Abort { scope, id });
        Ok(())
    }

    /// Asks the server about itself. The answer is COMPLETED with a text, unless the server does not know the question.
    pub fn ask_server(&mut self, key: K, question: impl Into<Cow<'static, str>>) {
        self.open.ask(key, Question::Server(question.into()));
    }

    /// Whether every request was answered.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.open.is_empty()
    }

    /// Sends the requests, and returns answers as soon as there are some, at most after `limit`. If the connection is lost,
    /// or the server is silent for the timeout, all requests end with that error. Requests of this kind may be repeated.
    pub fn wait(&mut self, limit: Duration) -> Vec<(K, Result<Status, RequestError>)> {
        self.connection.converse_together(&mut self.open, limit)
    }

    /// Ends all requests without an answer. The next ones go over a new connection.
    pub fn give_up(&mut self) -> Vec<(K, Result<Status, RequestError>)> {
        self.connection.close_together(&mut self.open)
    }
}

impl<K> std::fmt::Debug for ParallelRequests<K> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("ParallelRequests")
            .field("endpoint", &self.connection.endpoint())
            .finish_non_exhaustive()
    }
}
