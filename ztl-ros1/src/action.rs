//! The client of actionlib's actions: a state machine without I/O, and the messages that it sends and reads.

mod foreign;
pub(crate) mod machine;
pub(crate) mod wire;

/// Topics of an action that are received.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Part {
    Status,
    Feedback,
    Result,
}

/// What a goal does.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum GoalEvent {
    /// The action server has accepted the goal and pursues it. At most once.
    Accepted,
    /// Encoded feedback, of the type in `XFeedback`.
    Feedback(Vec<u8>),
    /// The goal is over. This is the last event.
    Ended(GoalEnd),
}

/// How a goal has ended.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct GoalEnd {
    /// The final state.
    pub state: EndState,
    /// The text of the action server; the reason for [`NotSent`](EndState::NotSent) and [`Unknown`](EndState::Unknown).
    pub text: String,
    /// The encoded result, of the type in `XResult`. It is missing if nothing was pursued, if the outcome is unknown,
    /// or if the result was lost while the final state is known.
    pub result: Option<Vec<u8>>,
}

/// The final state of a goal.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum EndState {
    /// The action server says SUCCEEDED.
    Succeeded,
    /// The action server says ABORTED: it could not reach the goal.
    Aborted,
    /// The action server says PREEMPTED: the goal was cancelled, or replaced by another goal, after it had begun.
    Preempted,
    /// The action server says RECALLED: the goal was cancelled before it began.
    Recalled,
    /// The action server says REJECTED.
    Rejected,
    /// The goal was never sent.
    NotSent,
    /// The goal was sent, and its outcome is unknown.
    Unknown,
}
