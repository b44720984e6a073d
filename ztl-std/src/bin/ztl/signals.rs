//! Ctrl-C and SIGTERM, as a flag that can be waited for.

use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};

struct Flag {
    raised: bool,
    /// What is to be done when it is raised.
    then: Option<Box<dyn Fn() + Send>>,
}

static FLAG: Mutex<Flag> = Mutex::new(Flag {
    raised: false,
    then: None,
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

/// Whether somebody wants this process to end.
pub(crate) fn stopped() -> bool {
    flag().raised
}

/// Until somebody wants this process to end.
pub(crate) fn wait() {
    drop(CHANGED.wait_while(flag(), |flag| !flag.raised));
}
