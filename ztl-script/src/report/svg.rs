//! Timelines as SVG.

use std::fmt::Write as _;
use std::time::Duration;

use super::run::{Action, PlayedScene, PlayedStep, PlayedTask, ReportedRun, Wait, WaitCause};
use super::words;
use crate::drawing::{Axis, Drawing, Layout, NARROW, WIDE, escape};
use crate::durations::{difference, spoken};
use crate::event::{Ending, TaskState};

/// Height of a row of the overview.
const ROW: f64 = 24.0;
/// Most rows of one drawing, to fit on a printed page.
const ROWS: usize = 26;
/// Most background tasks in the overview.
const IN_BACKGROUND: usize = 10;

/// The whole run: scenes, waits, the operator's actions, and background tasks.
pub(super) fn overview(run: &ReportedRun) -> String {
    [&WIDE, &NARROW]
        .map(|layout| overview_in(run, layout))
        .concat()
}

fn overview_in(run: &ReportedRun, layout: &'static Layout) -> String {
    let mut drawing = Drawing::new(layout);
    let axis = Axis::new(
        Duration::ZERO,
        run.length,
        layout.overview,
        layout.width - 14.0,
    );
    let background: Vec<&PlayedTask> = run
        .tasks
        .iter()
        .filter(|task| outlives(run, task))
        .collect();
    let shown = background.len().min(IN_BACKGROUND);
    let rows = 3.0 + shown as f64 + if background.len() > shown { 1.0 } else { 0.0 };
    let top = 18.0;
    drawing.height = top + rows * ROW + 20.0;
    drawing.scale(&axis, 0.0, drawing.height - 4.0);

    drawing.text("name", 0.0, top + 16.0, "scenes");
    for (nth, take) in run.takes.iter().enumerate() {
        let x = (axis.x(take.from), axis.x(take.to));
        let name = take_name(run, take);
        let data = data("take", nth + 1, take.from, take.to);
        let title = format!("{name}: {}", words::ending(take.end));
        drawing.bar("scene", x, (top + 2.0, top + 22.0), &data, &title);
        let room = ((x.1 - x.0 - 8.0) / 6.6).max(0.0) as usize;
        // Instead of an unrecognizable rest of the name, show the number.
        let short = match name.chars().count() {
            count if count <= room || room >= 12 => name,
            _ => (take.scene + 1).to_string(),
        };
        if short.chars().count() <= room || room >= 12 {
            drawing.cut("in-bar", x.0 + 4.0, top + 16.0, &short, x.1 - x.0 - 6.0);
        }
    }
    let y = top + ROW;
    drawing.text("name", 0.0, y + 16.0, "waits");
    for wait in &run.waits {
        draw_wait(&mut drawing, &axis, wait, (y + 5.0, y + 19.0));
    }
    let y = y + ROW;
    drawing.text("name", 0.0, y + 16.0, "operator");
    for action in run.actions.iter().filter(|action| action.decided) {
        let x = axis.x(action.at);
        let what = action.command.map(|command| words::command(run, command));
        let title = format!(
            "{} s: {}",
            action.at.as_secs_f64(),
            what.unwrap_or_default()
        );
        let class = if action.deviation {
            "mark"
        } else {
            "mark plain"
        };
        let _ = writeln!(
            drawing.out,
            "<path class=\"{class}\" d=\"M{x:.1} {:.1}l5 9h-10z\"><title>{}</title></path>",
            y + 7.0,
            escape(&title)
        );
    }
    let mut y = y + ROW;
    for task in background.iter().take(shown) {
        let name = task_name(run, task);
        drawing.cut("name small", 0.0, y + 16.0, &name, layout.overview - 6.0);
        draw_task(
            &mut drawing,
            &axis,
            task,
            (y + 7.0, y + 17.0),
            &name,
            run.length,
        );
        y += ROW;
    }
    if background.len() > shown {
        let more = background.len() - shown;
        drawing.text(
            "name small",
            0.0,
            y + 16.0,
            &format!("and {more} more in the background, shown with their scenes"),
        );
    }
    drawing.end(&format!("Timeline of {}", run.record.name))
}

/// One played scene: one or more drawings, none longer than a page.
pub(super) fn take(run: &ReportedRun, nth: usize, take: &PlayedScene) -> String {
    let mut out = String::new();
    let mut chunk: Vec<usize> = Vec::new();
    let mut rows = 0;
    let chunks = {
        let mut chunks = Vec::new();
        for index in 0..take.steps.len() {
            let more = 1 + run.tasks_of(nth, index).count();
            if !chunk.is_empty() && rows + more > ROWS {
                chunks.push(std::mem::take(&mut chunk));
                rows = 0;
            }
            chunk.push(index);
            rows += more;
        }
        chunks.push(chunk);
        chunks
    };
    let count = chunks.len();
    for (part, steps) in chunks.iter().enumerate() {
        let from = match steps.first().and_then(|step| take.steps.get(*step)) {
            Some(step) if part > 0 => step.from,
            _ => take.from,
        };
        let to = match steps.last().and_then(|step| take.steps.get(*step)) {
            Some(step) if part + 1 < count => step.to,
            _ => take.to,
        };
        for layout in [&WIDE, &NARROW] {
            out += &steps_drawing(run, (nth, take), steps, (from, to), layout);
        }
    }
    out
}

