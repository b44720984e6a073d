//! Ctrl-C and SIGTERM, as a flag that can be waited for.

use std::sync::{Condvar, Mutex, PoisonError};

static STOPPED: Mutex<bool> = Mutex::new(false);
static CHANGED: Condvar = Condvar::new();

/// From now on Ctrl-C and SIGTERM only raise the flag, and call `also`.
pub(crate) fn catch(also: impl Fn() + Send + 'static) -> Result<(), ctrlc::Error> {
    ctrlc::set_handler(move || {
        *STOPPED.lock().unwrap_or_else(PoisonError::into_inner) = true;
        CHANGED.notify_all();
        also();
    })
}

/// Whether somebody wants this process to end.
pub(crate) fn stopped() -> bool {
    *STOPPED.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Until somebody wants this process to end.
pub(crate) fn wait() {
    let flag = STOPPED.lock().unwrap_or_else(PoisonError::into_inner);
    drop(CHANGED.wait_while(flag, |stopped| !*stopped));
}
