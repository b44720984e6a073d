//! How a command ends: its exit code, or an error for the user.

use std::fmt;
use std::process::ExitCode;

use crate::terminal::error_line;

/// Exit code for a wrong command line.
pub(crate) const MISUSED: u8 = 2;

/// The result of a command: its exit code, or an error that is printed in one line.
pub(crate) type Done = Result<ExitCode, Box<dyn std::error::Error>>;

/// A mistake in the command line or the environment.
#[derive(Debug)]
pub(crate) struct Misuse(pub(crate) String);

impl fmt::Display for Misuse {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.0.trim_end())
    }
}

impl std::error::Error for Misuse {}

/// Prints the error under the name by which the program was called, and returns the exit code.
pub(crate) fn exit(called: impl fmt::Display, done: Done) -> ExitCode {
    done.unwrap_or_else(|error| {
        error_line(format_args!("{called}: {error}"));
        match error.is::<Misuse>() {
            true => ExitCode::from(MISUSED),
            false => ExitCode::FAILURE,
        }
    })
}
