//! Ctrl-C and SIGTERM, as a flag that can be waited for; SIGUSR1, as something to do.

use std::process::ExitCode;
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use crate::key_press::LastPress;

struct Flag {
    /// When it was raised, and by which signal.
    raised: Option<(Instant, u8)>,
    /// Whether raising it once more ends the process.
    impatient: bool,
    /// What is to be done when it is raised.
    then: Option<Box<dyn Fn() + Send>>,
    /// What is to be done before the process ends at the second.
    last: Option<Box<dyn Fn() + Send>>,
    /// How long the second may take, where it is not obeyed at once.
    patience: Option<Duration>,
    /// Ignores repeats of Ctrl-C while it is held down, if set.
    held: Option<Option<LastPress>>,
}

/// A signal that comes so soon after the first is the same one, sent twice: as by `timeout`, once to the
/// process and once to its group.
const TWICE: Duration = Duration::from_millis(50);

/// How long what is done at last may take, where the process is ended however it stands.
const LAST: Duration = Duration::from_millis(500);

/// Ctrl-C's signal: a person is there, and can press it again.
const CTRL_C: u8 = 2;

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

/// From now on Ctrl-C, SIGTERM and a hang-up only raise the flag. To be called before anything is started or
/// said, so that none of them is missed. Under `nohup`, a hang-up goes on to be nothing.
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

/// What a hang-up asks to be done.
#[cfg(unix)]
struct Reload {
    ask: std::sync::mpsc::Sender<()>,
    /// Whether this process was started from a terminal.
    of_terminal: bool,
}

#[cfg(unix)]
static RELOAD: Mutex<Option<Reload>> = Mutex::new(None);

/// Whether this process has a terminal, wherever its output goes.
#[cfg(unix)]
fn has_terminal() -> bool {
    std::fs::File::open("/dev/tty").is_ok()
}

/// Asks for what a SIGHUP means, if it means that: where the terminal is gone it means the end.
#[cfg(unix)]
fn reload() -> bool {
    let reload = RELOAD.lock().unwrap_or_else(PoisonError::into_inner);
    match &*reload {
        Some(reload) if !reload.of_terminal || has_terminal() => reload.ask.send(()).is_ok(),
        _ => false,
    }
}

/// From now on SIGHUP calls `act`, on a thread of its own, unless it says that the terminal is gone.
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

/// There is no such signal here.
#[cfg(not(unix))]
pub(crate) fn at_reload(_act: impl FnMut() + Send + 'static) -> std::io::Result<()> {
    Ok(())
}

/// From now on Ctrl-C only raises the flag. To be called before anything is started or said, so that none is
/// missed.
#[cfg(not(unix))]
pub(crate) fn catch() -> Result<(), ctrlc::Error> {
    ctrlc::set_handler(|| on_signal(CTRL_C))
}

/// Somebody wants this process to end.
fn on_signal(signal: u8) {
    let mut flag = flag();
    let now = Instant::now();
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
    /// Whether a signal is the first one once more.
    fn is_doubled(&self, now: Instant) -> bool {
        let since = self.raised.map(|(at, _)| now.saturating_duration_since(at));
        since.is_some_and(|since| since < TWICE)
    }

    /// Whether a signal comes of a key that is held down.
    fn is_repeated(&mut self, now: Instant) -> bool {
        let Some(last) = &mut self.held else {
            return false;
        };
        let press = LastPress::after(*last, now, Duration::ZERO);
        *last = Some(press);
        press.is_repeat()
    }

    /// Ends the process a little later, if it is not ended by then.
    fn leave_soon(&mut self, code: u8) {
        let Some(patience) = self.patience.take() else {
            return;
        };
        let last = self.last.take();
        let leave = move || {
            std::thread::sleep(patience);
            if let Some(last) = last {
                // A terminal that stands still keeps nobody.
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

/// What is to be done when somebody wants this process to end; at once if somebody did already.
pub(crate) fn then(act: impl Fn() + Send + 'static) {
    let mut flag = flag();
    if flag.raised.is_some() {
        act();
    }
    flag.then = Some(Box::new(act));
}

/// From now on a second signal ends the process at once, whatever it is doing.
pub(crate) fn leave_at_the_second() {
    flag().impatient = true;
}

/// The same; before that, `act` is done.
#[cfg(unix)]
pub(crate) fn leave_at_the_second_after(act: impl Fn() + Send + 'static) {
    let mut flag = flag();
    flag.impatient = true;
    flag.last = Some(Box::new(act));
}

/// From now on a second signal does again what [`then`] says, and ends the process when it still lives
/// after `patience`, however it stands; before that, `act` is done, as far as it can be. `keys`: the repeats
/// of a key that is held down are no signals.
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

/// Whether somebody wants this process to end.
pub(crate) fn stopped() -> bool {
    flag().raised.is_some()
}

/// The exit code of a process that a signal ends, as a shell reports it.
const fn code(signal: u8) -> u8 {
    128 + signal
}

/// The exit code when a signal has asked this process to end: 130 for Ctrl-C, 143 for SIGTERM.
pub(crate) fn exit_code() -> Option<ExitCode> {
    flag()
        .raised
        .map(|(_, signal)| ExitCode::from(code(signal)))
}

/// The exit code of something that goes on until it is asked to end: `usual` for Ctrl-C, which is
/// how a person ends it.
pub(crate) fn exit_code_or(usual: ExitCode) -> ExitCode {
    let asked = exit_code().filter(|_| in_a_hurry());
    asked.unwrap_or(usual)
}

/// Whether it is no person at a terminal who wants this process to end: it will be killed soon.
pub(crate) fn in_a_hurry() -> bool {
    flag().raised.is_some_and(|(_, signal)| signal != CTRL_C)
}

/// Until somebody wants this process to end.
pub(crate) fn wait() {
    drop(CHANGED.wait_while(flag(), |flag| flag.raised.is_none()));
}

/// Until somebody wants this process to end, at most for `limit`; says whether somebody does.
pub(crate) fn wait_for(limit: Duration) -> bool {
    // A limit beyond the end of time is none.
    let limit = limit.min(Duration::from_secs(1 << 32));
    let waited = CHANGED.wait_timeout_while(flag(), limit, |flag| flag.raised.is_none());
    waited
        .unwrap_or_else(PoisonError::into_inner)
        .0
        .raised
        .is_some()
}

/// What is to be done at each SIGUSR1, on a thread of its own.
#[cfg(unix)]
pub(crate) fn at_usr1(mut act: impl FnMut() + Send + 'static) -> std::io::Result<()> {
    let mut signals = signal_hook::iterator::Signals::new([signal_hook::consts::SIGUSR1])?;
    std::thread::Builder::new()
        .name("ztl-usr1".to_owned())
        .spawn(move || signals.forever().for_each(|_| act()))?;
    Ok(())
}

/// There is no such signal here.
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
    fn a_signal_that_is_sent_twice_at_once_is_one() {
        let mut flag = flag_of(None);
        let start = Instant::now();
        assert!(!flag.is_doubled(start));
        flag.raised = Some((start, CTRL_C));
        assert!(flag.is_doubled(start));
        assert!(flag.is_doubled(start + Duration::from_millis(49)));
        assert!(!flag.is_doubled(start + Duration::from_millis(50)));
    }

    #[test]
    fn a_key_that_is_held_down_is_one_signal_and_pressed_again_another() {
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
