//! How what happened is said.

use super::run::{Asked, Cause, Run};
use crate::event::{By, Command, Outcome, SceneEnd, StepEnd, Why};

pub(super) fn command(run: &Run, command: Command) -> String {
    let word = match command {
        Command::Start => "start",
        Command::Skip => "skip",
        Command::Replay => "replay last",
        Command::Jump { scene } => return format!("jump to {}", run.scene_name(scene)),
        Command::Restart => "begin again",
        Command::Pause => "pause after this step",
        Command::Resume => "go on after the pause",
        Command::Retry => "retry what failed",
        Command::GoOn => "go on anyway",
        Command::StopScene => "stop the scene",
        Command::StopAll => "stop everything, and stay",
        Command::Stop => "stop everything",
        Command::Leave => "leave",
    };
    word.to_owned()
}

/// The name of a command in a table for statistics.
pub(super) const fn command_name(command: Command) -> &'static str {
    match command {
        Command::Start => "start",
        Command::Skip => "skip",
        Command::Replay => "replay",
        Command::Jump { .. } => "jump",
        Command::Restart => "restart",
        Command::Pause => "pause",
        Command::Resume => "resume",
        Command::Retry => "retry",
        Command::GoOn => "go_on",
        Command::StopScene => "stop_scene",
        Command::StopAll => "stop_all",
        Command::Stop => "stop",
        Command::Leave => "leave",
    }
}

pub(super) const fn by(by: By) -> &'static str {
    match by {
        By::Operator => "operator",
        By::Script => "script",
        By::Options => "options",
        By::Signal => "signal",
    }
}

pub(super) fn cause(cause: &Cause) -> String {
    match cause {
        Cause::Operator => "for the operator".to_owned(),
        Cause::Pause => "pause".to_owned(),
        Cause::Trouble(why) => why_text(why),
    }
}

fn why_text(why: &Why) -> String {
    match why {
        Why::ServerSilent { remote } => format!("server '{remote}' is silent"),
        Why::ServerRestarted { remote } => format!("server '{remote}' was started anew"),
        Why::TaskUnknown => "a task is unknown to its server".to_owned(),
        Why::NotTold { remote } => format!("server '{remote}' does not say how its tasks are"),
        Why::AnswerUnclear { remote } => {
            format!("server '{remote}' gives no usable answer about a task")
        }
        Why::StartUnknown => "whether a task was started is unknown".to_owned(),
        Why::Failed => "a task failed".to_owned(),
        Why::TooLong => "a task takes longer than its limit".to_owned(),
    }
}

pub(super) const fn asked(asked: Asked) -> &'static str {
    match asked {
        Asked::Init => "INIT",
        Asked::Status => "STATUS",
        Asked::Held => "STATUS, held by the server",
        Asked::Abort => "ABORT",
    }
}

pub(super) const fn outcome(outcome: Option<Outcome>) -> &'static str {
    match outcome {
        Some(Outcome::Completed) => "completed",
        Some(Outcome::Failures) => "with failures",
        Some(Outcome::Stopped) => "stopped",
        Some(Outcome::NotConfirmed) => "stopping not confirmed",
        Some(Outcome::Left) => "left",
        Some(Outcome::Error) => "ended by an error",
        None => "no end in the record",
    }
}

pub(super) const fn scene_end(end: Option<SceneEnd>) -> &'static str {
    match end {
        Some(SceneEnd::Completed) => "completed",
        Some(SceneEnd::Failures) => "with failures",
        Some(SceneEnd::Stopped) => "stopped",
        None => "no end in the record",
    }
}

pub(super) const fn step_end(end: Option<StepEnd>) -> &'static str {
    match end {
        Some(StepEnd::Completed) => "completed",
        Some(StepEnd::Failures) => "with failures",
        Some(StepEnd::Stopped) => "stopped",
        None => "no end in the record",
    }
}
