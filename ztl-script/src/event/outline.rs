//! What is known when a run starts: the outline of the script, its servers, and the options.

use std::time::Duration;

use serde::{Deserialize, Serialize};

use crate::millis;

/// What is known when a run starts.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunStarted {
    /// The `FORMAT` of the record.
    pub format: u32,
    /// The script file, as given on the command line.
    pub script: String,
    /// SHA-256 of the file's bytes, in hex.
    pub sha256: String,
    /// The configuration file, if one was read.
    pub config: Option<String>,
    /// Options that change what is played, as words of a command line.
    pub options: Vec<String>,
    /// Programs and their versions, such as `("ztl", "0.1.0")`.
    pub versions: Vec<(String, String)>,
    /// The servers that the script uses.
    pub remotes: Vec<RemoteOutline>,
    /// What the script plans.
    pub outline: Outline,
}

/// A server that a script uses.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct RemoteOutline {
    /// Its name in the configuration.
    pub name: String,
    /// Its ZeroMQ address; `None` if it is not configured.
    pub endpoint: Option<String>,
    /// Its scope.
    pub scope: String,
}

/// What a script plans, without what it says about failures.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Outline {
    /// In the order of the file.
    pub scenes: Vec<SceneOutline>,
    /// In the order of the file.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub cues: Vec<StepOutline>,
}

/// A planned scene.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SceneOutline {
    /// Name without parameters.
    pub name: String,
    /// Time before the first step.
    #[serde(rename = "delay_ms", with = "millis")]
    pub delay: Duration,
    /// In the order of the file.
    pub steps: Vec<StepOutline>,
}

/// A planned step.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StepOutline {
    /// Name without parameters.
    pub name: String,
    /// Time before the delay of its first task begins.
    #[serde(rename = "delay_ms", with = "millis")]
    pub delay: Duration,
    /// Whether the next step waits for the end of this one; otherwise its tasks run in the background.
    pub wait: bool,
    /// Whether all task delays count from the start of the step; otherwise they add up.
    pub parallel: bool,
    /// In the order of the file.
    pub tasks: Vec<TaskOutline>,
    /// Of a cue: the key that starts it, a small letter or a digit.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub key: Option<char>,
}

/// A planned task.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TaskOutline {
    /// The handler, as it is sent.
    pub handler: String,
    /// The component, as it is sent.
    pub component: String,
    /// The goal, as it is sent.
    pub goal: String,
    /// Name of its server.
    pub remote: String,
    /// Time before it is sent.
    #[serde(rename = "delay_ms", with = "millis")]
    pub delay: Duration,
    /// Whether its step waits for its end.
    pub wait: bool,
    /// Time limit.
    #[serde(rename = "limit_ms", with = "millis::optional", default)]
    pub limit: Option<Duration>,
}

impl TaskOutline {
    /// `handler:component:goal`.
    #[must_use]
    pub fn name(&self) -> String {
        format!("{}:{}:{}", self.handler, self.component, self.goal)
    }
}
