//! The body of the screen: scenes, steps and tasks.

use std::collections::BTreeMap;
use std::time::Duration;

use ztl_script::event::{Question, SceneOutline, StepOutline, TaskOutline, TaskState};

use super::choose::Chooser;
use super::text::{self, Line, Paragraph, Style, clip, clock, columns};
use ztl_script::board::{Progress, RunBoard, StepRun, TaskRun};

/// A row of the body.
enum Row<'a> {
    Scene(usize, &'a SceneOutline),
    /// A scene in the chooser.
    Choice(usize, &'a SceneOutline),
    Step(&'a StepOutline, Option<&'a StepRun>),
    Planned(&'a TaskOutline),
    Task(&'a TaskRun),
    Words(Style, String),
}

/// All rows. Only the visible ones are rendered, because a scene may have thousands.
pub(super) struct Body<'a> {
    rows: Vec<Row<'a>>,
    /// The row that must be visible.
    focus: Option<usize>,
}

/// What is visible.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub(super) struct Seen {
    /// The first visible row of the body.
    pub(super) from: usize,
    /// The height of the body.
    pub(super) height: usize,
    /// The numbers of the notes in the message.
    pub(super) notes: Vec<u64>,
}

/// Renders the rows from `top` on, or those around the focus.
pub(super) fn window(
    board: &RunBoard,
    body: &Body<'_>,
    top: Option<usize>,
    now: Duration,
    (height, width): (usize, usize),
) -> (Vec<Line>, Seen) {
    let count = body.rows.len();
    // The focus is at a third of the height.
    let usual = || body.focus.unwrap_or(0).saturating_sub(height / 3);
    let from = top.unwrap_or_else(usual).min(count.saturating_sub(height));
    let focus = body.focus;
    let to = from + height;
    let more = |sign: char, lines: usize| {
        Line::new(width).and(Style::Soft, &format!(" {sign} {lines} more lines"))
    };
    let rows = body.rows.iter().enumerate().skip(from).take(height);
    // The markers for more lines never replace the focus.
    let lines = rows.map(|(nth, row)| match nth {
        _ if Some(nth) == focus || height <= 2 => line(board, row, focus == Some(nth), now, width),
        _ if nth == from && from > 0 => more('↑', from + 1),
        _ if nth + 1 == to && to < count => more('↓', count - to + 1),
        _ => line(board, row, false, now, width),
    });
    let notes = Vec::new();
    let seen = Seen {
        from,
        height,
        notes,
    };
    (lines.collect(), seen)
}

fn line(board: &RunBoard, row: &Row<'_>, focus: bool, now: Duration, width: usize) -> Line {
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

/// The scenes of the chooser.
pub(super) fn scene_list<'b>(board: &'b RunBoard, chooser: &Chooser) -> Body<'b> {
    let scenes = &board.outline.scenes;
    let chosen = chooser.rows(scenes);
    let row = |nth: &usize| Some(Row::Choice(*nth, scenes.get(*nth)?));
    Body {
        rows: chosen.iter().filter_map(row).collect(),
        focus: chosen.iter().position(|nth| Some(*nth) == chooser.cursor),
    }
}

/// A page of paragraphs.
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

