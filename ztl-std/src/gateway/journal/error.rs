//! Why a journal cannot be used.

use std::io;
use std::path::PathBuf;

/// Why a journal cannot be used.
#[derive(Debug)]
#[non_exhaustive]
pub enum JournalError {
    /// Another gateway uses it.
    InUse {
        /// The journal.
        path: PathBuf,
        /// The other gateway's process, if known.
        by: Option<u32>,
    },
    /// The file is not a journal.
    Foreign {
        /// The file.
        path: PathBuf,
    },
    /// It, or its directory, cannot be read and written.
    Place {
        /// The journal.
        path: PathBuf,
        /// The system's error.
        cause: io::Error,
    },
}

impl std::fmt::Display for JournalError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::InUse { path, by } => {
                write!(f, "the journal {} is another gateway's", path.display())?;
                if let Some(by) = by {
                    write!(f, " (process {by})")?;
                }
                f.write_str("; stop that one, or give this one another file")
            }
            Self::Foreign { path } => write!(
                f,
                "{} is not a journal, and was left as it is; name another file",
                path.display()
            ),
            Self::Place { path, cause } => {
                write!(f, "the journal cannot lie at {}: {cause}", path.display())
            }
        }
    }
}

impl std::error::Error for JournalError {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        match self {
            Self::InUse { .. } | Self::Foreign { .. } => None,
            Self::Place { cause, .. } => Some(cause),
        }
    }
}
