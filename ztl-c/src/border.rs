//! The border between C and Rust: texts pass, panics do not.

use std::ffi::{CStr, CString, c_char, c_void};
use std::panic::{AssertUnwindSafe, catch_unwind};

use crate::error::{Failure, ZTL_E_ARGUMENT, ZTL_E_NULL};

/// Does the work, and stops a panic, which is a mistake in this library.
pub(crate) fn guard<T>(after_panic: T, work: impl FnOnce() -> T) -> T {
    // All state is behind locks, whose poison is ignored: each change under a lock is a single step.
    catch_unwind(AssertUnwindSafe(work)).unwrap_or(after_panic)
}

/// A text from C; `name` is the argument's.
///
/// # Safety
/// `text` is NULL, or ends with a zero and is not changed while it is used.
pub(crate) unsafe fn text<'a>(text: *const c_char, name: &str) -> Result<&'a str, Failure> {
    if text.is_null() {
        return Err(null(name));
    }
    // SAFETY: not NULL; all else is promised by the caller.
    let text = unsafe { CStr::from_ptr(text) };
    text.to_str().map_err(|error| {
        let at = error.valid_up_to();
        Failure::new(ZTL_E_ARGUMENT, format!("{name} is not UTF-8 at byte {at}"))
    })
}

/// The failure of an argument that must not be NULL.
pub(crate) fn null(name: &str) -> Failure {
    Failure::new(ZTL_E_NULL, format!("{name} is NULL"))
}

/// A text for C. A zero in it, which would end it there, becomes U+FFFD.
pub(crate) fn for_c(text: &str) -> CString {
    CString::new(text.replace('\0', "\u{fffd}")).unwrap_or_default()
}

/// Writes as much of a text as fits, with a zero at the end; returns the length of the whole text.
///
/// # Safety
/// `buffer` is NULL, or has `size` bytes that nothing else uses meanwhile.
pub(crate) unsafe fn copy_out(text: &str, buffer: *mut c_char, size: usize) -> usize {
    let text = text.split('\0').next().unwrap_or_default();
    if !buffer.is_null() && size > 0 {
        let fitting = text.floor_char_boundary(size - 1);
        // SAFETY: `fitting` is below `size`, so it and the zero are within the buffer, which does not overlap
        // with the text.
        unsafe {
            std::ptr::copy_nonoverlapping(text.as_ptr().cast(), buffer, fitting);
            buffer.add(fitting).write(0);
        }
    }
    text.len()
}

/// A pointer of the program, which the library never follows.
#[derive(Clone, Copy)]
pub(crate) struct Context(pub(crate) *mut c_void);

// SAFETY: it is only passed to the program's callbacks, which the header says may be called on any thread.
unsafe impl Send for Context {}
// SAFETY: as above.
unsafe impl Sync for Context {}