fn steps_drawing(
    run: &ReportedRun,
    (nth, take): (usize, &PlayedScene),
    steps: &[usize],
    (from, to): (Duration, Duration),
    layout: &'static Layout,
) -> String {
    let mut drawing = Drawing::new(layout);
    let (left, right) = layout.bars();
    let axis = Axis::new(from, to, left, right);
    let lift = layout.lift();
    let (remarks, remark_width) = layout.remark();
    let marks: Vec<&Action> = run
        .actions
        .iter()
        .filter(|action| action.decided && action.deviation && axis.shows(action.at, action.at))
        .collect();
    let lanes = label_lanes(run, &axis, &marks, layout.width);
    let top = 20.0 + lanes.iter().map(|(_, _, lane)| lane + 1).max().unwrap_or(0) as f64 * 14.0;
    let rows: usize = steps
        .iter()
        .map(|step| 1 + run.tasks_of(nth, *step).count())
        .sum();
    drawing.height = top + rows as f64 * layout.row + 6.0;
    drawing.scale(&axis, 0.0, drawing.height);

    let mut y = top;
    for index in steps {
        let Some(step) = take.steps.get(*index) else {
            continue;
        };
        draw_step(&mut drawing, run, take, &axis, step, y);
        for wait in &run.waits {
            if wait.from >= step.from && wait.from <= step.to {
                let y = y + lift;
                draw_wait(&mut drawing, &axis, wait, (y + 9.0, y + 18.0));
            }
        }
        y += layout.row;
        for task in run.tasks_of(nth, *index) {
            let name = task_name(run, task);
            let shown = task.retry_of.map_or(name.clone(), |_| format!("↻ {name}"));
            let width = layout.name_width() - 20.0;
            drawing.cut("name task", 14.0, y + 14.0, &shown, width);
            drawing.cut("remark", remarks, y + 14.0, &remark(task), remark_width);
            let bars = y + lift;
            if let Some(planned) = task.planned_from
                && task.from > planned
            {
                let x = (axis.x(planned), axis.x(task.from));
                drawing.line("late", (x.0, bars + 10.0), (x.1, bars + 10.0));
                drawing.line("due", (x.0, bars + 5.0), (x.0, bars + 15.0));
            }
            let place = (bars + 5.0, bars + 15.0);
            draw_task(&mut drawing, &axis, task, place, &name, run.length);
            y += layout.row;
        }
    }
    for (action, x, lane) in lanes {
        let at = axis.x(action.at);
        let y = 30.0 + lane as f64 * 14.0;
        drawing.line("mark-line", (at, y - 8.0), (at, drawing.height));
        let what = action.command.map(|command| words::command(run, command));
        drawing.cut(
            "mark-text",
            x,
            y,
            &what.unwrap_or_default(),
            LABEL as f64 * 6.6,
        );
    }
    drawing.end(&format!("Timeline of {}", take_name(run, take)))
}

/// Longest text at a mark, in characters.
const LABEL: usize = 24;

/// Places the texts of marks so that none covers another: x coordinate and lane.
fn label_lanes<'a>(
    run: &ReportedRun,
    axis: &Axis,
    marks: &[&'a Action],
    width: f64,
) -> Vec<(&'a Action, f64, usize)> {
    let mut ends: Vec<f64> = Vec::new();
    let mut lanes = Vec::new();
    for action in marks {
        let what = action.command.map(|command| words::command(run, command));
        let length = what.map_or(0, |what| what.chars().count().min(LABEL)) as f64 * 6.4;
        // A text near the right edge moves left.
        let at = axis.x(action.at);
        let x = (at + 4.0).min(width - length).max(0.0);
        let free = ends.iter().position(|end| *end + 6.0 < x);
        let lane = free.unwrap_or(ends.len());
        match ends.get_mut(lane) {
            Some(end) => *end = x + length,
            None => ends.push(x + length),
        }
        lanes.push((*action, x, lane));
    }
    lanes
}

