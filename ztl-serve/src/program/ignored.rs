//! Signals that this process was started to ignore. A shell starts background processes with INT and QUIT ignored,
//! `nohup` with HUP. Programs would inherit that, and these signals could not stop them.

use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use signal_hook::consts::FORBIDDEN;
use signal_hook::flag;

/// Replaces each ignored signal by a handler that does nothing, which children do not inherit.
///
/// Does nothing without `/proc`.
pub(crate) fn do_not_inherit() {
    for signal in ignored_signals() {
        if !FORBIDDEN.contains(&signal) {
            // Fails for the signals that the C library uses itself.
            let _ = flag::register(signal, Arc::new(AtomicBool::new(false)));
        }
    }
}

/// The numbers of the signals that this process ignores. At its start, these are the ones that it was started to
/// ignore, and SIGPIPE, which Rust ignores. Empty without `/proc`.
#[must_use]
pub fn ignored_signals() -> Vec<i32> {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    ignored(&status).collect()
}

/// Signals of the mask in a process's status, where bit 0 is signal 1.
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
    fn the_mask_gives_the_ignored_signals() {
        let read = |status: &str| ignored(status).collect::<Vec<_>>();
        let status =
            "Name:\tztl\nSigBlk:\t0000000000000004\nSigIgn:\t8000000000001006\nSigCgt:\t1\n";
        assert_eq!(read(status), [2, 3, 13, 64]);
        for nothing in ["", "SigIgn:\t0000000000000000\n", "SigIgn:\tx\n"] {
            assert!(read(nothing).is_empty(), "{nothing}");
        }
    }
}
