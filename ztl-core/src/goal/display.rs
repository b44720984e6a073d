//! Text that arrives in pieces from a value's `Display`.

use core::fmt::{Display, Result, Write};

use crate::repr::put_quoted;
use crate::sink::Sink;

/// Writes what `value` displays, unquoted.
pub(super) fn put_display(
    value: &(impl Display + ?Sized),
    sink: &mut (impl Sink + ?Sized),
) -> Result {
    write!(Plain(sink), "{value}")
}

/// Writes what `value` displays, quoted like [`put_quoted`].
pub(super) fn put_quoted_display(
    value: &(impl Display + ?Sized),
    sink: &mut (impl Sink + ?Sized),
) -> Result {
    // The whole text must be seen before the quote can be chosen.
    let mut seen = Seen::default();
    write!(seen, "{value}")?;
    let quote = if seen.single && !seen.double {
        "\""
    } else {
        "'"
    };
    sink.put(quote.as_bytes());
    write!(Quoted { sink, quote }, "{value}")?;
    sink.put(quote.as_bytes());
    Ok(())
}

struct Plain<'s, S: ?Sized>(&'s mut S);

impl<S: Sink + ?Sized> Write for Plain<'_, S> {
    fn write_str(&mut self, piece: &str) -> Result {
        self.0.put(piece.as_bytes());
        Ok(())
    }
}

/// Which quotes occur in a text.
#[derive(Default)]
struct Seen {
    single: bool,
    double: bool,
}

impl Write for Seen {
    fn write_str(&mut self, piece: &str) -> Result {
        self.single |= piece.contains('\'');
        self.double |= piece.contains('"');
        Ok(())
    }
}

struct Quoted<'s, S: ?Sized> {
    sink: &'s mut S,
    quote: &'static str,
}

impl<S: Sink + ?Sized> Write for Quoted<'_, S> {
    fn write_str(&mut self, piece: &str) -> Result {
        for part in piece.split_inclusive(['\'', '"']) {
            let run = part.trim_end_matches(['\'', '"']);
            // A run without quotes gets single ones, which are stripped here.
            put_quoted(run, &mut |bytes: &[u8]| {
                if bytes != b"'" {
                    self.sink.put(bytes);
                }
            });
            let mark = part.get(run.len()..).unwrap_or_default();
            if mark == self.quote {
                self.sink.put(b"\\");
            }
            self.sink.put(mark.as_bytes());
        }
        Ok(())
    }
}
