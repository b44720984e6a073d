//! The name by which a tool was called, which selects its rules for options.

use std::fmt;

#[derive(Debug, Clone)]
pub(crate) struct Called {
    name: String,
    original: bool,
}

impl Called {
    /// As a subcommand: `ztl task-client`.
    pub(crate) fn ours(tool: &str) -> Self {
        Self {
            name: format!("ztl {tool}"),
            original: false,
        }
    }

    /// By one of the original's names: `ztl_task_client`.
    pub(crate) fn original(name: &str) -> Self {
        Self {
            name: name.to_owned(),
            original: true,
        }
    }

    /// Whether the tool must behave as the original's.
    pub(crate) const fn is_original(&self) -> bool {
        self.original
    }
}

impl fmt::Display for Called {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.name)
    }
}
