//! Texts of C.

use core::ffi::{CStr, c_char};

/// Longest name, unit, list of words or list of topics, in bytes.
const LONGEST: usize = 64;

/// Converts a C string; `None` if it is NULL or not UTF-8.
///
/// # Safety
/// `text` is NULL, or ends with a zero and does not change while it is used.
pub(crate) unsafe fn text<'a>(text: *const c_char) -> Option<&'a str> {
    if text.is_null() {
        return None;
    }
    // SAFETY: not NULL; the caller promises the rest.
    let bytes = unsafe { CStr::from_ptr(text) }.to_bytes();
    core::str::from_utf8(bytes).ok()
}

/// Whether a text is usable in a description; if `may_lack`, NULL is too.
///
/// # Safety
/// See [`text`].
pub(crate) unsafe fn is_text(it: *const c_char, may_lack: bool) -> bool {
    // SAFETY: promised by the caller.
    let told = unsafe { text(it) };
    told.map_or(may_lack && it.is_null(), |told| told.len() <= LONGEST)
}
