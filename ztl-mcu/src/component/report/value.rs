//! Values as text that programs read, whole or not at all.

use core::cell::Cell;

use ztl_core::goal::{Fixed, Floats, WriteError, to_sink_with};
use ztl_core::sink::{BufferTooSmall, Sink};

use super::Report;

/// Writes the value, if all of its text fits and all of its numbers are finite.
pub(super) fn write<T: serde::Serialize + ?Sized>(
    report: &mut Report<'_>,
    value: &T,
    decimals: u8,
) -> Result<(), WriteError> {
    let finite = Cell::new(true);
    let floats = Finite {
        format: Fixed(decimals),
        finite: &finite,
    };
    let mut trial = Trial {
        len: report.text.len(),
        report: None,
    };
    to_sink_with(value, floats, &mut trial)?;
    if !finite.get() {
        return Err(WriteError::NotFinite);
    }
    let (needed, available) = (trial.len, report.room());
    if report.cut || needed > available {
        return Err(WriteError::BufferTooSmall(BufferTooSmall::new(
            needed, available,
        )));
    }
    trial.report = Some(report);
    to_sink_with(value, floats, &mut trial)
}

/// Counts bytes, and passes them on if there is a report. One type for both, so that the code is there once.
struct Trial<'t, 'r> {
    len: usize,
    report: Option<&'t mut Report<'r>>,
}

impl Sink for Trial<'_, '_> {
    fn put(&mut self, bytes: &[u8]) {
        self.len = self.len.saturating_add(bytes.len());
        if let Some(report) = &mut self.report {
            report.put(bytes);
        }
    }
}

/// A format that notices numbers that are not finite.
#[derive(Clone, Copy)]
struct Finite<'c> {
    format: Fixed,
    finite: &'c Cell<bool>,
}

impl Floats for Finite<'_> {
    fn put_f32(self, value: f32, sink: &mut (impl Sink + ?Sized)) {
        self.finite.set(self.finite.get() && value.is_finite());
        self.format.put_f32(value, sink);
    }

    fn put_f64(self, value: f64, sink: &mut (impl Sink + ?Sized)) {
        self.finite.set(self.finite.get() && value.is_finite());
        self.format.put_f64(value, sink);
    }
}
