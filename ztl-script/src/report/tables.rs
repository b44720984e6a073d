//! The tables of a run.

use std::time::Duration;

use super::html::Table;
use super::run::{PlayedScene, ReportedRun};
use super::{svg, words};
use crate::drawing::escape;
use crate::durations::{difference, median, millis, percentile, seconds};
use crate::event::{Ending, TaskState};

/// All tables of a run.
pub(super) fn all(run: &ReportedRun) -> String {
    [
        operator_table(run),
        wait_table(run),
        steps_table(run),
        tasks_table(run),
        latency_table(run),
        notes(run),
    ]
    .concat()
}

fn section(title: &str, note: &str, table: String) -> String {
    let note = match note {
        "" => String::new(),
        note => format!("<p class=\"note\">{}</p>\n", escape(note)),
    };
    format!(
        "<section><h3>{}</h3>\n{note}{table}</section>\n",
        escape(title)
    )
}

fn place(run: &ReportedRun, scene: Option<usize>, step: Option<usize>) -> String {
    match (scene, step) {
        (Some(scene), Some(step)) => {
            format!("{} / {}", run.scene_name(scene), run.step_name(scene, step))
        }
        (Some(scene), None) => run.scene_name(scene),
        _ => String::new(),
    }
}

fn operator_table(run: &ReportedRun) -> String {
    let columns = [
        "#at (s)",
        "key",
        "what",
        "by",
        "#after the question (s)",
        "~where",
        "",
    ];
    let mut table = Table::new("operator", &columns);
    for action in &run.actions {
        let what = match (action.command, action.decided) {
            (None, _) => "meant nothing".to_owned(),
            (Some(command), true) => words::command(run, command),
            (Some(command), false) => format!("{} (not done)", words::command(run, command)),
        };
        let class = if action.deviation { "deviation" } else { "" };
        table.row(
            class,
            &[
                seconds(action.at),
                action
                    .key
                    .as_deref()
                    .map(|key| format!("<kbd>{}</kbd>", escape(key)))
                    .unwrap_or_default(),
                escape(&what),
                words::by(action.by).to_owned(),
                action.after.map(seconds).unwrap_or_default(),
                escape(&place(run, action.scene, action.step)),
                if action.deviation {
                    "deviation".to_owned()
                } else {
                    String::new()
                },
            ],
        );
    }
    section("The operator", "", table.end())
}

fn wait_table(run: &ReportedRun) -> String {
    if run.waits.is_empty() {
        return String::new();
    }
    let mut table = Table::new(
        "waits",
        &["#from (s)", "#length (s)", "why", "~where", "~tasks"],
    );
    for wait in &run.waits {
        let tasks = wait.tasks.iter().map(|number| match run.task(*number) {
            Some(task) => svg::task_name(run, task),
            None => format!("task {}", number.0),
        });
        let tasks: Vec<String> = tasks.collect();
        table.row(
            "",
            &[
                seconds(wait.from),
                seconds(wait.to.saturating_sub(wait.from)),
                escape(&words::cause(&wait.cause)),
                escape(&place(run, wait.scene, wait.step)),
                escape(&tasks.join(", ")),
            ],
        );
    }
    section("Waits", "", table.end())
}

fn steps_table(run: &ReportedRun) -> String {
    let none = || "–".to_owned();
    let columns = [
        "~scene",
        "~step",
        "#planned start (s)",
        "#start (s)",
        "#late (s)",
        "#planned length (s)",
        "#length (s)",
        "#more (s)",
        "end",
    ];
    let mut table = Table::new("steps", &columns);
    for take in &run.takes {
        for step in &take.steps {
            table.row(
                end_class(step.end == Some(Ending::Completed)),
                &[
                    escape(&svg::take_name(run, take)),
                    escape(&run.step_name(take.scene, step.step)),
                    seconds(step.planned_from),
                    seconds(step.from),
                    difference(step.from, step.planned_from),
                    step.planned.map_or_else(none, seconds),
                    seconds(step.length()),
                    step.planned
                        .map_or_else(none, |planned| difference(step.length(), planned)),
                    words::ending(step.end).to_owned(),
                ],
            );
        }
    }
    let note = "Planned: start at the end of the step before (or after the scene's delay); length as the \
                script's delays and the awaited tasks' own running times add up to. More: latencies, waits, \
                decisions, tries again.";
    section("Steps, planned and actual", note, table.end())
}

const fn end_class(well: bool) -> &'static str {
    if well { "" } else { "wrong" }
}

fn tasks_table(run: &ReportedRun) -> String {
    let columns = [
        "#no.",
        "~scene / step",
        "~task",
        "#planned start (s)",
        "#start (s)",
        "#late (s)",
        "#latency (ms)",
        "#length (s)",
        "state",
        "~result or reason",
    ];
    let mut table = Table::new("tasks", &columns);
    for task in &run.tasks {
        let take: Option<&PlayedScene> = run.takes.get(task.take);
        let step = take.and_then(|take| Some((take, take.steps.get(task.step)?)));
        let place = step.map(|(take, step)| {
            format!(
                "{} / {}",
                svg::take_name(run, take),
                run.step_name(take.scene, step.step)
            )
        });
        let mut remarks = Vec::new();
        if let Some(of) = task.retry_of {
            remarks.push(format!("{} again", of.0));
        }
        if svg::outlives(run, task) {
            remarks.push("in the background".to_owned());
        }
        let remarks = match remarks.as_slice() {
            [] => String::new(),
            some => format!(" <small>{}</small>", escape(&some.join(", "))),
        };
        let none = || "–".to_owned();
        table.row(
            end_class(!(task.state.is_failure() || task.state == TaskState::Unknown)),
            &[
                task.number.0.to_string(),
                escape(&place.unwrap_or_default()),
                format!(
                    "<code>{}</code>{remarks}",
                    escape(&svg::task_name(run, task))
                ),
                task.planned_from.map_or_else(none, seconds),
                seconds(task.from),
                task.late().map_or_else(none, seconds),
                task.latency.map_or_else(none, millis),
                task.length().map_or_else(none, seconds),
                escape(&task.state.to_string()),
                escape(&task.text),
            ],
        );
    }
    let note = "Planned: where the script's delays alone put the task, counted from the start of its step. \
                Latency: from INIT to its answer. Length: from INIT until the end was known here.";
    section("Tasks", note, table.end())
}

fn latency_table(run: &ReportedRun) -> String {
    if run.latencies.is_empty() {
        return String::new();
    }
    let columns = [
        "server",
        "request",
        "#answered",
        "#median (ms)",
        "#95 % within (ms)",
        "#most (ms)",
        "#no answer",
    ];
    let mut table = Table::new("latencies", &columns);
    for ((remote, asked), of) in &run.latencies {
        let time = |time: Option<Duration>| time.map_or("–".to_owned(), millis);
        table.row(
            end_class(of.unanswered == 0),
            &[
                escape(remote),
                words::asked(*asked).to_owned(),
                of.answered.len().to_string(),
                time(median(&of.answered)),
                time(percentile(&of.answered, 95)),
                time(of.answered.iter().max().copied()),
                of.unanswered.to_string(),
            ],
        );
    }
    section("How long servers took to answer", "", table.end())
}

fn notes(run: &ReportedRun) -> String {
    if run.notes.is_empty() {
        return String::new();
    }
    let mut table = Table::new("notes", &["#at (s)", "~note"]);
    for (at, text) in &run.notes {
        table.row("", &[seconds(*at), escape(text)]);
    }
    section("Notes", "", table.end())
}
