//! The box at the top of the page.

use std::time::Duration;

use super::run::{PlayedTask, ReportedRun, StopTarget};
use super::svg;
use crate::drawing::escape;
use crate::durations::seconds;
use crate::event::{TaskNumber, TaskState};

/// The stops that were not confirmed, and the tasks that failed or are unknown, in all runs, with the
/// reasons.
pub(super) fn section(runs: &[ReportedRun]) -> String {
    let numbered = || (1..).zip(runs);
    let stops = numbered().flat_map(|(nth, run)| {
        let stops = run.open_stops.iter();
        stops.map(move |(target, (at, why))| {
            let (what, task) = match target {
                StopTarget::Task(number) => (stopped_task(run, *number), run.task(*number)),
                StopTarget::Others(remote) => (format!("tasks of others on '{remote}'"), None),
            };
            let place = task.and_then(|task| place(run, task));
            item((nth, runs), "stop not confirmed", why, &what, place, *at)
        })
    });
    let stops: Vec<String> = stops.collect();
    let wrong = |run: &ReportedRun, task: &PlayedTask| match task.state {
        TaskState::Aborted => false,
        // Said once.
        TaskState::Unknown => {
            let target = StopTarget::Task(task.number);
            !run.open_stops.contains_key(&target)
        }
        state => state.is_failure(),
    };
    let tasks = numbered().flat_map(|(nth, run)| {
        let tasks = run.tasks.iter().filter(move |task| wrong(run, task));
        tasks.map(move |task| {
            let state = task.state.to_string();
            let name = svg::task_name(run, task);
            item(
                (nth, runs),
                &state,
                &task.text,
                &name,
                place(run, task),
                task.from,
            )
        })
    });
    let tasks: Vec<String> = tasks.collect();
    let heads = [
        (
            tasks.len(),
            "task failed or unknown",
            "tasks failed or unknown",
        ),
        (stops.len(), "stop not confirmed", "stops not confirmed"),
    ];
    let heads = heads.iter().filter_map(|(count, one, many)| match count {
        0 => None,
        1 => Some(format!("1 {one}")),
        count => Some(format!("{count} {many}")),
    });
    let heads: Vec<String> = heads.collect();
    if heads.is_empty() {
        return "<p class=\"well\">No task failed or is unknown.</p>\n".to_owned();
    }
    let more = (stops.len() + tasks.len()).saturating_sub(FAILURES);
    let mut items: String = stops.into_iter().chain(tasks).take(FAILURES).collect();
    if more > 0 {
        items += &format!("<li>{more} more are in the tables below</li>\n");
    }
    format!(
        "<section class=\"failures\"><h2>{}</h2>\n<ul>\n{items}</ul></section>\n",
        heads.join(", ")
    )
}

fn stopped_task(run: &ReportedRun, number: TaskNumber) -> String {
    match (run.task(number), run.found.get(&number)) {
        (Some(task), _) => svg::task_name(run, task),
        (None, Some(name)) => name.clone(),
        (None, None) => format!("task {}", number.0),
    }
}

fn place(run: &ReportedRun, task: &PlayedTask) -> Option<String> {
    let take = run.takes.get(task.take)?;
    let step = take.steps.get(task.step)?;
    let step = run.step_name(take.scene, step.step);
    Some(format!("{} / {step}", svg::take_name(run, take)))
}

/// A line of the box at the top. `nth`: the number of the run.
fn item(
    (nth, runs): (usize, &[ReportedRun]),
    state: &str,
    why: &str,
    what: &str,
    place: Option<String>,
    at: Duration,
) -> String {
    let colon = if why.is_empty() { "" } else { ": " };
    let run = match runs {
        [_] => None,
        runs => runs
            .get(nth.wrapping_sub(1))
            .map(|run| run.record.name.clone()),
    };
    let place: Vec<String> = run.into_iter().chain(place).collect();
    let comma = if place.is_empty() { "" } else { ", " };
    format!(
        "<li><b>{}</b>{colon}{} <small><code>{}</code>{comma}{} at <a href=\"#run-{nth}\">{} s</a></small></li>\n",
        escape(state),
        escape(why),
        escape(what),
        escape(&place.join(", ")),
        seconds(at),
    )
}

/// Most lines of the box at the top.
const FAILURES: usize = 20;
