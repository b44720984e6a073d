//! What is found in a script before it is played.

use std::fmt;

use ztl_yaml::Diagnostic;

/// A mistake, or something that is played and was probably not meant so.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Finding {
    doubt: bool,
    diagnostic: Diagnostic,
}

impl Finding {
    /// It cannot be played.
    #[must_use]
    pub const fn mistake(diagnostic: Diagnostic) -> Self {
        Self {
            doubt: false,
            diagnostic,
        }
    }

    /// It is played, and was probably not meant so.
    #[must_use]
    pub const fn doubt(diagnostic: Diagnostic) -> Self {
        Self {
            doubt: true,
            diagnostic,
        }
    }

    /// Whether it can be played all the same.
    #[must_use]
    pub const fn is_doubt(&self) -> bool {
        self.doubt
    }

    /// What and where.
    #[must_use]
    pub const fn diagnostic(&self) -> &Diagnostic {
        &self.diagnostic
    }

    /// The same.
    #[must_use]
    pub fn into_diagnostic(self) -> Diagnostic {
        self.diagnostic
    }
}

impl fmt::Display for Finding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.diagnostic.fmt(f)
    }
}
