//! Medians, and how sure they are.

use std::fmt;

/// A median, and the interval in which the true one lies with 95 %.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Interval {
    pub(crate) median: f64,
    pub(crate) low: f64,
    pub(crate) high: f64,
}

impl Interval {
    /// Of some measurements.
    pub(crate) fn of(values: impl Iterator<Item = f64>) -> Self {
        let mut values: Vec<f64> = values.collect();
        values.sort_by(f64::total_cmp);
        let count = values.len() as f64;
        // How many of them lie below the true median is binomial.
        let off = 1.96 * count.sqrt() / 2.0;
        let at = |place: f64| {
            let place = place.clamp(0.0, (count - 1.0).max(0.0)) as usize;
            values.get(place).copied().unwrap_or(f64::NAN)
        };
        Self {
            median: at(count / 2.0),
            low: at(count / 2.0 - off),
            high: at(count / 2.0 + off),
        }
    }

    /// Whether this much lies within the interval or below it.
    pub(crate) fn reaches(&self, wanted: f64) -> bool {
        self.high >= wanted
    }

    /// Whether this much lies within the interval or above it.
    pub(crate) fn stays_below(&self, wanted: f64) -> bool {
        self.low <= wanted
    }
}

impl fmt::Display for Interval {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "{:.2} ({:.2} to {:.2})",
            self.median, self.low, self.high
        )
    }
}

pub(crate) fn percentile(sorted: &[f64], percent: usize) -> f64 {
    let place = sorted.len() * percent / 100;
    let found = sorted.get(place).or(sorted.last());
    found.copied().unwrap_or(f64::NAN)
}

pub(crate) fn verdict(reached: bool) -> &'static str {
    if reached { "reached" } else { "NOT REACHED" }
}

/// How busy the machine is, which the figures depend on.
pub(crate) fn machine() -> String {
    let load = std::fs::read_to_string("/proc/loadavg").unwrap_or_default();
    let load: Vec<&str> = load.split(' ').take(3).collect();
    let cores = std::thread::available_parallelism().map_or(0, usize::from);
    format!("{cores} cores, load averages {}", load.join(" "))
}
