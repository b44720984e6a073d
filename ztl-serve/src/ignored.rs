//! Signals that this process was started to ignore: a shell has what it starts in the background ignore INT
//! and QUIT, `nohup` has it ignore HUP. Programs would inherit that, and could not be stopped by them.

use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use signal_hook::consts::FORBIDDEN;
use signal_hook::flag;

/// From now on what this process starts has all signals as a program expects them. This process still heeds
/// none of them, but by a handler that does nothing: that is not inherited.
///
/// Without `/proc`, it is not known which they are, and nothing is done.
pub(super) fn keep_to_oneself() {
    for signal in ignored_signals() {
        if !FORBIDDEN.contains(&signal) {
            // The C library refuses those that it uses itself.
            let _ = flag::register(signal, Arc::new(AtomicBool::new(false)));
        }
    }
}

/// The numbers of the signals that this process ignores; as soon as it has begun, of those that whoever started
/// it had it ignore (and of SIGPIPE, by Rust). Without `/proc` none is known.
#[must_use]
pub fn ignored_signals() -> Vec<i32> {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    ignored(&status).collect()
}

/// The numbers in the mask that a process's status tells, of which bit 0 is signal 1.
fn ignored(status: &str) -> impl Iterator<Item = i32> + use<> {
    let mask = status
        .lines()
        .find_map(|line| line.strip_prefix("SigIgn:"))
        .and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok())
        .unwrap_or(0);
    (1..=64).filter(move |signal| mask >> (signal - 1) & 1 == 1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_mask_is_read_as_the_signals_in_it() {
        let read = |status: &str| ignored(status).collect::<Vec<_>>();
        let status =
            "Name:\tztl\nSigBlk:\t0000000000000004\nSigIgn:\t8000000000001006\nSigCgt:\t1\n";
        assert_eq!(read(status), [2, 3, 13, 64]);
        for nothing in ["", "SigIgn:\t0000000000000000\n", "SigIgn:\tx\n"] {
            assert!(read(nothing).is_empty(), "{nothing}");
        }
    }
}
