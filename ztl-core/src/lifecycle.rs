//! The lifecycle of a task: six states, and the events that lead from one to another.
//!
//! ```text
//!   client INIT          server              handler
//!        │                 │                    │
//!        ▼      Accept     ▼      Complete      ▼
//!   INITIATED ─────────▶ ACCEPTED ─────────▶ COMPLETED
//!        │                 │  │
//!        │ Reject          │  └── Fail ─────▶ FAILED
//!        ▼                 └───── Abort ────▶ ABORTED
//!    REJECTED        (Fail and Abort also end an INITIATED task)
//! ```
//!
//! Each of the three parties has signals of its own:
//!
//! | party | signals | effect on the state |
//! |---|---|---|
//! | client | [`Request`]: INIT, STATUS, ABORT | INIT creates a task in INITIATED; STATUS and ABORT change no state |
//! | server | [`Event::Accept`], [`Event::Reject`] | decide about an INITIATED task |
//! | handler | [`Event::Complete`], [`Event::Fail`], [`Event::Abort`] | end the task; a client's ABORT takes effect once the handler has stopped |
//!
//! REJECTED, FAILED, ABORTED and COMPLETED are final: no event leads out of them. So a final state that a
//! client has seen never changes. The original can turn ABORTED into COMPLETED and back
//! (`docs/compatibility.md`, "Server"); this table cannot.

/// A client's request. The code is the request's `state` field.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Request {
    /// Start the task in the payload.
    Init = 1,
    /// Report state and result of the task with this id.
    Status = 2,
    /// Stop the task with this id.
    Abort = 3,
}

impl Request {
    /// The request with this code, or `None`.
    #[must_use]
    pub const fn from_code(code: i64) -> Option<Self> {
        match code {
            1 => Some(Self::Init),
            2 => Some(Self::Status),
            3 => Some(Self::Abort),
            _ => None,
        }
    }

    /// The number on the wire.
    #[must_use]
    pub const fn code(self) -> u8 {
        self as u8
    }
}

/// The state of a task. The code is the reply's `state` field.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum State {
    /// Requested, not decided yet.
    Initiated = 0,
    /// Accepted and running.
    Accepted = 1,
    /// Rejected: nothing was done. Final.
    Rejected = 2,
    /// Ended without reaching the goal. Final.
    Failed = 3,
    /// Stopped on request. Final.
    Aborted = 4,
    /// Reached the goal. Final.
    Completed = 5,
}

/// An event in the life of a task.
// The discriminant is the code of the state it leads to, which saves a table in flash.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Event {
    /// The handler has accepted the task.
    Accept = 1,
    /// The handler rejects the task and has not started it.
    Reject = 2,
    /// The goal is reached.
    Complete = 5,
    /// The goal will not be reached.
    Fail = 3,
    /// The handler has stopped because of an ABORT.
    Abort = 4,
}

impl Event {
    /// All events.
    pub const ALL: [Self; 5] = [
        Self::Accept,
        Self::Reject,
        Self::Complete,
        Self::Fail,
        Self::Abort,
    ];
}

impl State {
    /// All states, in the order of their codes.
    pub const ALL: [Self; 6] = [
        Self::Initiated,
        Self::Accepted,
        Self::Rejected,
        Self::Failed,
        Self::Aborted,
        Self::Completed,
    ];

    /// The state with this code, or `None`.
    #[must_use]
    pub const fn from_code(code: i64) -> Option<Self> {
        match code {
            0 => Some(Self::Initiated),
            1 => Some(Self::Accepted),
            2 => Some(Self::Rejected),
            3 => Some(Self::Failed),
            4 => Some(Self::Aborted),
            5 => Some(Self::Completed),
            _ => None,
        }
    }

    /// The number on the wire.
    #[must_use]
    pub const fn code(self) -> u8 {
        self as u8
    }

    /// The name as the original prints it.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Initiated => "INITIATED",
            Self::Accepted => "ACCEPTED",
            Self::Rejected => "REJECTED",
            Self::Failed => "FAILED",
            Self::Aborted => "ABORTED",
            Self::Completed => "COMPLETED",
        }
    }

    /// Whether the task has ended. On the wire: the code is above 1.
    #[must_use]
    pub const fn is_final(self) -> bool {
        self.code() > Self::Accepted.code()
    }

    /// The state after `event`, or `None` if the event has no effect in this state. A final state ignores
    /// every event.
    #[must_use]
    pub const fn after(self, event: Event) -> Option<Self> {
        let possible = match self {
            // A task that never ran cannot complete.
            Self::Initiated => !matches!(event, Event::Complete),
            // A running task can no longer be rejected.
            Self::Accepted => !matches!(event, Event::Accept | Event::Reject),
            Self::Rejected | Self::Failed | Self::Aborted | Self::Completed => false,
        };
        if !possible {
            return None;
        }
        Some(match event {
            Event::Accept => Self::Accepted,
            Event::Reject => Self::Rejected,
            Event::Fail => Self::Failed,
            Event::Abort => Self::Aborted,
            Event::Complete => Self::Completed,
        })
    }
}

impl core::fmt::Display for State {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str(self.name())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_state_handles_every_event() {
        use State::{Aborted, Accepted, Completed, Failed, Rejected};
        let none = [None; 5];
        let table = [
            [
                Some(Accepted),
                Some(Rejected),
                None,
                Some(Failed),
                Some(Aborted),
            ],
            [None, None, Some(Completed), Some(Failed), Some(Aborted)],
            none,
            none,
            none,
            none,
        ];
        for (state, row) in State::ALL.into_iter().zip(table) {
            for (event, expected) in Event::ALL.into_iter().zip(row) {
                assert_eq!(state.after(event), expected, "{state} after {event:?}");
            }
        }
    }

    #[test]
    fn final_states_have_codes_above_accepted_and_ignore_every_event() {
        for state in State::ALL {
            assert_eq!(state.is_final(), state.code() > 1);
            let closed = Event::ALL.into_iter().all(|e| state.after(e).is_none());
            assert_eq!(state.is_final(), closed, "{state}");
        }
    }

    #[test]
    fn states_round_trip_through_their_codes() {
        for state in State::ALL {
            assert_eq!(State::from_code(i64::from(state.code())), Some(state));
        }
        assert_eq!(State::from_code(6), None);
        assert_eq!(State::from_code(-1), None);
    }
}
