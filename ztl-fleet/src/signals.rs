//! Ctrl-C and SIGTERM end a command cleanly; the second one ends it at once.

use std::io;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::Receiver;
#[cfg(unix)]
use std::time::{Duration, Instant};

/// Ctrl-C, which ends a server without an error.
const CTRL_C: u8 = 2;
/// A second signal within this time is the same one: `timeout` sends it to the process and to its group.
#[cfg(unix)]
const TWICE: Duration = Duration::from_millis(50);

/// Signals from now on.
pub(crate) struct Signals {
    receiver: Receiver<u8>,
    are_awaited: Arc<AtomicBool>,
}

impl Signals {
    /// What has begun ends in order now: the first signal arrives here. Before, as while no router is reached, it ends the
    /// process at once.
    pub(crate) fn awaited(self) -> Receiver<u8> {
        self.are_awaited.store(true, Ordering::SeqCst);
        self.receiver
    }
}

/// Call this before anything starts.
#[cfg(unix)]
pub(crate) fn catch() -> io::Result<Signals> {
    use signal_hook::consts::{SIGINT, SIGTERM};

    let mut signals = signal_hook::iterator::Signals::new([SIGINT, SIGTERM])?;
    let (sender, receiver) = std::sync::mpsc::channel();
    let are_awaited = Arc::new(AtomicBool::new(false));
    let awaited = Arc::clone(&are_awaited);
    let thread = std::thread::Builder::new().name("ztl-fleet-signals".to_owned());
    thread.spawn(move || {
        let mut first: Option<Instant> = None;
        for signal in signals.forever() {
            let signal = u8::try_from(signal).unwrap_or(CTRL_C);
            if !awaited.load(Ordering::SeqCst) {
                std::process::exit(code_number(signal).into());
            }
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
    Ok(Signals {
        receiver,
        are_awaited,
    })
}

/// This system ends programs by itself.
#[cfg(not(unix))]
pub(crate) fn catch() -> io::Result<Signals> {
    let (sender, receiver) = std::sync::mpsc::channel();
    std::mem::forget(sender);
    Ok(Signals {
        receiver,
        are_awaited: Arc::default(),
    })
}

/// The exit code of a server that a signal ended (docs/tools.md).
pub(crate) fn code(signal: u8) -> ExitCode {
    ExitCode::from(code_number(signal))
}

const fn code_number(signal: u8) -> u8 {
    match signal {
        CTRL_C => 0,
        other => number(other),
    }
}

/// The exit code of a program that a signal interrupted.
pub(crate) const fn number(signal: u8) -> u8 {
    signal.saturating_add(128)
}
