//! The middle of the screen: scenes, steps and tasks, as lines.

use std::collections::BTreeMap;
use std::time::Duration;

use ztl_script::event::{Question, SceneOutline, StepOutline, TaskOutline, TaskState};

use super::board::{Board, Look, Step, Task};
use super::choose::Chooser;
use super::message::Paragraph;
use super::text::{self, Line, Style, clip};

/// A line of what is shown in the middle.
enum Row<'a> {
    Scene(usize, &'a SceneOutline),
    /// To choose among.
    Choice(usize, &'a SceneOutline),
    Step(&'a StepOutline, Option<&'a Step>),
    Planned(&'a TaskOutline),
    Task(&'a Task),
    Words(Style, String),
}

/// Rows of which a part is shown, around the one that matters. Only what is shown is made into lines:
/// a scene may have thousands.
pub(super) struct Body<'a> {
    rows: Vec<Row<'a>>,
    focus: Option<usize>,
}

/// What is seen of a body: where it begins, and how many lines it has.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct Seen {
    pub(super) from: usize,
    pub(super) height: usize,
}

/// The rows from `top` on; without it, those around the one that matters.
pub(super) fn window(
    board: &Board,
    body: &Body<'_>,
    top: Option<usize>,
    now: Duration,
    (height, width): (usize, usize),
) -> (Vec<Line>, Seen) {
    let count = body.rows.len();
    // A third of what can be seen lies above the line that matters.
    let usual = || body.focus.unwrap_or(0).saturating_sub(height / 3);
    let from = top.unwrap_or_else(usual).min(count.saturating_sub(height));
    let focus = body.focus;
    let to = from + height;
    let more = |sign: char, lines: usize| {
        Line::new(width).and(Style::Soft, &format!(" {sign} {lines} more lines"))
    };
    let rows = body.rows.iter().enumerate().skip(from).take(height);
    // What tells of more is never in place of the line that matters.
    let lines = rows.map(|(nth, row)| match nth {
        _ if Some(nth) == focus || height <= 2 => line(board, row, focus == Some(nth), now, width),
        _ if nth == from && from > 0 => more('↑', from + 1),
        _ if nth + 1 == to && to < count => more('↓', count - to + 1),
        _ => line(board, row, false, now, width),
    });
    (lines.collect(), Seen { from, height })
}

fn line(board: &Board, row: &Row<'_>, focus: bool, now: Duration, width: usize) -> Line {
    match *row {
        Row::Scene(nth, scene) => scene_line(board, nth, scene, now, width),
        Row::Choice(nth, scene) => {
            let (style, sign) = if focus {
                (Style::Bar, '▶')
            } else {
                (Style::Plain, ' ')
            };
            let text = format!(" {sign} {:>2}  {} ", nth + 1, scene.name);
            Line::new(width).and(style, &text)
        }
        Row::Step(step, shown) => step_line(step, shown, now, width),
        Row::Planned(task) => {
            let text = format!("{} [{}] -> {}", task.handler, task.component, task.goal);
            Line::new(width).and(Style::Soft, &format!("         {text}"))
        }
        Row::Task(task) => task_line(task, 6, now, width),
        Row::Words(style, ref words) => Line::new(width).and(style, words),
    }
}

/// The scenes that can be chosen.
pub(super) fn scene_list<'b>(board: &'b Board, chooser: &Chooser) -> Body<'b> {
    let scenes = &board.outline.scenes;
    let chosen = chooser.rows(scenes);
    let row = |nth: &usize| Some(Row::Choice(*nth, scenes.get(*nth)?));
    Body {
        rows: chosen.iter().filter_map(row).collect(),
        focus: chosen.iter().position(|nth| Some(*nth) == chooser.cursor),
    }
}

/// Paragraphs on a page of their own.
pub(super) fn page<'b>(said: &[Paragraph], width: usize) -> Body<'b> {
    let lines = said.iter().flat_map(|(style, text)| {
        let pieces = text::wrap(text, width.saturating_sub(1), usize::MAX);
        let row = |piece: String| Row::Words(*style, format!(" {piece}"));
        pieces.into_iter().map(row).collect::<Vec<_>>()
    });
    Body {
        rows: lines.collect(),
        focus: None,
    }
}

