//! What is found in a script before it is played.

use std::fmt;

use ztl_yaml::Diagnostic;

/// A mistake, or a doubt: something that is played as written but probably not intended.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Finding {
    doubt: bool,
    diagnostic: Diagnostic,
}

impl Finding {
    /// A mistake: it cannot be played.
    #[must_use]
    pub const fn mistake(diagnostic: Diagnostic) -> Self {
        Self {
            doubt: false,
            diagnostic,
        }
    }

    /// A doubt.
    pub(crate) const fn doubt(diagnostic: Diagnostic) -> Self {
        Self {
            doubt: true,
            diagnostic,
        }
    }

    /// Whether it is a doubt.
    #[must_use]
    pub const fn is_doubt(&self) -> bool {
        self.doubt
    }

    /// What is wrong, and where.
    #[must_use]
    pub const fn diagnostic(&self) -> &Diagnostic {
        &self.diagnostic
    }

    pub(crate) fn into_diagnostic(self) -> Diagnostic {
        self.diagnostic
    }
}

impl fmt::Display for Finding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.diagnostic.fmt(f)
    }
}
