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
    /// The turns on a shared line without faults.
    pub healthy: Turns,
    /// The same while one node has each [`Trouble`], for the other nodes.
    pub troubled: [Turns; 5],
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
        for (mine, other) in mine.zip(others) {
            mine.turn = mine.turn.max(other.turn);
            mine.aborting = mine.aborting.max(other.aborting);
            mine.urgent = mine.urgent.max(other.urgent);
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
            write!(
                f,
                "; {collided} bytes collided\nall nodes are well: {healthy}"
            )?;
            for (trouble, turns) in Trouble::ALL.iter().zip(troubled) {
                write!(
                    f,
                    "\na node {}: {turns}",
                    format!("{trouble:?}").to_lowercase()
                )?;
            }
        }
        Ok(())
    }
}

/// The longest times on a shared line.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Turns {
    /// Between two turns of a node with a task.
    pub turn: Duration,
    /// The same while some tasks are aborted.
    pub aborting: Duration,
    /// Until a `Start` or an `Abort` is sent.
    pub urgent: Duration,
}

impl Turns {
    pub(super) const fn bounds(turn: u64, aborting: u64, urgent: u64) -> Self {
        Self {
            turn: Duration::from_millis(turn),
            aborting: Duration::from_millis(aborting),
            urgent: Duration::from_millis(urgent),
        }
    }

    pub(super) fn keeps(self, most: Self) -> bool {
        self.turn <= most.turn && self.aborting <= most.aborting && self.urgent <= most.urgent
    }
}

impl std::fmt::Display for Turns {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self {
            turn,
            aborting,
            urgent,
        } = self;
        write!(
            f,
            "a turn at least every {turn:.1?} ({aborting:.1?} while tasks are aborted), an Abort after {urgent:.1?}"
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
