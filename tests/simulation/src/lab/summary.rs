//! What a run was like.

use std::time::Duration;

use crate::plan::Trouble;

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
    /// On a shared line: the longest time between two turns of a node with a task, and until a `Start` or an `Abort` was
    /// sent, without faults.
    pub healthy: [Duration; 2],
    /// The same while one node has each [`Trouble`](crate::plan::Trouble), for the other nodes.
    pub troubled: [[Duration; 2]; 5],
    /// Bytes that were damaged since several ends sent at once.
    pub collided: u64,
}

impl std::ops::AddAssign for Summary {
    fn add_assign(&mut self, other: Self) {
        self.begun += other.begun;
        self.completed += other.completed;
        self.ended += other.ended;
        self.refused += other.refused;
        self.unknown += other.unknown;
        let mine = self.troubled.iter_mut().chain([&mut self.healthy]);
        let others = other.troubled.iter().chain([&other.healthy]);
        for (mine, other) in mine.flatten().zip(others.flatten()) {
            *mine = (*mine).max(*other);
        }
        self.collided += other.collided;
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
            healthy,
            troubled,
            collided,
        } = self;
        write!(
            f,
            "{begun} tasks were begun; clients were told {completed} completed, {ended} ended in \
             another way, {refused} refused, and could not know of {unknown}"
        )?;
        if *collided > 0 {
            let [turn, urgent] = healthy;
            write!(
                f,
                "; {collided} bytes collided; longest time without a turn {turn:?}, until a Start or an Abort {urgent:?}"
            )?;
            for (trouble, [turn, urgent]) in Trouble::ALL.iter().zip(troubled) {
                write!(f, "; {trouble:?}: {turn:?}, {urgent:?}")?;
            }
        }
        Ok(())
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
