//! How what happened is said.

use super::run::{Asked, Cause, Run};
use crate::event::{DecidedBy, Ending, RunCommand, RunOutcome, WaitReason};

pub(super) fn command(run: &Run, command: RunCommand) -> String {
    let word = match command {
        RunCommand::Start => "start",
        RunCommand::Skip => "skip",
        RunCommand::Replay => "replay last",
        RunCommand::Jump { scene } => return format!("jump to {}", run.scene_name(scene)),
        RunCommand::Restart => "begin again",
        RunCommand::Pause => "pause after this step",
        RunCommand::Resume => "go on after the pause",
        RunCommand::Retry => "retry what failed",
        RunCommand::GoOn => "go on anyway",
        RunCommand::StopScene => "stop the scene",
        RunCommand::StopAll => "stop everything, and stay",
        RunCommand::Stop => "stop everything",
        RunCommand::Leave => "leave",
    };
    word.to_owned()
}

/// The name of a command in a table for statistics.
pub(super) const fn command_name(command: RunCommand) -> &'static str {
    match command {
        RunCommand::Start => "start",
        RunCommand::Skip => "skip",
        RunCommand::Replay => "replay",
        RunCommand::Jump { .. } => "jump",
        RunCommand::Restart => "restart",
        RunCommand::Pause => "pause",
        RunCommand::Resume => "resume",
        RunCommand::Retry => "retry",
        RunCommand::GoOn => "go_on",
        RunCommand::StopScene => "stop_scene",
        RunCommand::StopAll => "stop_all",
        RunCommand::Stop => "stop",
        RunCommand::Leave => "leave",
    }
}

pub(super) const fn by(by: DecidedBy) -> &'static str {
    match by {
        DecidedBy::Operator => "operator",
        DecidedBy::Script => "script",
        DecidedBy::Options => "options",
        DecidedBy::Signal => "signal",
    }
}

pub(super) fn cause(cause: &Cause) -> String {
    match cause {
        Cause::Operator => "for the operator".to_owned(),
        Cause::Pause => "pause".to_owned(),
        Cause::Trouble(why) => why_text(why),
    }
}

fn why_text(why: &WaitReason) -> String {
    match why {
        WaitReason::ServerSilent { remote } => format!("server '{remote}' is silent"),
        WaitReason::ServerRestarted { remote } => format!("server '{remote}' was started anew"),
        WaitReason::TaskUnknown => "a task is unknown to its server".to_owned(),
        WaitReason::NotTold { remote } => {
            format!("server '{remote}' does not say how its tasks are")
        }
        WaitReason::AnswerUnclear { remote } => {
            format!("server '{remote}' gives no usable answer about a task")
        }
        WaitReason::StartUnknown => "whether a task was started is unknown".to_owned(),
        WaitReason::Failed => "a task failed".to_owned(),
        WaitReason::TooLong => "a task takes longer than its limit".to_owned(),
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

pub(super) const fn outcome(outcome: Option<RunOutcome>) -> &'static str {
    match outcome {
        Some(RunOutcome::Completed) => "completed",
        Some(RunOutcome::Failures) => "with failures",
        Some(RunOutcome::Stopped) => "stopped",
        Some(RunOutcome::NotConfirmed) => "stopping not confirmed",
        Some(RunOutcome::Left) => "left",
        Some(RunOutcome::Error) => "ended by an error",
        None => "no end in the record",
    }
}

pub(super) const fn scene_end(end: Option<Ending>) -> &'static str {
    match end {
        Some(Ending::Completed) => "completed",
        Some(Ending::Failures) => "with failures",
        Some(Ending::Stopped) => "stopped",
        None => "no end in the record",
    }
}

pub(super) const fn step_end(end: Option<Ending>) -> &'static str {
    match end {
        Some(Ending::Completed) => "completed",
        Some(Ending::Failures) => "with failures",
        Some(Ending::Stopped) => "stopped",
        None => "no end in the record",
    }
}
