//! A page for people, and tables for statistics, made from the [records](super::record) of runs.
//!
//! The page is one file: no script, nothing from elsewhere. `docs/record.md` says what its numbers
//! mean.

mod csv;
mod html;
mod layout;
mod page;
mod reader;
mod run;
mod svg;
mod tables;
mod words;

use self::run::Run;
use super::record::{Damage, Record};

/// One or many runs, for comparison.
#[derive(Debug, Clone)]
pub struct Report {
    runs: Vec<Run>,
    damage: Vec<Damage>,
}

impl Report {
    /// Puts together what the records say; `damage` is what the page is to admit.
    #[must_use]
    pub fn new(records: Vec<Record>, damage: Vec<Damage>) -> Self {
        Self {
            runs: records.into_iter().map(reader::read).collect(),
            damage,
        }
    }

    /// The page: HTML with all that it needs in it.
    #[must_use]
    pub fn html(&self) -> String {
        page::page(self)
    }

    /// One line for each task that was sent, after a line of names (RFC 4180).
    #[must_use]
    pub fn tasks_csv(&self) -> String {
        csv::tasks(&self.runs)
    }

    /// One line for each thing that the operator did, or that was decided in the operator's place,
    /// after a line of names (RFC 4180).
    #[must_use]
    pub fn actions_csv(&self) -> String {
        csv::actions(&self.runs)
    }
}

#[cfg(test)]
mod tests;