fn draw_step(
    drawing: &mut Drawing,
    run: &ReportedRun,
    take: &PlayedScene,
    axis: &Axis,
    step: &PlayedStep,
    y: f64,
) {
    let layout = drawing.layout;
    let name = run.step_name(take.scene, step.step);
    drawing.cut("name step", 0.0, y + 15.0, &name, layout.name_width() - 6.0);
    let bars = y + layout.lift();
    if let Some(planned) = step.planned {
        let to = step.from + planned;
        let title = format!("{name}: {} planned", spoken(planned));
        let attributes = data("plan", step.step + 1, step.from, to);
        let place = (axis.x(step.from), axis.x(to));
        drawing.bar("plan", place, (bars + 4.0, bars + 8.0), &attributes, &title);
    }
    let actual = (axis.x(step.from), axis.x(step.to));
    let attributes = data("step", step.step + 1, step.from, step.to);
    let title = format!(
        "{name}: {}, {}",
        words::ending(step.end),
        spoken(step.length())
    );
    drawing.bar(
        "actual",
        actual,
        (bars + 9.0, bars + 18.0),
        &attributes,
        &title,
    );
    let background = run
        .step(take.scene, step.step)
        .is_some_and(|step| !step.wait);
    let end = match step.end {
        Some(Ending::Completed) if background => "in the background",
        end => words::ending(end),
    };
    // There is no room for it in the narrow layout.
    let more = step
        .planned
        .filter(|_| layout.names.is_some())
        .map(|planned| format!("({})", difference(step.length(), planned)));
    let more = more.unwrap_or_default();
    let remark = format!("{} {more} {end}", spoken(step.length()));
    let (x, width) = layout.remark();
    drawing.cut(
        "remark step",
        x,
        y + 15.0,
        &remark.replace("  ", " "),
        width,
    );
}

fn draw_wait(drawing: &mut Drawing, axis: &Axis, wait: &Wait, y: (f64, f64)) {
    let class = match wait.cause {
        WaitCause::Operator => "wait operator",
        WaitCause::Pause => "wait pause",
        WaitCause::Unsettled(_) => "wait unsettled",
    };
    let length = spoken(wait.to.saturating_sub(wait.from));
    let title = format!("wait: {}, {length}", words::cause(&wait.cause));
    let x = (axis.x(wait.from), axis.x(wait.to));
    drawing.bar(class, x, y, &data("wait", 0, wait.from, wait.to), &title);
}

/// A task's bar: asked, running, unknown; with a sign for its final state.
fn draw_task(
    drawing: &mut Drawing,
    axis: &Axis,
    task: &PlayedTask,
    (top, bottom): (f64, f64),
    name: &str,
    end_of_run: Duration,
) {
    let to = task.to.unwrap_or(end_of_run);
    if !axis.shows(task.from, to) {
        return;
    }
    let title = format!("{name}: {}", remark(task));
    let begun = task.accepted.unwrap_or(to);
    let middle = (top + bottom) / 2.0;
    let asked = (axis.x(task.from), axis.x(begun));
    drawing.bar("asked", asked, (middle - 2.0, middle + 2.0), "", &title);
    let class = format!("run {}", class(task.state));
    let attributes = data("task", task.number.0 as usize, task.from, to);
    let under_way = (asked.1, axis.x(to));
    drawing.bar(&class, under_way, (top, bottom), &attributes, &title);
    for (from, to) in &task.unknown {
        let x = (axis.x(*from), axis.x(*to));
        drawing.bar("gap", x, (top, bottom), "", "state unknown");
    }
    let open = task.to.is_none() || to > axis.to;
    let sign = match task.state {
        _ if open => "›",
        TaskState::Completed => "✓",
        TaskState::Aborted => "■",
        state if state.is_failure() => "✗",
        _ => "?",
    };
    drawing.text("sign", under_way.1.max(asked.1) + 3.0, bottom, sign);
}

const fn class(state: TaskState) -> &'static str {
    match state {
        TaskState::Completed => "completed",
        TaskState::Aborted => "aborted",
        TaskState::Unknown => "unknown",
        TaskState::Asked | TaskState::Initiated | TaskState::Accepted => "open",
        _ => "failed",
    }
}

/// Duration, state and lateness of a task.
fn remark(task: &PlayedTask) -> String {
    let late = task
        .late()
        .filter(|late| *late >= Duration::from_millis(50));
    let late = late.map(|late| format!(", {} late", spoken(late)));
    let length = match task.length() {
        Some(length) => spoken(length),
        None => "no end seen".to_owned(),
    };
    format!("{length} {}{}", task.state, late.unwrap_or_default())
}

fn data(kind: &str, number: usize, from: Duration, to: Duration) -> String {
    format!(
        " data-{kind}=\"{number}\" data-from-ms=\"{}\" data-to-ms=\"{}\"",
        from.as_micros() as f64 / 1000.0,
        to.as_micros() as f64 / 1000.0
    )
}

pub(super) fn take_name(run: &ReportedRun, take: &PlayedScene) -> String {
    let name = run.scene_name(take.scene);
    match take.number {
        0 | 1 => name,
        number => format!("{name}, take {number}"),
    }
}

pub(super) fn task_name(run: &ReportedRun, task: &PlayedTask) -> String {
    match run.plan(task) {
        Some((_, plan)) => format!("{}:{}:{}", plan.handler, plan.component, plan.goal),
        None => format!("task {}", task.number.0),
    }
}

/// Whether a task outlives its step.
pub(super) fn outlives(run: &ReportedRun, task: &PlayedTask) -> bool {
    let step = run
        .takes
        .get(task.take)
        .and_then(|take| take.steps.get(task.step));
    let over = task.to.unwrap_or(run.length);
    step.is_some_and(|step| over > step.to)
}
