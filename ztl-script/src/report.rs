//! A page for people and tables for statistics, made from the [records](super::record) of runs.
//!
//! The page is one file without scripts or external resources. `docs/record.md` explains its numbers.

mod csv;
mod failures;
mod from_record;
mod html;
mod page;
mod run;
mod svg;
mod tables;
mod words;

use crate::record::{Damage, Record};
use run::ReportedRun;

/// One run, or several to compare.
#[derive(Debug, Clone)]
pub struct Report {
    runs: Vec<ReportedRun>,
    damage: Vec<Damage>,
}

impl Report {
    /// Reads the records; `damage` is shown on the page.
    #[must_use]
    pub fn new(records: Vec<Record>, damage: Vec<Damage>) -> Self {
        Self {
            runs: records.into_iter().map(from_record::read).collect(),
            damage,
        }
    }

    /// Shows a drawing below the overview of a run, by its place among the records: HTML for
    /// [`BELOW_OVERVIEW`](crate::drawing::BELOW_OVERVIEW).
    pub fn add_drawing(&mut self, run: usize, html: &str) {
        if let Some(run) = self.runs.get_mut(run) {
            run.drawing.push_str(html);
        }
    }

    /// The page, in HTML.
    #[must_use]
    pub fn html(&self) -> String {
        page::page(&self.runs, &self.damage)
    }

    /// One line for each task sent, after a header (RFC 4180).
    #[must_use]
    pub fn tasks_csv(&self) -> String {
        csv::tasks(&self.runs)
    }

    /// One line for each key and each decision, after a header (RFC 4180).
    #[must_use]
    pub fn actions_csv(&self) -> String {
        csv::actions(&self.runs)
    }
}

#[cfg(test)]
mod tests;
