//! Findings of the doctor.

use serde_json::{Value, json};

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Health {
    Good,
    /// Not a problem, but worth knowing.
    Note,
    Problem,
}

/// The result of one check.
#[derive(Debug)]
pub(super) struct Finding {
    pub(super) about: &'static str,
    pub(super) health: Health,
    pub(super) text: String,
    pub(super) remedy: Option<String>,
    /// Numbers and names, for programs.
    data: Value,
}

impl Finding {
    pub(super) fn good(about: &'static str, text: impl Into<String>) -> Self {
        Self {
            about,
            health: Health::Good,
            text: text.into(),
            remedy: None,
            data: Value::Null,
        }
    }

    pub(super) fn note(about: &'static str, text: impl Into<String>) -> Self {
        Self {
            health: Health::Note,
            ..Self::good(about, text)
        }
    }

    pub(super) fn problem(
        about: &'static str,
        text: impl Into<String>,
        remedy: impl Into<String>,
    ) -> Self {
        Self {
            health: Health::Problem,
            remedy: Some(remedy.into()),
            ..Self::good(about, text)
        }
    }

    /// Adds a remedy to a note.
    pub(super) fn with_remedy(mut self, remedy: impl Into<String>) -> Self {
        self.remedy = Some(remedy.into());
        self
    }

    pub(super) fn with(mut self, data: Value) -> Self {
        self.data = data;
        self
    }

    pub(super) fn to_json(&self) -> Value {
        json!({
            "about": self.about,
            "health": match self.health {
                Health::Good => "good",
                Health::Note => "note",
                Health::Problem => "problem",
            },
            "text": self.text,
            "remedy": self.remedy,
            "data": self.data,
        })
    }
}
