//! Ctrl-C and SIGTERM, as a flag that can be waited for; SIGUSR1, as something to do.

use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

struct Flag {
    raised: bool,
    /// Whether raising it once more ends the process.
    impatient: bool,
    /// What is to be done when it is raised.
    then: Option<Box<dyn Fn() + Send>>,
    /// What is to be done before the process ends at the second.
    last: Option<Box<dyn Fn() + Send>>,
}

static FLAG: Mutex<Flag> = Mutex::new(Flag {
    raised: false,
    impatient: false,
    then: None,
    last: None,
});
static CHANGED: Condvar = Condvar::new();

fn flag() -> MutexGuard<'static, Flag> {
    FLAG.lock().unwrap_or_else(PoisonError::into_inner)
}

/// From now on Ctrl-C and SIGTERM only raise the flag. To be called before anything is started or
/// said, so that none of them is missed.
pub(crate) fn catch() -> Result<(), ctrlc::Error> {
    ctrlc::set_handler(|| {
        let mut flag = flag();
        if flag.raised && flag.impatient {
            if let Some(last) = &flag.last {
                last();
            }
            // As a shell reports it.
            std::process::exit(130);
        }
        flag.raised = true;
        if let Some(then) = &flag.then {
            then();
        }
        CHANGED.notify_all();
    })
}

/// What is to be done when somebody wants this process to end; at once if somebody did already.
pub(crate) fn then(act: impl Fn() + Send + 'static) {
    let mut flag = flag();
    if flag.raised {
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

/// Whether somebody wants this process to end.
pub(crate) fn stopped() -> bool {
    flag().raised
}

/// Until somebody wants this process to end.
pub(crate) fn wait() {
    drop(CHANGED.wait_while(flag(), |flag| !flag.raised));
}

/// Until somebody wants this process to end, at most for `limit`; says whether somebody does.
pub(crate) fn wait_for(limit: Duration) -> bool {
    // A limit beyond the end of time is none.
    let limit = limit.min(Duration::from_secs(1 << 32));
    let waited = CHANGED.wait_timeout_while(flag(), limit, |flag| !flag.raised);
    waited.unwrap_or_else(PoisonError::into_inner).0.raised
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