/// Scenes, steps and tasks; `all`: also every task in the background.
pub(super) fn body(board: &Board, all: bool) -> Body<'_> {
    let mut rows = Vec::new();
    let mut focus = 0;
    for (nth, scene) in board.outline.scenes.iter().enumerate() {
        let here = board.scene == Some(nth);
        if here {
            focus = rows.len();
        }
        rows.push(Row::Scene(nth, scene));
        if !here {
            continue;
        }
        let asked = board.question == Some(Question::Scene { scene: nth });
        let played = board
            .played
            .as_ref()
            .filter(|played| played.scene == nth && !asked);
        let mut tasks = by_step(board, nth);
        for (index, step) in scene.steps.iter().enumerate() {
            let shown = played.and_then(|played| played.steps.get(index));
            rows.push(Row::Step(step, shown));
            let Some(shown) = shown else {
                rows.extend(step.tasks.iter().map(Row::Planned));
                continue;
            };
            let playing = shown.look == Look::Playing;
            if playing {
                focus = rows.len() - 1;
            }
            for task in tasks.remove(&index).unwrap_or_default() {
                // Those that run on when their step is over are shown in the background.
                if playing || task.state.is_over() {
                    rows.push(Row::Task(task));
                }
                if playing && task.state != TaskState::Completed {
                    focus = rows.len() - 1;
                }
            }
        }
    }
    if all {
        let mut tasks = board.in_background().peekable();
        if tasks.peek().is_some() {
            let words = " in the background:".to_owned();
            rows.push(Row::Words(Style::Soft, words));
        }
        rows.extend(tasks.map(Row::Task));
    }
    Body {
        rows,
        focus: Some(focus),
    }
}

/// The tasks of the scene that is played, by their steps.
fn by_step(board: &Board, scene: usize) -> BTreeMap<usize, Vec<&Task>> {
    let mut steps: BTreeMap<usize, Vec<&Task>> = BTreeMap::new();
    for task in board
        .tasks
        .values()
        .filter(|task| task.current && task.scene == scene)
    {
        steps.entry(task.step).or_default().push(task);
    }
    steps
}

fn sign(look: Look) -> (Style, &'static str) {
    match look {
        Look::ToCome => (Style::Soft, "·"),
        Look::Playing => (Style::Active, "▶"),
        Look::Well => (Style::Good, "✓"),
        Look::Badly => (Style::Bad, "✗"),
        Look::Stopped => (Style::Warning, "■"),
        Look::Skipped => (Style::Soft, "−"),
    }
}

pub(super) fn scene_line(
    board: &Board,
    nth: usize,
    scene: &SceneOutline,
    now: Duration,
    width: usize,
) -> Line {
    let look = board.scenes.get(nth).copied().unwrap_or_default();
    let here = board.scene == Some(nth);
    let (style, sign) = sign(look);
    let mut line = Line::new(width).and(style, &format!(" {sign} "));
    let name = if here { Style::Strong } else { Style::Plain };
    let length = board.lengths.get(nth).copied().flatten();
    let right = match (&board.played, look, length) {
        (_, Look::Skipped, _) => "skipped".to_owned(),
        (Some(played), Look::Playing, _) if played.scene == nth => {
            clock(played.to.unwrap_or(now).saturating_sub(played.from))
        }
        (_, Look::ToCome, _) if scene.delay.is_zero() => String::new(),
        (_, Look::ToCome, _) => format!("after {}", clock(scene.delay)),
        (.., length) => length.map(clock).unwrap_or_default(),
    };
    let room = width.saturating_sub(line.width() + right.chars().count() + 2);
    line.put(name, &clip(&format!("{} {}", nth + 1, scene.name), room));
    line.put_right(Style::Soft, &right);
    line
}

