//! What a run was like.

/// Statistics of a run.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Summary {
    /// Tasks that a motor started.
    pub begun: u32,
    /// Tasks reported as completed.
    pub completed: u32,
    /// Tasks with another final state.
    pub ended: u32,
    /// Refused tasks.
    pub refused: u32,
    /// Tasks with an unknown outcome.
    pub unknown: u32,
}

impl std::ops::AddAssign for Summary {
    fn add_assign(&mut self, other: Self) {
        self.begun += other.begun;
        self.completed += other.completed;
        self.ended += other.ended;
        self.refused += other.refused;
        self.unknown += other.unknown;
    }
}

impl std::fmt::Display for Summary {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self {
            begun,
            completed,
            ended,
            refused,
            unknown,
        } = self;
        write!(
            f,
            "{begun} tasks were begun; clients were told {completed} completed, {ended} ended in \
             another way, {refused} refused, and could not know of {unknown}"
        )
    }
}

/// A broken promise.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Failure {
    /// Which.
    pub complaint: String,
    /// The trace, if it was requested.
    pub trace: Vec<String>,
}
