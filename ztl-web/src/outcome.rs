//! What became of a goal.

use serde::{Serialize, Serializer};
use ztl_std::{RemoteId, State, TriggerError};

use crate::cut;

/// The state of a goal that is not open any more.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum GoalState {
    /// The final state of its task.
    Task(State),
    /// Nobody can tell the final state.
    Unknown,
    /// Nothing was started.
    NotStarted,
}

impl GoalState {
    const fn name(self) -> &'static str {
        match self {
            Self::Task(state) => state.name(),
            Self::Unknown => "UNKNOWN",
            Self::NotStarted => "NOT_STARTED",
        }
    }
}

impl Serialize for GoalState {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(self.name())
    }
}

/// The result of a goal.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub(crate) struct Outcome {
    pub(crate) state: GoalState,
    pub(crate) text: String,
    /// The task's id; 0 without one.
    pub(crate) id: RemoteId,
}

impl Outcome {
    pub(crate) fn not_started(text: String) -> Self {
        Self {
            state: GoalState::NotStarted,
            text,
            id: RemoteId::from(0_i64),
        }
    }

    pub(crate) fn unknown(text: String, id: RemoteId) -> Self {
        Self {
            state: GoalState::Unknown,
            text: cut::text(&text, cut::RESULT),
            id,
        }
    }

    /// What an INIT without an accepted task means.
    pub(crate) fn of_init(error: TriggerError) -> Self {
        match error {
            TriggerError::Rejected { id, reason } => Self {
                state: GoalState::Task(State::Rejected),
                text: cut::text(&reason, cut::RESULT),
                id,
            },
            TriggerError::NeverCame | TriggerError::GivenUp => Self::not_started(error.to_string()),
            TriggerError::Request(error) if error.nothing_was_sent() => {
                Self::not_started(error.to_string())
            }
            TriggerError::Request(error) => Self::unknown(error.to_string(), RemoteId::from(0_i64)),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use ztl_std::RequestError;

    use super::*;

    #[test]
    fn a_lost_answer_is_unknown_and_never_failed() {
        let endpoint = || "tcp://robot:1".to_owned();
        let waited = Duration::from_secs(2);
        let lost = RequestError::NoAnswer {
            endpoint: endpoint(),
            waited,
        };
        let unsent = RequestError::NotConnected {
            endpoint: endpoint(),
            waited,
            obstacle: None,
        };
        let state = |error| Outcome::of_init(error).state;
        assert_eq!(state(TriggerError::Request(lost)), GoalState::Unknown);
        assert_eq!(state(TriggerError::Request(unsent)), GoalState::NotStarted);
        assert_eq!(state(TriggerError::GivenUp), GoalState::NotStarted);
        assert_eq!(state(TriggerError::NeverCame), GoalState::NotStarted);
    }
}