fn step_line(step: &StepOutline, shown: Option<&Step>, now: Duration, width: usize) -> Line {
    let look = shown.map_or(Look::ToCome, |shown| shown.look);
    let (style, sign) = sign(look);
    let mut line = Line::new(width).and(style, &format!("     {sign} "));
    let mut words = Vec::new();
    if !step.wait {
        words.push("in background".to_owned());
    }
    if step.parallel {
        words.push("parallel".to_owned());
    }
    match shown.filter(|shown| !matches!(shown.look, Look::ToCome | Look::Skipped)) {
        Some(shown) => {
            let since = shown.to.unwrap_or(now).saturating_sub(shown.from);
            // Until its delay has passed nothing is sent.
            if shown.to.is_none() && since < step.delay {
                words.push(format!("in {}", clock(step.delay.saturating_sub(since))));
            }
            words.push(clock(since));
        }
        None if !step.delay.is_zero() => words.push(format!("after {}", clock(step.delay))),
        None => {}
    }
    let right = words.join("  ");
    let style = if look == Look::Playing {
        Style::Strong
    } else {
        Style::Plain
    };
    let room = width.saturating_sub(line.width() + right.chars().count() + 2);
    line.put(style, &clip(&step.name, room));
    line.put_right(Style::Soft, &right);
    line
}

fn task_sign(state: TaskState) -> (Style, &'static str) {
    match state {
        TaskState::Asked | TaskState::Initiated | TaskState::Accepted => (Style::Active, "▶"),
        TaskState::Completed => (Style::Good, "✓"),
        TaskState::Aborted => (Style::Warning, "■"),
        TaskState::Unknown => (Style::Warning, "?"),
        _ => (Style::Bad, "✗"),
    }
}

/// How far a task has come, if it says so in percent.
pub(super) fn percent(text: &str) -> Option<u8> {
    let text = text.trim();
    let number = text
        .strip_suffix('%')
        .or_else(|| text.strip_suffix("percent"))?
        .trim();
    let value: f32 = number.parse().ok()?;
    (0.0..=100.0).contains(&value).then_some(value as u8)
}

pub(super) fn task_line(task: &Task, indent: usize, now: Duration, width: usize) -> Line {
    let (style, sign) = task_sign(task.state);
    let mut line = Line::new(width).and(style, &format!("{}{sign} ", " ".repeat(indent + 3)));
    let right = clock(task.to.unwrap_or(now).saturating_sub(task.from));
    let again = if task.again { "↻ " } else { "" };
    // Names get half of what there is, states and times are never cut.
    let state = task.state.to_string();
    let fixed = line.width() + state.len() + right.len() + 5;
    let room = width.saturating_sub(fixed);
    let text_room = room / 2;
    let name = clip(
        &format!("{again}{}", task.name),
        room - text_room.min(task.text.chars().count()),
    );
    line.put(Style::Plain, &name);
    line.put(Style::Plain, "  ");
    line.put(style, &state);
    line.put(Style::Plain, "  ");
    let left = width.saturating_sub(line.width() + right.len() + 1);
    match percent(&task.text).filter(|_| !task.state.is_over()) {
        Some(percent) if left >= 16 => {
            let full = usize::from(percent / 10);
            let bar = format!("{}{}", "█".repeat(full), "░".repeat(10 - full.min(10)));
            line.put(Style::Active, &format!("{bar} {percent} %"));
        }
        _ => line.put(Style::Plain, &clip(&task.text, left)),
    }
    line.put_right(Style::Soft, &right);
    line
}

/// Seconds with a tenth, or minutes and seconds.
pub(super) fn clock(time: Duration) -> String {
    let whole = time.as_secs();
    match whole {
        0..60 => format!("{whole}.{} s", time.subsec_millis() / 100),
        60..3600 => format!("{}:{:02}", whole / 60, whole % 60),
        _ => format!(
            "{}:{:02}:{:02}",
            whole / 3600,
            whole % 3600 / 60,
            whole % 60
        ),
    }
}
