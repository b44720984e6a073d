//! Output for programs: JSON or YAML.

use serde::Serialize;

use crate::terminal::line;

/// Options for output that programs read.
#[derive(Debug, Clone, Copy, clap::Args)]
pub(crate) struct DataFormat {
    /// Print JSON
    #[arg(long)]
    json: bool,

    /// Print the same as YAML
    #[arg(long, conflicts_with = "json")]
    yaml: bool,
}

impl DataFormat {
    /// Whether programs read the output.
    pub(crate) const fn is_chosen(self) -> bool {
        self.json || self.yaml
    }

    /// Prints a value in the chosen format.
    pub(crate) fn print(self, value: &impl Serialize) -> Result<(), Box<dyn std::error::Error>> {
        if self.yaml {
            serde_yaml_ng::to_string(value)?.lines().for_each(line);
        } else {
            line(serde_json::to_string(value)?);
        }
        Ok(())
    }
}