/// Scenes, steps and tasks; with `all` also the tasks in the background.
pub(super) fn body(board: &RunBoard, all: bool) -> Body<'_> {
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
            let playing = shown.progress == Progress::Playing;
            if playing {
                focus = rows.len() - 1;
            }
            for task in tasks.remove(&index).unwrap_or_default() {
                // Tasks that outlast their step are shown in the background.
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

/// The tasks of the current take, by step.
fn by_step(board: &RunBoard, scene: usize) -> BTreeMap<usize, Vec<&TaskRun>> {
    let mut steps: BTreeMap<usize, Vec<&TaskRun>> = BTreeMap::new();
    for task in board.tasks.values().filter(|task| task.current) {
        if let Some((of, step, _)) = task.place
            && of == scene
        {
            steps.entry(step).or_default().push(task);
        }
    }
    steps
}

fn sign(progress: Progress) -> (Style, &'static str) {
    match progress {
        Progress::Pending => (Style::Soft, "·"),
        Progress::Playing => (Style::Active, "▶"),
        Progress::Completed => (Style::Good, "✓"),
        Progress::Failed => (Style::Bad, "✗"),
        Progress::Stopped => (Style::Warning, "■"),
        Progress::Skipped => (Style::Soft, "−"),
    }
}

pub(super) fn scene_line(
    board: &RunBoard,
    nth: usize,
    scene: &SceneOutline,
    now: Duration,
    width: usize,
) -> Line {
    let progress = board.scenes.get(nth).copied().unwrap_or_default();
    let here = board.scene == Some(nth);
    let (style, sign) = sign(progress);
    let mut line = Line::new(width).and(style, &format!(" {sign} "));
    let name = if here { Style::Strong } else { Style::Plain };
    let length = board.lengths.get(nth).copied().flatten();
    let right = match (&board.played, progress, length) {
        (_, Progress::Skipped, _) => "skipped".to_owned(),
        (Some(played), Progress::Playing, _) if played.scene == nth => {
            clock(played.to.unwrap_or(now).saturating_sub(played.from))
        }
        (_, Progress::Pending, _) if scene.delay.is_zero() => String::new(),
        (_, Progress::Pending, _) => format!("after {}", clock(scene.delay)),
        (.., length) => length.map(clock).unwrap_or_default(),
    };
    let room = width.saturating_sub(line.width() + columns(&right) + 2);
    line.put(name, &clip(&format!("{} {}", nth + 1, scene.name), room));
    line.put_right(Style::Soft, &right);
    line
}

fn step_line(step: &StepOutline, shown: Option<&StepRun>, now: Duration, width: usize) -> Line {
    let progress = shown.map_or(Progress::Pending, |shown| shown.progress);
    let (style, sign) = sign(progress);
    let mut line = Line::new(width).and(style, &format!("     {sign} "));
    let mut words = Vec::new();
    if !step.wait {
        words.push("in background".to_owned());
    }
    if step.parallel {
        words.push("parallel".to_owned());
    }
    match shown.filter(|shown| !matches!(shown.progress, Progress::Pending | Progress::Skipped)) {
        Some(shown) => {
            let since = shown.to.unwrap_or(now).saturating_sub(shown.from);
            // Nothing is sent before the delay has passed.
            if shown.to.is_none() && since < step.delay {
                words.push(format!("in {}", clock(step.delay.saturating_sub(since))));
            }
            words.push(clock(since));
        }
        None if !step.delay.is_zero() => words.push(format!("after {}", clock(step.delay))),
        None => {}
    }
    let right = words.join("  ");
    let style = if progress == Progress::Playing {
        Style::Strong
    } else {
        Style::Plain
    };
    let room = width.saturating_sub(line.width() + columns(&right) + 2);
    line.put(style, &clip(&step.name, room));
    line.put_right(Style::Soft, &right);
    line
}

pub(super) fn task_sign(state: TaskState) -> (Style, &'static str) {
    match state {
        TaskState::Asked | TaskState::Initiated | TaskState::Accepted => (Style::Active, "▶"),
        TaskState::Completed => (Style::Good, "✓"),
        TaskState::Aborted => (Style::Warning, "■"),
        TaskState::Unknown => (Style::Warning, "?"),
        _ => (Style::Bad, "✗"),
    }
}

/// Progress that a task reports in percent.
pub(super) fn percent(text: &str) -> Option<u8> {
    let text = text.trim();
    let number = text
        .strip_suffix('%')
        .or_else(|| text.strip_suffix("percent"))?
        .trim();
    let value: f32 = number.parse().ok()?;
    (0.0..=100.0).contains(&value).then_some(value as u8)
}

pub(super) fn task_line(task: &TaskRun, indent: usize, now: Duration, width: usize) -> Line {
    let (style, sign) = task_sign(task.state);
    let mut line = Line::new(width).and(style, &format!("{}{sign} ", " ".repeat(indent + 3)));
    let right = clock(task.to.unwrap_or(now).saturating_sub(task.from));
    let again = if task.again { "↻ " } else { "" };
    // The name may be cut to half of the room; state and time are never cut.
    let state = task.state.to_string();
    let fixed = line.width() + state.len() + right.len() + 5;
    let room = width.saturating_sub(fixed);
    let text_room = room / 2;
    let name = clip(
        &format!("{again}{}", task.name),
        room - text_room.min(columns(&task.text)),
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
