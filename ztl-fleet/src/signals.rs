//! Ctrl-C and SIGTERM end a command cleanly; the second one ends it at once.

use std::io;
use std::process::ExitCode;
use std::sync::mpsc::Receiver;
#[cfg(unix)]
use std::time::{Duration, Instant};

/// Ctrl-C, which ends a server without an error.
const CTRL_C: u8 = 2;
/// A second signal within this time is the same one: `timeout` sends it to the process and to its group.
#[cfg(unix)]
const TWICE: Duration = Duration::from_millis(50);

/// Call this before anything starts. The first signal arrives here.
#[cfg(unix)]
pub(crate) fn catch() -> io::Result<Receiver<u8>> {
    use signal_hook::consts::{SIGINT, SIGTERM};

    let mut signals = signal_hook::iterator::Signals::new([SIGINT, SIGTERM])?;
    let (sender, receiver) = std::sync::mpsc::channel();
    let thread = std::thread::Builder::new().name("ztl-fleet-signals".to_owned());
    thread.spawn(move || {
        let mut first: Option<Instant> = None;
        for signal in signals.forever() {
            let signal = u8::try_from(signal).unwrap_or(CTRL_C);
            // Without a receiver, or at the second one, nobody ends it in an orderly way.
            if first.is_some_and(|first| first.elapsed() < TWICE) {
                continue;
            }
            if first.is_some() || sender.send(signal).is_err() {
                std::process::exit(number(signal).into());
            }
            first = Some(Instant::now());
        }
    })?;
    Ok(receiver)
}

/// This system ends programs by itself.
#[cfg(not(unix))]
pub(crate) fn catch() -> io::Result<Receiver<u8>> {
    let (sender, receiver) = std::sync::mpsc::channel();
    std::mem::forget(sender);
    Ok(receiver)
}

/// The exit code of a server that a signal ended (docs/tools.md).
pub(crate) fn code(signal: u8) -> ExitCode {
    match signal {
        CTRL_C => ExitCode::SUCCESS,
        other => ExitCode::from(number(other)),
    }
}

/// The exit code of a program that a signal interrupted.
pub(crate) const fn number(signal: u8) -> u8 {
    signal.saturating_add(128)
}
