//! The robot's program keeps its signals: no thread of this library takes one.

/// Does the work with all signals blocked: threads that are started in it have them blocked for good.
#[cfg(unix)]
pub(crate) fn blocked<T>(work: impl FnOnce() -> T) -> T {
    use std::mem::MaybeUninit;
    use std::ptr;

    /// Restores this thread's signals, also after a panic.
    struct Before(libc::sigset_t);

    impl Drop for Before {
        fn drop(&mut self) {
            // SAFETY: a set that `pthread_sigmask` has written; where the old one goes may be NULL.
            unsafe { libc::pthread_sigmask(libc::SIG_SETMASK, &raw const self.0, ptr::null_mut()) };
        }
    }

    let mut all = MaybeUninit::uninit();
    let mut before = MaybeUninit::uninit();
    // SAFETY: both are memory for a set; `sigfillset` writes the first before it is read.
    let done = unsafe {
        libc::sigfillset(all.as_mut_ptr());
        libc::pthread_sigmask(libc::SIG_SETMASK, all.as_ptr(), before.as_mut_ptr())
    };
    // SAFETY: when it says 0 it has written the set.
    let before = (done == 0).then(|| Before(unsafe { before.assume_init() }));
    let result = work();
    drop(before);
    result
}

/// The same where there are none.
#[cfg(not(unix))]
pub(crate) fn blocked<T>(work: impl FnOnce() -> T) -> T {
    work()
}
