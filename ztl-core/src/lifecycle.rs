//! The life of a task: six states, and the events that lead from one to the next.
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
//! Three parties speak of a task, and each has signals of its own:
//!
//! | who | signals | what they do to the state |
//! |---|---|---|
//! | client | [`Request`]: INIT, STATUS, ABORT | INIT makes a task, INITIATED; STATUS and ABORT change nothing by themselves |
//! | server | [`Event::Accept`], [`Event::Reject`] | decide about an INITIATED task |
//! | handler | [`Event::Complete`], [`Event::Fail`], [`Event::Abort`] | end it; an ABORT of a client counts only once the handler has stopped |
//!
//! REJECTED, FAILED, ABORTED and COMPLETED are final: no event leads out of them, so a state that a
//! client was told never changes. The original lets ABORTED turn into COMPLETED and back
//! (wire specification 4.7, HAZARDS); this table is where ours does not.

/// What a client asks for. The code is the `state` field of a request.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Request {
    /// Start the task in the payload.
    Init = 1,
    /// Tell state and result of the task with this id.
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

/// Where a task is in its life. The code is the `state` field of a reply.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum State {
    /// Asked for; nobody has decided yet.
    Initiated = 0,
    /// Taken, and under way.
    Accepted = 1,
    /// Refused: nothing happened. Final.
    Rejected = 2,
    /// Ended without reaching its goal. Final.
    Failed = 3,
    /// Stopped on request. Final.
    Aborted = 4,
    /// Reached its goal. Final.
    Completed = 5,
}

/// Who speaks of a task.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Party {
    /// Asks for it, and may want it to stop.
    Client,
    /// Decides whether it is taken.
    Server,
    /// Does it, and says how it ended.
    Handler,
}

/// What can happen to a task.
// Each is the code of the state that it leads to: so that needs no table in flash.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Event {
    /// The handler took the task.
    Accept = 1,
    /// The handler will not do it, and has not begun.
    Reject = 2,
    /// The goal is reached.
    Complete = 5,
    /// The goal will not be reached.
    Fail = 3,
    /// The handler has stopped because it was asked to.
    Abort = 4,
}

impl Event {
    /// Every event.
    pub const ALL: [Self; 5] = [
        Self::Accept,
        Self::Reject,
        Self::Complete,
        Self::Fail,
        Self::Abort,
    ];

    /// Whose signal it is; a client's are [`Request`]s, and change no state by themselves.
    #[must_use]
    pub const fn said_by(self) -> Party {
        match self {
            Self::Accept | Self::Reject => Party::Server,
            Self::Complete | Self::Fail | Self::Abort => Party::Handler,
        }
    }
}

impl State {
    /// Every state, in the order of the codes.
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

    /// The name that the original prints.
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

    /// Whether the task has ended. On the wire: the code is greater than 1.
    #[must_use]
    pub const fn is_final(self) -> bool {
        self.code() > Self::Accepted.code()
    }

    /// The state after `event`, or `None` when the event changes nothing here.
    ///
    /// Total: every pair has an entry. A final state answers `None` to everything.
    #[must_use]
    pub const fn after(self, event: Event) -> Option<Self> {
        let possible = match self {
            // One that never ran is not done.
            Self::Initiated => !matches!(event, Event::Complete),
            // One that runs can no longer be refused.
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
    fn every_state_against_every_event() {
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
    fn final_states_are_those_above_accepted_and_have_no_way_out() {
        for state in State::ALL {
            assert_eq!(state.is_final(), state.code() > 1);
            let closed = Event::ALL.into_iter().all(|e| state.after(e).is_none());
            assert_eq!(state.is_final(), closed, "{state}");
        }
    }

    #[test]
    fn a_server_decides_and_a_handler_ends() {
        for state in State::ALL {
            for event in Event::ALL {
                let Some(after) = state.after(event) else {
                    continue;
                };
                let decides = after == State::Accepted || after == State::Rejected;
                let expected = if decides {
                    Party::Server
                } else {
                    Party::Handler
                };
                assert_eq!(event.said_by(), expected, "{state} {event:?}");
            }
        }
    }

    #[test]
    fn codes_lead_back_to_their_states() {
        for state in State::ALL {
            assert_eq!(State::from_code(i64::from(state.code())), Some(state));
        }
        assert_eq!(State::from_code(6), None);
        assert_eq!(State::from_code(-1), None);
    }
}
