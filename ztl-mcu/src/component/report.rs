//! What a component says of its task.

#[cfg(feature = "serde")]
mod value;

use heapless::string::StringView;
use ztl_core::sink::{Sink, SliceSink, put_fixed};
#[cfg(feature = "serde")]
use ztl_core::tasks::CUT;
use ztl_core::tasks::push_cut;

/// A component's progress, result, or reason for a refusal, in a buffer of fixed length.
///
/// Text that does not fit is cut and ends in `…`; the last 3 bytes are reserved for that mark. Each call starts
/// with an empty report.
#[derive(Debug)]
pub struct Report<'a> {
    text: &'a mut StringView,
    cut: bool,
}

impl<'a> Report<'a> {
    /// An empty report, stored in `text`. The node creates them; tests of a component may.
    pub fn new(text: &'a mut StringView) -> Self {
        text.clear();
        Self { text, cut: false }
    }

    /// The text written so far.
    #[must_use]
    pub fn as_str(&self) -> &str {
        self.text
    }

    /// Bytes that fit in all, without the mark of a cut.
    #[cfg(feature = "serde")]
    fn room(&self) -> usize {
        self.text.capacity().saturating_sub(CUT.len())
    }

    /// Whether text was cut, because it did not fit.
    #[must_use]
    pub const fn is_cut(&self) -> bool {
        self.cut
    }

    /// Adds text.
    pub fn text(&mut self, text: &str) {
        if self.cut {
            return;
        }
        self.cut = push_cut(self.text, text);
    }

    /// Adds a number with this many decimals (at most 6).
    pub fn number(&mut self, value: f32, decimals: u8) {
        let mut buffer = [0; 32];
        let mut sink = SliceSink::new(&mut buffer);
        put_fixed(&mut sink, value, decimals);
        let digits = sink.finish().unwrap_or_default();
        self.text(core::str::from_utf8(digits).unwrap_or_default());
    }

    /// Adds a value as text that programs read: a struct as a mapping, numbers with this many decimals
    /// ([`ztl_core::goal`] describes the format).
    ///
    /// ```
    /// # let mut text = ztl_mcu::Reason::new();
    /// # let mut report = ztl_mcu::Report::new(&mut text);
    /// #[derive(serde::Serialize)]
    /// struct Grip { width: f32, held: bool }
    ///
    /// report.value(&Grip { width: 20.25, held: true }, 1)?;
    /// assert_eq!(report.as_str(), "{'width': 20.2, 'held': True}");
    /// # Ok::<(), ztl_mcu::WriteError>(())
    /// ```
    ///
    /// # Errors
    /// [`WriteError`](crate::WriteError) if the value has too many levels, its own code fails, the text does not fit, or a
    /// number is infinite or not a number, which programs cannot read. The report then stays as it was.
    #[cfg(feature = "serde")]
    pub fn value<T>(&mut self, value: &T, decimals: u8) -> Result<(), ztl_core::goal::WriteError>
    where
        T: serde::Serialize + ?Sized,
    {
        value::write(self, value, decimals)
    }
}

/// Each piece must be valid UTF-8.
impl Sink for Report<'_> {
    fn put(&mut self, bytes: &[u8]) {
        self.text(core::str::from_utf8(bytes).unwrap_or_default());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[cfg(feature = "serde")]
    #[test]
    fn a_value_that_programs_cannot_read_is_an_error_and_leaves_the_report() {
        use ztl_core::goal::WriteError;
        use ztl_core::sink::BufferTooSmall;

        let mut text = heapless::String::<15>::new();
        let mut report = Report::new(&mut text);
        report.text("at ");
        let too_long = Err(WriteError::BufferTooSmall(BufferTooSmall::new(15, 12)));
        for (value, result) in [
            ([1.0, f32::NAN], Err(WriteError::NotFinite)),
            ([f32::NEG_INFINITY, 1.0], Err(WriteError::NotFinite)),
            ([10.0, 12.5], too_long),
        ] {
            assert_eq!(report.value(&value, 1), result);
            assert_eq!(report.as_str(), "at ");
        }
        assert_eq!(report.value(&[1.0, 2.5], 0), Ok(()));
        assert_eq!(report.as_str(), "at [1, 2]");
        report.text(", or longer");
        assert!(matches!(
            report.value(&1.0, 0),
            Err(WriteError::BufferTooSmall(_))
        ));
    }

    #[test]
    fn an_oversized_report_is_truncated_and_marked() {
        for (parts, expected) in [
            (&["12345678"][..], "12345678"),
            (&["123456789"], "12345678…"),
            (&["1234567", "89", "10"], "12345678…"),
            (&["1234567", "ä", "x"], "1234567…"),
            (&["ääää", "x", "y"], "ääää…"),
        ] {
            let mut text = heapless::String::<11>::new();
            let mut report = Report::new(&mut text);
            for part in parts {
                report.text(part);
            }
            assert_eq!(text.as_str(), expected);
        }
    }
}
