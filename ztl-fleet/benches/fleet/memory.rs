//! The memory of processes.

use ztl_tests::lab::Process;

use crate::quantile;

/// In KiB.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Memory {
    /// All that is in memory.
    pub(crate) resident: u64,
    /// The same, but what several processes share counts for each by its share.
    pub(crate) share: u64,
}

impl Memory {
    pub(crate) fn of(process: &Process) -> Self {
        let path = format!("/proc/{}/smaps_rollup", process.id());
        let told = std::fs::read_to_string(path).expect("it lives");
        let field = |name: &str| {
            let line = told.lines().find_map(|line| line.strip_prefix(name));
            let number = line.and_then(|line| line.split_whitespace().next()?.parse().ok());
            number.expect("a number")
        };
        Self {
            resident: field("Rss:"),
            share: field("Pss:"),
        }
    }
}

pub(crate) fn print(what: &str, all: &[Memory]) {
    let of = |field: fn(&Memory) -> u64, share| {
        let mut all: Vec<u64> = all.iter().map(field).collect();
        quantile(&mut all, share) as f64 / 1024.0
    };
    println!(
        "{what:12} {:6.1} {:6.1}    {:6.1} {:6.1}",
        of(|memory| memory.resident, 0.5),
        of(|memory| memory.resident, 1.0),
        of(|memory| memory.share, 0.5),
        of(|memory| memory.share, 1.0),
    );
}
