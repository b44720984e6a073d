//! How commands end.

use std::fmt;
use std::process::ExitCode;

use crate::terminal::error_line;

/// The exit code of a command. Prints its error with the name it was called by.
pub(crate) fn exit(called: impl fmt::Display, done: Done) -> ExitCode {
    match done {
        Ok(code) => code,
        Err(error) => {
            error_line(format_args!("{called}: {error}"));
            match error.is::<Misuse>() {
                true => ExitCode::from(MISUSED),
                false => ExitCode::FAILURE,
            }
        }
    }
}

/// The exit code for wrong options or a wrong environment.
pub(crate) const MISUSED: u8 = 2;

/// A mistake in the options or the environment.
#[derive(Debug)]
pub(crate) struct Misuse(pub(crate) String);

impl Misuse {
    pub(crate) fn of(mistake: impl fmt::Display) -> Self {
        Self(mistake.to_string())
    }
}

impl fmt::Display for Misuse {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.0.trim_end())
    }
}

impl std::error::Error for Misuse {}

/// What each command returns: its exit code, or an error to print.
pub(crate) type Done = Result<ExitCode, Box<dyn std::error::Error>>;
