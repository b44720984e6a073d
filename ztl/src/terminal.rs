//! Text for people, on stdout and stderr. A closed pipe (`| head`) is not an error.
//!
//! A stdout that cannot be written, for example because the disk is full, stops nothing: tasks still have to be aborted,
//! and servers go on. It is reported once, and [`checked`] makes the exit code tell it.
//!
//! The program prints through this module only, because results, device names and answers may contain control
//! sequences: see [`ztl_std::terminal`].

use std::fmt::{self, Display};
use std::io::{self, IsTerminal, Write};
use std::process::ExitCode;
use std::sync::atomic::{AtomicBool, Ordering};

use ztl_std::State;
pub(crate) use ztl_std::terminal::flat;
use ztl_std::terminal::{shown, write_shown};

/// The exit code if stdout could not be written and all else went well. Python's is the same.
const OUTPUT_LOST: u8 = 120;

/// Whether something was not written to stdout.
static IS_OUTPUT_LOST: AtomicBool = AtomicBool::new(false);

/// Prints a line and flushes it, also to a pipe.
pub(crate) fn line(text: impl Display) {
    out(format!("{text}\n").as_bytes());
}

/// Prints without a line feed.
pub(crate) fn part(text: impl Display) {
    out(text.to_string().as_bytes());
}

/// Writes text to stdout.
pub(crate) fn out(text: &[u8]) {
    printed(write_shown(io::stdout().lock(), text));
}

/// Prints a line with attributes on a terminal as it is. The caller has escaped what comes from elsewhere.
pub(crate) fn drawn_line(text: &str) {
    drawn(format_args!("{text}\n"));
}

/// Prints on a terminal as it is. A terminal that is gone has no reader, as a closed pipe.
fn drawn(text: fmt::Arguments<'_>) {
    let mut out = io::stdout().lock();
    let _ = out.write_fmt(text).and_then(|()| out.flush());
}

/// Takes the result of writing to stdout: reports the first failure.
pub(crate) fn printed(result: io::Result<()>) {
    if let Err(error) = result
        && error.kind() != io::ErrorKind::BrokenPipe
        && mark_output_lost()
    {
        error_line(format_args!("ztl: cannot write the output: {error}"));
    }
}

/// Makes [`checked`] tell that something was not written to stdout. Returns whether it is the first loss.
pub(crate) fn mark_output_lost() -> bool {
    !IS_OUTPUT_LOST.swap(true, Ordering::Relaxed)
}

/// The exit code of the process: `code`, but not success if stdout could not be written.
pub(crate) fn checked(code: ExitCode) -> ExitCode {
    match code == ExitCode::SUCCESS && IS_OUTPUT_LOST.load(Ordering::Relaxed) {
        true => ExitCode::from(OUTPUT_LOST),
        false => code,
    }
}

/// Prints a line on stderr.
pub(crate) fn error_line(text: impl Display) {
    err(format!("{text}\n").as_bytes());
}

/// Prints on stderr without a line feed.
pub(crate) fn error_part(text: impl Display) {
    err(text.to_string().as_bytes());
}

/// Writes text to stderr.
pub(crate) fn err(text: &[u8]) {
    let _ = write_shown(io::stderr().lock(), text);
}

/// stderr for log lines. Logs are often read on a terminal later, so control sequences are always escaped.
pub(crate) struct Errors;

impl Write for Errors {
    /// Writes a whole event. Never fails, because an error would make the logger panic.
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let text = String::from_utf8_lossy(bytes);
        let _ = io::stderr().lock().write_all(shown(&text).as_bytes());
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        let _ = io::stderr().flush();
        Ok(())
    }
}

/// Prints a line with a coloured state.
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

/// Whether stdout is a terminal, where lines can be rewritten.
pub(crate) fn is_live() -> bool {
    io::stdout().is_terminal()
}

/// Overwrites the current line, cut before it wraps. Only for terminals.
pub(crate) fn rewrite(text: &str, end: &str) {
    let text: String = flat(text).chars().take(size().0).collect();
    drawn(format_args!("\r\x1b[K{text}{end}"));
}

/// Moves the cursor up. Only for terminals.
pub(crate) fn up(lines: usize) {
    drawn(format_args!("\x1b[{lines}A"));
}

/// Columns and lines of the terminal.
pub(crate) fn size() -> (usize, usize) {
    let size = terminal_size::terminal_size();
    let (width, height) = size.map_or((0, 0), |(width, height)| (width.0, height.0));
    // A terminal that does not know its size reports 0.
    let or = |size: u16, default: usize| {
        if size == 0 {
            default
        } else {
            usize::from(size)
        }
    };
    (or(width, 80), or(height, 24))
}

/// Whether stdin and stdout are a terminal that can show a full screen.
#[cfg(unix)]
pub(crate) fn can_show_screen() -> bool {
    let dumb = std::env::var("TERM").is_ok_and(|term| term == "dumb" || term.is_empty());
    io::stdin().is_terminal() && io::stdout().is_terminal() && !dumb
}

/// Whether the user wants no colours (`NO_COLOR`).
pub(crate) fn is_colour_declined() -> bool {
    std::env::var_os("NO_COLOR").is_some_and(|value| !value.is_empty())
}

/// SGR colour of a state, if stdout shows colours.
fn colour(state: State) -> Option<u8> {
    let dumb = std::env::var_os("TERM").is_none_or(|term| term == "dumb");
    let shown = is_live() && !dumb && !is_colour_declined();
    shown.then_some(match state {
        State::Completed => 32,
        State::Failed | State::Rejected => 31,
        State::Aborted => 33,
        State::Initiated | State::Accepted => 36,
    })
}
