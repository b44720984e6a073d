//! Signals stay with the program: no thread of this library handles one.

/// Does the work with all signals blocked. Threads started meanwhile keep them blocked.
#[cfg(unix)]
pub(crate) fn blocked<T>(work: impl FnOnce() -> T) -> T {
    use std::mem::MaybeUninit;
    use std::ptr;

    /// Restores the thread's signal mask when dropped, also by a panic.
    struct Before(libc::sigset_t);

    impl Drop for Before {
        fn drop(&mut self) {
            // SAFETY: the set was written by `pthread_sigmask`; the pointer for the old one may be NULL.
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
    // SAFETY: on success, the set is written.
    let before = (done == 0).then(|| Before(unsafe { before.assume_init() }));
    let result = work();
    drop(before);
    result
}

/// There are no signals here.
#[cfg(not(unix))]
pub(crate) fn blocked<T>(work: impl FnOnce() -> T) -> T {
    work()
}
