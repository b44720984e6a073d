//! Text for people, on stdout and stderr. A reader that has gone (`| head`) is not an error here.
//!
//! Everything this program prints goes through here, because results, device names and answers come
//! from elsewhere and a terminal obeys what it is sent: see [`ztl_std::terminal`].

use std::fmt::Display;
use std::io::{IsTerminal, Write};

use ztl_std::State;
pub(crate) use ztl_std::terminal::flat;
use ztl_std::terminal::{shown, write_shown};

/// Prints a line at once, also into a pipe.
pub(crate) fn line(text: impl Display) {
    put(std::io::stdout().lock(), format!("{text}\n").as_bytes());
}

/// Prints without ending the line.
pub(crate) fn part(text: impl Display) {
    put(std::io::stdout().lock(), text.to_string().as_bytes());
}

/// Prints a line that was made for a terminal, with colours: what is in it from elsewhere was made harmless
/// before.
pub(crate) fn drawn_line(text: &str) {
    let mut out = std::io::stdout().lock();
    let _ = writeln!(out, "{text}").and_then(|()| out.flush());
}

/// Prints a line on stderr.
pub(crate) fn error_line(text: impl Display) {
    put(std::io::stderr().lock(), format!("{text}\n").as_bytes());
}

/// Prints on stderr without ending the line.
pub(crate) fn error_part(text: impl Display) {
    put(std::io::stderr().lock(), text.to_string().as_bytes());
}

/// stderr for log lines, which are looked at later and elsewhere: what commands a terminal is always
/// escaped.
pub(crate) struct Errors;

impl Write for Errors {
    /// Takes whole events. A log that cannot be written is lost: an error would make the logger panic.
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        let text = String::from_utf8_lossy(bytes);
        let _ = std::io::stderr().lock().write_all(shown(&text).as_bytes());
        Ok(bytes.len())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        let _ = std::io::stderr().flush();
        Ok(())
    }
}

/// Prints a line with a state in it, in colour where a person sees it and has not declined colours.
pub(crate) fn line_with_state(before: &str, state: State, after: &str) {
    let Some(colour) = colour(state) else {
        return line(format_args!("{before}{}{after}", state.name()));
    };
    let (before, after) = (shown(before), shown(after));
    drawn_line(&format!(
        "{before}\x1b[{colour}m{}\x1b[0m{after}",
        state.name()
    ));
}

/// Writes text to a stream. A reader that has gone is not an error.
pub(crate) fn put(to: impl Write + IsTerminal, text: &[u8]) {
    let _ = write_shown(to, text);
}

/// Whether a person sees stdout, so that lines can be rewritten.
pub(crate) fn is_live() -> bool {
    std::io::stdout().is_terminal()
}

/// Writes over the line that the cursor is in, cut where it would wrap: that would be two to the
/// cursor. Only for terminals.
pub(crate) fn rewrite(text: &str, end: &str) {
    let width = terminal_size::terminal_size().map_or(80, |(width, _)| usize::from(width.0));
    let text: String = flat(text).chars().take(width).collect();
    let mut out = std::io::stdout().lock();
    let _ = write!(out, "\r\x1b[K{text}{end}").and_then(|()| out.flush());
}

/// Moves the cursor up by so many lines. Only for terminals.
pub(crate) fn up(lines: usize) {
    let mut out = std::io::stdout().lock();
    let _ = write!(out, "\x1b[{lines}A").and_then(|()| out.flush());
}

/// The colour of a state, where a person sees it and has not declined that (`NO_COLOR`).
fn colour(state: State) -> Option<u8> {
    let declined = |name| std::env::var_os(name).is_some_and(|value| !value.is_empty());
    let dumb = std::env::var_os("TERM").is_none_or(|term| term == "dumb");
    let seen = is_live() && !dumb && !declined("NO_COLOR");
    seen.then_some(match state {
        State::Completed => 32,
        State::Failed | State::Rejected => 31,
        State::Aborted => 33,
        State::Initiated | State::Accepted => 36,
    })
}
