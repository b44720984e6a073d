//! Lines on stdout. A reader that has gone (`| head`) is no error of ours.

use std::fmt::Display;
use std::io::{IsTerminal, Write};

/// Prints a line at once, also into a pipe.
pub(crate) fn line(text: impl Display) {
    let mut out = std::io::stdout().lock();
    let _ = writeln!(out, "{text}").and_then(|()| out.flush());
}

/// Prints without ending the line.
pub(crate) fn part(text: impl Display) {
    let mut out = std::io::stdout().lock();
    let _ = write!(out, "{text}").and_then(|()| out.flush());
}

/// Whether a person sees stdout, so that lines can be rewritten.
pub(crate) fn is_live() -> bool {
    std::io::stdout().is_terminal()
}

/// Writes over the line that the cursor is in, cut where it would wrap: that would be two to the
/// cursor.
pub(crate) fn rewrite(text: &str, end: &str) {
    let width = terminal_size::terminal_size().map_or(80, |(width, _)| usize::from(width.0));
    let text: String = text.chars().take(width).collect();
    part(format_args!("\r\x1b[K{text}{end}"));
}
