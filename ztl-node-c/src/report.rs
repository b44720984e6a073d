//! What components report, and numbers in goals.

use core::ffi::{c_char, c_int, c_uint};

use ztl_mcu::components::number;

use crate::part::text;

/// Where a callback writes progress, result, or the reason to refuse. Valid for that call.
pub struct Report(());

impl Report {
    /// What C is given in place of a node's report.
    pub(crate) const fn of(report: &mut ztl_mcu::Report<'_>) -> *mut Self {
        core::ptr::from_mut(report).cast()
    }
}

/// Adds a text, which is copied; what does not fit is cut, and marked. Nothing happens when either is NULL, or
/// the text is no UTF-8.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn ztl_report_text(report: *mut Report, add: *const c_char) {
    // SAFETY: NULL or a text, as its caller promises.
    let add = unsafe { text(add) };
    // SAFETY: NULL, or what `Report::of` gave to the callback that calls this, which lasts until it returns;
    // nobody else uses it meanwhile.
    let report = unsafe { report.cast::<ztl_mcu::Report<'_>>().as_mut() };
    if let (Some(report), Some(add)) = (report, add) {
        report.text(add);
    }
}

/// Adds a whole number with the point before its last `decimals` digits (at most 9): 455 with one is 45.5.
/// Nothing happens when the report is NULL.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn ztl_report_number(report: *mut Report, value: c_int, decimals: c_uint) {
    // SAFETY: as in `ztl_report_text`.
    let report = unsafe { report.cast::<ztl_mcu::Report<'_>>().as_mut() };
    if let Some(report) = report {
        number::report(report, value, digits(decimals));
    }
}

/// Reads a number, as "45.5", times 10 for each of `decimals` (at most 9): 455 with one. 1 when it is a number
/// that fits; else 0, and `value` is left as it is. Neither may be NULL, which is 0 too.
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
            // SAFETY: not NULL, and the caller's.
            unsafe { value.write(read) };
            1
        }
        _ => 0,
    }
}

fn digits(decimals: c_uint) -> u8 {
    u8::try_from(decimals).unwrap_or(9).min(9)
}
