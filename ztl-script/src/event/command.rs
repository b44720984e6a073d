//! Questions to the operator, and the commands that answer them.

use serde::{Deserialize, Serialize};

/// What the operator is asked.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "about", rename_all = "snake_case")]
pub enum Question {
    /// Whether to play this scene.
    Scene {
        /// Index of the scene.
        scene: usize,
    },
    /// What to do after the last scene.
    End,
    /// What to do with a step that waits.
    Step {
        /// Index of the scene.
        scene: usize,
        /// Index of the step.
        step: usize,
    },
    /// When to continue after a pause.
    Pause,
}

/// A decision about the run. The player lists the commands that it accepts in
/// `RunEvent::Asked`; while a step runs, it accepts
/// [`WHILE_RUNNING`](Self::WHILE_RUNNING).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(tag = "do", rename_all = "snake_case")]
pub enum RunCommand {
    /// Play the shown scene.
    Start,
    /// Skip the shown scene, or the rest of the scene whose step waits.
    Skip,
    /// Play the last scene again.
    Replay,
    /// Show this scene next.
    Jump {
        /// Index of the scene.
        scene: usize,
    },
    /// Start over with the first scene.
    Restart,
    /// Start nothing more after this step.
    Pause,
    /// Continue after a pause, or cancel a pause that has not begun.
    Resume,
    /// Start failed tasks again.
    Retry,
    /// Continue although a task failed or its outcome is unknown.
    GoOn,
    /// Abort the tasks of the current scene and return to the scene shown before it.
    StopScene,
    /// Abort all tasks of this run and all others in the scopes of its servers; then continue as after
    /// [`StopScene`](Self::StopScene).
    StopAll,
    /// Abort all tasks of this run on all servers, and end.
    Stop,
    /// End now, without waiting for anything.
    Leave,
}

impl RunCommand {
    /// The commands accepted while a step runs and no question is open.
    pub const WHILE_RUNNING: [Self; 5] = [
        Self::Pause,
        Self::Resume,
        Self::StopScene,
        Self::StopAll,
        Self::Stop,
    ];
}

/// Who decided.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DecidedBy {
    /// The person at the keyboard.
    Operator,
    /// The script's own rule for this case.
    Script,
    /// Command-line options: `--yes`, `--scene`, `--from`.
    Options,
    /// A signal to the process.
    Signal,
}
