//! Signals: Ctrl-C, SIGTERM and SIGHUP set a flag; SIGUSR1 calls a function.

use std::process::ExitCode;
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use crate::key_press::LastPress;

struct Flag {
    /// When the flag was set, and by which signal.
    raised: Option<(Instant, u8)>,
    /// Whether a second signal ends the process.
    impatient: bool,
    /// Called when the flag is set.
    then: Option<Box<dyn Fn() + Send>>,
    /// Called before a second signal ends the process.
    last: Option<Box<dyn Fn() + Send>>,
    /// How long the process may live after a second signal, if that does not end it at once.
    patience: Option<Duration>,
    /// Ignores repeats of Ctrl-C while it is held down, if set.
    held: Option<Option<LastPress>>,
}

/// A second signal within this time is the same one: `timeout` sends it to the process and to its group.
const TWICE: Duration = Duration::from_millis(50);

/// How long the last function may take before the process ends.
const LAST: Duration = Duration::from_millis(500);

/// Ctrl-C, which a person can press again.
const CTRL_C: u8 = 2;

/// SIGHUP: the terminal is gone.
const HANG_UP: u8 = 1;

static FLAG: Mutex<Flag> = Mutex::new(Flag {
    raised: None,
    impatient: false,
    then: None,
    last: None,
    patience: None,
    held: None,
});
static CHANGED: Condvar = Condvar::new();

fn flag() -> MutexGuard<'static, Flag> {
    FLAG.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Makes Ctrl-C, SIGTERM and SIGHUP set the flag. Call this before anything starts, so that no signal is missed.
/// Under `nohup`, SIGHUP stays ignored.
#[cfg(unix)]
pub(crate) fn catch() -> std::io::Result<()> {
    use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};

    let mut caught = vec![SIGINT, SIGTERM, SIGHUP];
    if ztl_serve::ignored_signals().contains(&SIGHUP) {
        caught.retain(|signal| *signal != SIGHUP);
    }
    let mut signals = signal_hook::iterator::Signals::new(caught)?;
    std::thread::Builder::new()
        .name("ztl-signals".to_owned())
        .spawn(move || {
            let number = |signal| u8::try_from(signal).unwrap_or(CTRL_C);
            for signal in signals.forever() {
                if signal != SIGHUP || !reload() {
                    on_signal(number(signal));
                }
            }
        })?;
    Ok(())
}

/// What SIGHUP does.
#[cfg(unix)]
struct Reload {
    ask: std::sync::mpsc::Sender<()>,
    /// Whether this process was started from a terminal.
    of_terminal: bool,
}

#[cfg(unix)]
static RELOAD: Mutex<Option<Reload>> = Mutex::new(None);

/// Whether this process has a controlling terminal.
#[cfg(unix)]
fn has_terminal() -> bool {
    std::fs::File::open("/dev/tty").is_ok()
}

/// Requests a reload, unless the terminal is gone: then SIGHUP ends the process.
#[cfg(unix)]
fn reload() -> bool {
    let reload = RELOAD.lock().unwrap_or_else(PoisonError::into_inner);
    match &*reload {
        Some(reload) if !reload.of_terminal || has_terminal() => reload.ask.send(()).is_ok(),
        _ => false,
    }
}

/// Makes SIGHUP call `act` on a thread of its own, unless the terminal is gone.
#[cfg(unix)]
pub(crate) fn at_reload(mut act: impl FnMut() + Send + 'static) -> std::io::Result<()> {
    let (ask, asked) = std::sync::mpsc::channel();
    std::thread::Builder::new()
        .name("ztl-reload".to_owned())
        .spawn(move || asked.iter().for_each(|()| act()))?;
    let of_terminal = has_terminal();
    let mut reload = RELOAD.lock().unwrap_or_else(PoisonError::into_inner);
    *reload = Some(Reload { ask, of_terminal });
    Ok(())
}

/// This system has no such signal.
#[cfg(not(unix))]
pub(crate) fn at_reload(_act: impl FnMut() + Send + 'static) -> std::io::Result<()> {
    Ok(())
}

/// Makes Ctrl-C set the flag. Call this before anything starts, so that none is missed.
#[cfg(not(unix))]
pub(crate) fn catch() -> Result<(), ctrlc::Error> {
    ctrlc::set_handler(|| on_signal(CTRL_C))
}

/// Acts as SIGHUP does: the terminal is gone, but only the shell may have got the signal. If SIGHUP is ignored, only
/// an `attended` run ends, because nobody can answer its questions.
pub(crate) fn hang_up(attended: bool) {
    #[cfg(unix)]
    let ignored = ztl_serve::ignored_signals().contains(&i32::from(HANG_UP));
    #[cfg(not(unix))]
    let ignored = false;
    if attended || !ignored {
        on_signal(HANG_UP);
    }
}

/// Handles a signal to end. SIGHUP is never the second one: the system and a shell may each send it once.
fn on_signal(signal: u8) {
    let mut flag = flag();
    let now = Instant::now();
    if flag.raised.is_some() && signal == HANG_UP {
        return;
    }
    if flag.raised.is_some() && flag.impatient {
        if flag.is_doubled(now) {
            return;
        }
        if let Some(last) = &flag.last {
            last();
        }
        std::process::exit(code(signal).into());
    }
    if flag.is_repeated(now) {
        return;
    }
    if flag.raised.is_some() {
        flag.leave_soon(code(signal));
    }
    flag.raised.get_or_insert((now, signal));
    if let Some(then) = &flag.then {
        then();
    }
    CHANGED.notify_all();
}

impl Flag {
    /// Whether a signal is the first one, sent twice.
    fn is_doubled(&self, now: Instant) -> bool {
        let since = self.raised.map(|(at, _)| now.saturating_duration_since(at));
        since.is_some_and(|since| since < TWICE)
    }

