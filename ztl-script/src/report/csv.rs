//! Tables for statistics (RFC 4180).

use super::run::ReportedRun;
use super::words;
use crate::durations::{millis, seconds};
use crate::event::{RunCommand, TaskOutline};

const TASKS: &[&str] = &[
    "run",
    "script_sha256",
    "scene",
    "take",
    "step",
    "task",
    "remote",
    "handler",
    "component",
    "goal",
    "awaited",
    "retry_of",
    "planned_start_s",
    "start_s",
    "late_s",
    "init_latency_ms",
    "end_s",
    "length_s",
    "unknown_s",
    "state",
    "text",
];

const ACTIONS: &[&str] = &[
    "run",
    "script_sha256",
    "at_s",
    "key",
    "command",
    "target",
    "by",
    "done",
    "deviation",
    "after_question_s",
    "scene",
    "step",
];

pub(super) fn tasks(runs: &[ReportedRun]) -> String {
    let mut out = line(TASKS);
    for run in runs {
        for task in &run.tasks {
            let Some(take) = run.takes.get(task.take) else {
                continue;
            };
            let step = take.steps.get(task.step).map(|step| step.step);
            let plan = run.plan(task);
            let of_plan = |text: fn(&TaskOutline) -> &String| {
                plan.map(|(_, plan)| text(plan).clone()).unwrap_or_default()
            };
            let awaited = plan.map(|(step, plan)| step.wait && plan.wait);
            let unknown = task
                .unknown
                .iter()
                .map(|(from, to)| to.saturating_sub(*from));
            let optional = |time: Option<_>| time.map(seconds).unwrap_or_default();
            out += &line(&[
                run.record.name.clone(),
                run.record.started.sha256.clone(),
                run.scene_name(take.scene),
                take.number.to_string(),
                step.map(|step| run.step_name(take.scene, step))
                    .unwrap_or_default(),
                task.number.0.to_string(),
                of_plan(|plan| &plan.remote),
                of_plan(|plan| &plan.handler),
                of_plan(|plan| &plan.component),
                of_plan(|plan| &plan.goal),
                awaited
                    .map(|awaited| awaited.to_string())
                    .unwrap_or_default(),
                task.retry_of.map(|of| of.0.to_string()).unwrap_or_default(),
                optional(task.planned_from),
                seconds(task.from),
                optional(task.late()),
                task.latency.map(millis).unwrap_or_default(),
                optional(task.to),
                optional(task.length()),
                seconds(unknown.sum()),
                task.state.name().to_owned(),
                task.text.clone(),
            ]);
        }
    }
    out
}

pub(super) fn actions(runs: &[ReportedRun]) -> String {
    let mut out = line(ACTIONS);
    for run in runs {
        for action in &run.actions {
            let target = match action.command {
                Some(RunCommand::Jump { scene }) => run.scene_name(scene),
                _ => String::new(),
            };
            let scene = action.scene.map(|scene| run.scene_name(scene));
            let step = action.scene.zip(action.step);
            out += &line(&[
                run.record.name.clone(),
                run.record.started.sha256.clone(),
                seconds(action.at),
                action.key.clone().unwrap_or_default(),
                action.command.map(words::command_name).unwrap_or_default(),
                target,
                words::by(action.by).to_owned(),
                action.decided.to_string(),
                action.deviation.to_string(),
                action.after.map(seconds).unwrap_or_default(),
                scene.unwrap_or_default(),
                step.map(|(scene, step)| run.step_name(scene, step))
                    .unwrap_or_default(),
            ]);
        }
    }
    out
}

fn line<T: AsRef<str>>(cells: &[T]) -> String {
    let cells: Vec<String> = cells.iter().map(|cell| quoted(cell.as_ref())).collect();
    cells.join(",") + "\r\n"
}

fn quoted(text: &str) -> String {
    if text.contains([',', '"', '\n', '\r']) {
        format!("\"{}\"", text.replace('"', "\"\""))
    } else {
        text.to_owned()
    }
}
