//! Figures of a fleet of real processes on one machine: whether all robots are there in time, the memory of each part, what
//! routing adds to a task and to a stream, how soon an ABORT beside streams arrives, what the loss of a router costs, and how soon
//! all robots have stopped. `cargo xtask bench fleet` runs
//! it.
//!
//! The table in `docs/fleet.md` has the figures that must hold. A routed task and a direct one are measured in turn, so that other
//! load on the machine affects both. No figure fails the run, but a task that acted twice or was told falsely does.

#![expect(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::indexing_slicing,
    reason = "a measurement says what is wrong by panicking"
)]

mod hall;
#[expect(dead_code, reason = "the tests use the rest")]
#[path = "../../tests/processes/line.rs"]
mod line;
mod many;
mod memory;
mod reconnects;
#[expect(dead_code, reason = "the tests use the rest")]
#[path = "../../tests/processes/requests.rs"]
mod requests;
mod routed;
mod streams;

use std::time::Duration;

/// Something that can be measured.
type Part = fn();

const PARTS: [(&str, Part); 4] = [
    ("routed", routed::measure),
    ("streams", streams::measure),
    ("many", many::measure),
    ("reconnects", reconnects::measure),
];

fn main() {
    // Cargo adds `--bench`.
    let wanted: Vec<String> = std::env::args()
        .skip(1)
        .filter(|word| word != "--bench")
        .collect();
    for (name, measure) in PARTS {
        if wanted.is_empty() || wanted.iter().any(|wanted| wanted == name) {
            measure();
        }
    }
}

/// The value below which this share of all lie.
fn quantile<T: Copy + Ord>(all: &mut [T], share: f64) -> T {
    all.sort_unstable();
    let last = all.len() - 1;
    all[(last as f64 * share).round() as usize]
}

fn ms(time: Duration) -> f64 {
    time.as_secs_f64() * 1000.0
}