    /// Whether a signal comes from a key that is held down.
    fn is_repeated(&mut self, now: Instant) -> bool {
        let Some(last) = &mut self.held else {
            return false;
        };
        let press = LastPress::after(*last, now, Duration::ZERO);
        *last = Some(press);
        press.is_repeat()
    }

    /// Ends the process after `patience`.
    fn leave_soon(&mut self, code: u8) {
        let Some(patience) = self.patience.take() else {
            return;
        };
        let last = self.last.take();
        let leave = move || {
            std::thread::sleep(patience);
            if let Some(last) = last {
                // A stopped terminal must not block the end.
                let (done, wait) = std::sync::mpsc::channel();
                let _ = std::thread::Builder::new().spawn(move || {
                    last();
                    done.send(())
                });
                let _ = wait.recv_timeout(LAST);
            }
            std::process::exit(code.into());
        };
        let thread = std::thread::Builder::new().name("ztl-leave".to_owned());
        if thread.spawn(leave).is_err() {
            std::process::exit(code.into());
        }
    }
}

/// Calls `act` at a signal; at once if one came before.
pub(crate) fn then(act: impl Fn() + Send + 'static) {
    let mut flag = flag();
    if flag.raised.is_some() {
        act();
    }
    flag.then = Some(Box::new(act));
}

/// Makes a second signal end the process at once.
pub(crate) fn leave_at_the_second() {
    flag().impatient = true;
}

/// Makes a second signal call `act` and end the process at once.
pub(crate) fn leave_at_the_second_after(act: impl Fn() + Send + 'static) {
    let mut flag = flag();
    flag.impatient = true;
    flag.last = Some(Box::new(act));
}

/// Makes a second signal call the function of [`then`] again, and end the process after `patience`, with `act` before
/// that. `keys`: ignores repeats of a key that is held down.
pub(crate) fn leave_soon_after_the_second(
    patience: Duration,
    keys: bool,
    act: impl Fn() + Send + 'static,
) {
    let mut flag = flag();
    flag.patience = Some(patience);
    flag.held = keys.then_some(None);
    flag.last = Some(Box::new(act));
}

/// Whether a signal came.
pub(crate) fn stopped() -> bool {
    flag().raised.is_some()
}

/// The exit code of a process that a signal ends, as a shell reports it.
const fn code(signal: u8) -> u8 {
    128 + signal
}

/// The exit code if a signal came: 130 for Ctrl-C, 143 for SIGTERM.
pub(crate) fn exit_code() -> Option<ExitCode> {
    flag()
        .raised
        .map(|(_, signal)| ExitCode::from(code(signal)))
}

/// The exit code of a command that runs until it is stopped: `usual` for Ctrl-C.
pub(crate) fn exit_code_or(usual: ExitCode) -> ExitCode {
    let asked = exit_code().filter(|_| in_a_hurry());
    asked.unwrap_or(usual)
}

/// Whether a signal other than Ctrl-C came, so that the process may be killed soon.
pub(crate) fn in_a_hurry() -> bool {
    flag().raised.is_some_and(|(_, signal)| signal != CTRL_C)
}

/// Waits for a signal.
pub(crate) fn wait() {
    drop(CHANGED.wait_while(flag(), |flag| flag.raised.is_none()));
}

/// Waits for a signal, at most for `limit`. Returns whether one came.
pub(crate) fn wait_for(limit: Duration) -> bool {
    // Longer limits would overflow.
    let limit = limit.min(Duration::from_secs(1 << 32));
    let waited = CHANGED.wait_timeout_while(flag(), limit, |flag| flag.raised.is_none());
    waited
        .unwrap_or_else(PoisonError::into_inner)
        .0
        .raised
        .is_some()
}

/// Calls `act` at each SIGUSR1, on a thread of its own.
#[cfg(unix)]
pub(crate) fn at_usr1(mut act: impl FnMut() + Send + 'static) -> std::io::Result<()> {
    let mut signals = signal_hook::iterator::Signals::new([signal_hook::consts::SIGUSR1])?;
    std::thread::Builder::new()
        .name("ztl-usr1".to_owned())
        .spawn(move || signals.forever().for_each(|_| act()))?;
    Ok(())
}

/// This system has no such signal.
#[cfg(not(unix))]
pub(crate) fn at_usr1(_act: impl FnMut() + Send + 'static) -> std::io::Result<()> {
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn flag_of(held: Option<Option<LastPress>>) -> Flag {
        Flag {
            raised: None,
            impatient: false,
            then: None,
            last: None,
            patience: None,
            held,
        }
    }

    #[test]
    fn a_signal_sent_twice_counts_once() {
        let mut flag = flag_of(None);
        let start = Instant::now();
        assert!(!flag.is_doubled(start));
        flag.raised = Some((start, CTRL_C));
        assert!(flag.is_doubled(start));
        assert!(flag.is_doubled(start + Duration::from_millis(49)));
        assert!(!flag.is_doubled(start + Duration::from_millis(50)));
    }

    #[test]
    fn a_held_key_is_one_signal_and_a_second_press_another() {
        let mut flag = flag_of(Some(None));
        let start = Instant::now();
        let mut at = |ms| flag.is_repeated(start + Duration::from_millis(ms));
        assert!(!at(0));
        // As a keyboard repeats it.
        for ms in [660, 700, 740, 780] {
            assert!(at(ms), "{ms}");
        }
        assert!(!at(1100));
        assert!(!at(1800));
        flag.held = None;
        assert!(!flag.is_repeated(start));
        assert!(!flag.is_repeated(start), "a program's, not a key's");
    }
}
