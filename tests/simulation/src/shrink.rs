//! Shrinks a plan that breaks a promise.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::time::Duration;

use crate::lab::{Failure, Summary, play};
use crate::plan::{Plan, What};

/// Plays a plan; a panic is a failure too.
///
/// # Errors
/// The broken promise or the panic.
pub fn attempt(plan: &Plan, traced: bool) -> Result<(Summary, Vec<String>), Failure> {
    let run = catch_unwind(AssertUnwindSafe(|| play(plan, traced)));
    run.unwrap_or_else(|panic| {
        let text = panic.downcast_ref::<String>().map(String::as_str);
        let text = text.or_else(|| panic.downcast_ref::<&str>().copied());
        Err(Failure {
            complaint: format!("panic: {}", text.unwrap_or("without a text")),
            trace: Vec::new(),
        })
    })
}

/// Finds a shorter plan that still breaks a promise, by removing and shortening happenings.
#[must_use]
pub fn shrink(plan: &Plan) -> Plan {
    shrink_by(plan, |plan| attempt(plan, false).is_err())
}

/// Like [`shrink`], for any criterion of failure.
#[must_use]
pub fn shrink_by(plan: &Plan, fails: impl Fn(&Plan) -> bool) -> Plan {
    let mut best = plan.clone();
    let mut size = best.happenings.len().div_ceil(2).max(1);
    loop {
        let mut shorter = false;
        let mut from = 0;
        while from < best.happenings.len() {
            let mut less = best.clone();
            let to = (from + size).min(less.happenings.len());
            less.happenings.drain(from..to);
            if fails(&less) {
                best = less;
                shorter = true;
            } else {
                from += size;
            }
        }
        if size == 1 && !shorter {
            break;
        }
        size = (size / 2).max(1);
    }
    for place in 0..best.happenings.len() {
        for _ in 0..6 {
            let mut less = best.clone();
            let Some(time) = time_of(&mut less.happenings[place].what) else {
                break;
            };
            *time /= 2;
            if !fails(&less) {
                break;
            }
            best = less;
        }
    }
    best
}

fn time_of(what: &mut What) -> Option<&mut Duration> {
    match what {
        What::Unplug(_, time)
        | What::Cut(_, _, time)
        | What::Stall(_, _, time)
        | What::Noise(_, _, _, time)
        | What::Kill(_, time)
        | What::Full(time)
        | What::Deaf(time)
        | What::Trouble(_, _, time) => Some(time),
        What::Ask { .. } | What::Abort { .. } | What::Press { .. } | What::Reset(_) => None,
    }
}

/// The plan, its trace, and the command that repeats it.
#[must_use]
pub fn report(plan: &Plan) -> String {
    let seed = plan.seed;
    let (trace, end) = match attempt(plan, true) {
        Ok((summary, trace)) => (trace, format!("All promises are kept: {summary}\n\n")),
        Err(failure) => {
            let complaint = failure.complaint;
            let shared = if plan.shared { " --bus" } else { "" };
            let again =
                format!("To see it again: cargo xtask simulate{shared} --seeds 1 --first {seed}");
            (failure.trace, format!("BROKEN: {complaint}\n{again}\n\n"))
        }
    };
    format!("{plan}\n{}\n{end}", trace.join("\n"))
}
