//! Lines on stdout. A reader that has gone (`| head`) is no error of ours.

use std::fmt::Display;
use std::io::{IsTerminal, Write};

use ztl_std::State;

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

/// The state's name, in colour where a person sees it and has not declined that (`NO_COLOR`).
pub(crate) fn painted(state: State) -> String {
    let declined = |name| std::env::var_os(name).is_some_and(|value| !value.is_empty());
    let dumb = std::env::var_os("TERM").is_none_or(|term| term == "dumb");
    let name = state.name();
    if !is_live() || dumb || declined("NO_COLOR") {
        return name.to_owned();
    }
    let colour = match state {
        State::Completed => 32,
        State::Failed | State::Rejected => 31,
        State::Aborted => 33,
        State::Initiated | State::Accepted => 36,
    };
    format!("\x1b[{colour}m{name}\x1b[0m")
}
