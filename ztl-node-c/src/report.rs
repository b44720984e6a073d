//! Reports of components, and numbers in goals.

use core::ffi::{c_char, c_int, c_uint};

use ztl_mcu::components::number;

use crate::text::text;

/// Receives a callback's progress, result, or reason to refuse. Valid during that call.
pub struct Report(());

impl Report {
    /// The pointer that represents a node's report in C.
    pub(crate) const fn of(report: &mut ztl_mcu::Report<'_>) -> *mut Self {
        core::ptr::from_mut(report).cast()
    }
}

/// Appends a copy of a text. What does not fit is cut, and the cut is marked. Does nothing if either is NULL
/// or the text is not UTF-8.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn ztl_report_text(report: *mut Report, add: *const c_char) {
    // SAFETY: NULL or a text, as its caller promises.
    let add = unsafe { text(add) };
    // SAFETY: NULL, or the pointer that `Report::of` passed to the calling callback. It is valid until the
    // callback returns, and nobody else uses it meanwhile.
    let report = unsafe { report.cast::<ztl_mcu::Report<'_>>().as_mut() };
    if let (Some(report), Some(add)) = (report, add) {
        report.text(add);
    }
}

/// Appends an integer with a decimal point before its last `decimals` digits (at most 9): 455 with 1 gives
/// 45.5. Does nothing if the report is NULL.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn ztl_report_number(report: *mut Report, value: c_int, decimals: c_uint) {
    // SAFETY: as in `ztl_report_text`.
    let report = unsafe { report.cast::<ztl_mcu::Report<'_>>().as_mut() };
    if let Some(report) = report {
        number::report(report, value, digits(decimals));
    }
}

/// Parses a number such as "45.5" and multiplies it by 10 to the power of `decimals` (at most 9): 455 with 1.
/// Returns 1 if it is a number that fits, else 0 and leaves `value` unchanged. Neither pointer may be NULL;
/// that also returns 0.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn ztl_goal_number(
    goal: *const c_char,
    decimals: c_uint,
    value: *mut c_int,
) -> c_int {
    // SAFETY: NULL or a text, as its caller promises.
    let read = unsafe { text(goal) }.and_then(|goal| number::parse(goal, digits(decimals)));
    match read {
        Some(read) if !value.is_null() => {
            // SAFETY: not NULL, and owned by the caller.
            unsafe { value.write(read) };
            1
        }
        _ => 0,
    }
}

fn digits(decimals: c_uint) -> u8 {
    u8::try_from(decimals).unwrap_or(9).min(9)
}
