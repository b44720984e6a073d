//! What happened, in words.

use super::run::{ReportedRun, RequestClass, WaitCause};
use crate::event::{DecidedBy, Ending, RunCommand, RunOutcome};

pub(super) fn command(run: &ReportedRun, command: RunCommand) -> String {
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
        RunCommand::Stop => "abort the tasks of this run, and end it",
        RunCommand::Leave => "leave",
    };
    word.to_owned()
}

/// The name of a command in tables, as in records.
pub(super) fn command_name(command: RunCommand) -> String {
    let json = serde_json::to_value(command).unwrap_or_default();
    json.get("do")
        .and_then(|name| name.as_str())
        .unwrap_or_default()
        .to_owned()
}

pub(super) const fn by(by: DecidedBy) -> &'static str {
    match by {
        DecidedBy::Operator => "operator",
        DecidedBy::Script => "script",
        DecidedBy::Options => "options",
        DecidedBy::Signal => "signal",
    }
}

pub(super) fn cause(cause: &WaitCause) -> String {
    match cause {
        WaitCause::Operator => "for the operator".to_owned(),
        WaitCause::Pause => "pause".to_owned(),
        WaitCause::Unsettled(why) => why.to_string(),
    }
}

pub(super) const fn asked(asked: RequestClass) -> &'static str {
    match asked {
        RequestClass::Init => "INIT",
        RequestClass::Status => "STATUS",
        RequestClass::Held => "STATUS, held by the server",
        RequestClass::Abort => "ABORT",
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

pub(super) const fn ending(end: Option<Ending>) -> &'static str {
    match end {
        Some(Ending::Completed) => "completed",
        Some(Ending::Failures) => "with failures",
        Some(Ending::Stopped) => "stopped",
        None => "no end in the record",
    }
}
