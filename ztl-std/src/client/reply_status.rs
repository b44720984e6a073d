//! What replies to a STATUS and an ABORT say of a task.

use ztl_core::State;
use ztl_core::dispatcher::NOTHING_KNOWN;

use super::connection::ClientReply;
use super::error::RequestError;
use super::status::Status;
use crate::remote_id::RemoteId;

/// The status in the reply to a STATUS or an ABORT.
pub(super) fn status_of(reply: ClientReply, id: &RemoteId) -> Result<Status, RequestError> {
    match reply {
        ClientReply::Task(status) => Ok(status),
        ClientReply::UnknownTask { text } => Err(RequestError::UnknownTask {
            id: id.clone(),
            text,
        }),
        ClientReply::Unclear(error) => Err(error),
        ClientReply::Accepted { text, .. } | ClientReply::Rejected { text, .. } => {
            Err(unexpected(text))
        }
        ClientReply::NeverStarted => Err(unexpected(String::new())),
    }
}

/// What an ABORT came to: its answer has a final state, and the STATUS after it tells the result.
pub(super) fn after_abort(
    answer: Status,
    status: Result<Status, RequestError>,
) -> Result<Status, RequestError> {
    match status {
        // Only a STATUS shows whether a failed task may still run.
        Err(error)
            if answer.state == State::Failed
                || matches!(error, RequestError::UnknownOutcome { .. }) =>
        {
            Err(error)
        }
        Ok(told) if told.state == answer.state || !told.state.is_final() => Ok(told),
        _ => Ok(Status {
            state: answer.state,
            text: NOTHING_KNOWN.to_owned(),
        }),
    }
}

/// The answer to another request; [`ztl_core::client`] prevents it.
pub(super) const fn unexpected(answer: String) -> RequestError {
    RequestError::Unreadable { answer }
}
