//! The screen, as a function of what is known: no terminal, no clock.

use std::collections::BTreeMap;
use std::time::Duration;

use ztl_std::script::event::{
    Outcome, Question, SceneOutline, ServerState, StepOutline, TaskOutline, TaskState, Why,
};

use super::board::{Board, Look, Played, Server, Step, Task};
use super::keys::{self, Chooser};
use super::text::{self, Line, Style, clip};

/// Draws it all: exactly `height` lines, none wider than `width`. `now` is the time of the run.
pub(super) fn draw(
    board: &Board,
    chooser: Option<Chooser>,
    now: Duration,
    (width, height): (usize, usize),
) -> Vec<Line> {
    let keys = key_lines(board, chooser, width);
    let message = message(board, now, width);
    // What has to be seen comes first; on a small screen the rest goes.
    let mut left = height.saturating_sub(keys.len() + message.len());
    let mut take = |lines: Vec<Line>, least: usize| {
        if lines.len() + least > left {
            return Vec::new();
        }
        left -= lines.len();
        lines
    };
    let title = take(vec![title(board, now, width)], 1);
    let servers = take(vec![servers(board, now, width)], 4);
    let most = if height < 16 { 2 } else { height / 4 };
    let background = take(background(board, now, width, most), 4);
    let rule = take(vec![rule(width)], 6);
    let body = match chooser {
        Some(chooser) => scene_list(board, chooser),
        None => body(board),
    };
    let body = window(board, &body, now, left, width);
    let mut lines = title;
    lines.extend(servers);
    lines.extend(body);
    let fixed = background.len() + rule.len() + message.len() + keys.len();
    lines.resize(height.saturating_sub(fixed), Line::new(width));
    lines.extend(background);
    lines.extend(rule);
    lines.extend(message);
    lines.extend(keys);
    // Of a screen that is too small even for keys, the last line of them.
    let surplus = lines.len().saturating_sub(height);
    lines.drain(..surplus);
    lines
}

/// What is left on the terminal when the view has gone: how each scene went, what did not go well, and
/// how it ended.
pub(super) fn summary(board: &Board, width: usize) -> Vec<Line> {
    let scenes = board.outline.scenes.iter().enumerate();
    let mut lines: Vec<Line> = scenes
        .map(|(nth, scene)| scene_line(board, nth, scene, board.at, width))
        .collect();
    let bad = board
        .tasks
        .values()
        .filter(|task| task.state != TaskState::Completed);
    lines.extend(bad.map(|task| task_line(task, 0, board.at, width)));
    lines.extend(message(board, board.at, width));
    lines
}

/// Seconds with a tenth, or minutes and seconds.
fn clock(time: Duration) -> String {
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

fn rule(width: usize) -> Line {
    Line::new(width).and(Style::Soft, &"─".repeat(width))
}

fn title(board: &Board, now: Duration, width: usize) -> Line {
    let mut words = format!(" {} ", board.script);
    if let Some(scene) = board.scene {
        let of = board.outline.scenes.len();
        words += &format!("  scene {} of {of}", scene + 1);
    }
    let again = |played: &&Played| played.take > 1 && played.to.is_none();
    if let Some(played) = board.played.as_ref().filter(again) {
        words += &format!(", take {}", played.take);
    }
    let time = format!(" {} ", clock(now));
    let room = width.saturating_sub(time.len());
    let mut line = Line::new(width).and(Style::Bar, &clip(&words, room));
    line.put_right(Style::Bar, &time);
    line
}

fn servers(board: &Board, now: Duration, width: usize) -> Line {
    let mut line = Line::new(width).and(Style::Soft, " servers");
    for (name, server) in &board.servers {
        let (style, says) = server_words(server, now);
        line.put(Style::Plain, &format!("  {name} "));
        line.put(style, &says);
    }
    line
}

fn server_words(server: &Server, now: Duration) -> (Style, String) {
    match &server.state {
        None => (Style::Soft, "·".to_owned()),
        Some(ServerState::Answering { .. }) => match server.latency {
            Some(latency) => {
                let millis = latency.as_secs_f64() * 1000.0;
                (Style::Good, format!("✓ {millis:.0} ms"))
            }
            None => (Style::Good, "✓".to_owned()),
        },
        Some(ServerState::Silent) => {
            let since = clock(now.saturating_sub(server.since));
            (Style::Warning, format!("silent for {since}"))
        }
        Some(ServerState::Absent) => (Style::Bad, "✗ not there".to_owned()),
        Some(ServerState::Restarted) => (Style::Warning, "started anew".to_owned()),
    }
}

/// A line of what is shown in the middle.
enum Row<'a> {
    Scene(usize, &'a SceneOutline),
    /// To choose among.
    Choice(usize, &'a SceneOutline),
    Step(&'a StepOutline, Option<&'a Step>),
    Planned(&'a TaskOutline),
    Task(&'a Task),
}

/// Rows of which a part is shown, around the one that matters. Only what is shown is made into lines:
/// a scene may have thousands.
struct Body<'a> {
    rows: Vec<Row<'a>>,
    focus: usize,
}

fn window(board: &Board, body: &Body<'_>, now: Duration, height: usize, width: usize) -> Vec<Line> {
    let count = body.rows.len();
    // A third of what can be seen lies above the line that matters.
    let from = body.focus.saturating_sub(height / 3);
    let from = from.min(count.saturating_sub(height));
    let to = from + height;
    let more = |sign: char, lines: usize| {
        Line::new(width).and(Style::Soft, &format!(" {sign} {lines} more lines"))
    };
    let rows = body.rows.iter().enumerate().skip(from).take(height);
    // What tells of more is never in place of the line that matters.
    let lines = rows.map(|(nth, row)| match nth {
        _ if nth == body.focus || height <= 2 => line(board, row, body.focus == nth, now, width),
        _ if nth == from && from > 0 => more('↑', from + 1),
        _ if nth + 1 == to && to < count => more('↓', count - to + 1),
        _ => line(board, row, false, now, width),
    });
    lines.collect()
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
    }
}

fn scene_list(board: &Board, chooser: Chooser) -> Body<'_> {
    let scenes = board.outline.scenes.iter().enumerate();
    Body {
        rows: scenes.map(|(nth, scene)| Row::Choice(nth, scene)).collect(),
        focus: chooser.cursor,
    }
}

fn body(board: &Board) -> Body<'_> {
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
    Body { rows, focus }
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

fn scene_line(
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
fn percent(text: &str) -> Option<u8> {
    let text = text.trim();
    let number = text
        .strip_suffix('%')
        .or_else(|| text.strip_suffix("percent"))?
        .trim();
    let value: f32 = number.parse().ok()?;
    (0.0..=100.0).contains(&value).then_some(value as u8)
}

fn task_line(task: &Task, indent: usize, now: Duration, width: usize) -> Line {
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

fn background(board: &Board, now: Duration, width: usize, most: usize) -> Vec<Line> {
    let tasks: Vec<&Task> = board.in_background().collect();
    if tasks.is_empty() {
        return Vec::new();
    }
    let head = format!("─ in the background: {} ", tasks.len());
    let mut lines = vec![Line::new(width).and(Style::Soft, &head)];
    if let Some(line) = lines.first_mut() {
        let rest = width.saturating_sub(line.width());
        line.put(Style::Soft, &"─".repeat(rest));
    }
    let shown = if tasks.len() > most {
        most - 1
    } else {
        tasks.len()
    };
    lines.extend(
        tasks
            .iter()
            .take(shown)
            .map(|task| task_line(task, 0, now, width)),
    );
    if tasks.len() > shown {
        let more = format!("   and {} more", tasks.len() - shown);
        lines.push(Line::new(width).and(Style::Soft, &more));
    }
    lines
}

/// What the operator has to know now.
fn message(board: &Board, now: Duration, width: usize) -> Vec<Line> {
    let mut lines = Vec::new();
    let mut say = |style, text: &str| {
        let pieces = text::wrap(text, width.saturating_sub(1), 3);
        lines.extend(
            pieces
                .iter()
                .map(|text| Line::new(width).and(style, &format!(" {text}"))),
        );
    };
    if let Some((outcome, running, text)) = &board.ended {
        let (style, words) = outcome_words(*outcome);
        say(style, words);
        if !running.is_empty() {
            say(
                Style::Warning,
                &format!("{} tasks may still be under way", running.len()),
            );
        }
        if !text.is_empty() {
            say(Style::Bad, text);
        }
    } else if let Some(stopping) = &board.stopping {
        let open = stopping.values().filter(|answer| answer.is_none()).count();
        match open {
            0 => say(Style::Strong, "STOPPED EVERYTHING"),
            open => say(
                Style::Warning,
                &format!("STOPPING EVERYTHING: {open} not confirmed yet"),
            ),
        }
        // The last ones are those that somebody waits for.
        for (number, answer) in stopping.iter().take(6) {
            let name = board
                .tasks
                .get(number)
                .map_or_else(|| format!("task {}", number.0), |task| task.name.clone());
            match answer {
                None => say(Style::Warning, &format!("  ? {name}: no word yet")),
                Some((true, text)) => say(Style::Good, &format!("  ✓ {name}: {text}")),
                Some((false, text)) => say(Style::Bad, &format!("  ✗ {name}: {text}")),
            }
        }
        if stopping.len() > 6 {
            say(Style::Soft, &format!("  and {} more", stopping.len() - 6));
        }
    } else if let Some((why, tasks)) = &board.waiting {
        let decide = if board.question.is_some() {
            " Decide."
        } else {
            ""
        };
        say(
            Style::Warning,
            &format!("WAITING: {}.{decide}", why_words(board, why, now)),
        );
        for task in tasks
            .iter()
            .filter_map(|number| board.tasks.get(number))
            .take(3)
        {
            let colon = if task.text.is_empty() { "" } else { ": " };
            say(
                Style::Plain,
                &format!("  {} {}{colon}{}", task.name, task.state, task.text),
            );
        }
    } else {
        match board.question {
            Some(Question::Scene { scene }) => {
                let name = board
                    .outline
                    .scenes
                    .get(scene)
                    .map_or("", |scene| scene.name.as_str());
                say(Style::Strong, &format!("Next: {name}"));
            }
            Some(Question::End) => say(Style::Strong, "The last scene is over."),
            Some(Question::Pause) => say(Style::Warning, "PAUSE"),
            Some(Question::Step { .. }) => say(Style::Warning, "Decide how to go on."),
            None if board.pause => say(Style::Warning, "There will be a pause after this step."),
            None => {}
        }
    }
    // The newest, for which there is room.
    for note in board.notes.iter().rev().take(3).rev() {
        say(Style::Warning, note);
    }
    if let Some((key, None, at)) = &board.key
        && board.ended.is_none()
        && now.saturating_sub(*at) < Duration::from_secs(3)
    {
        say(Style::Soft, &format!("{key} means nothing now"));
    }
    lines
}

const fn outcome_words(outcome: Outcome) -> (Style, &'static str) {
    match outcome {
        Outcome::Completed => (Style::Good, "Over: all went well."),
        Outcome::Failures => (Style::Bad, "Over: not all went well."),
        Outcome::Stopped => (Style::Warning, "Over: everything was stopped."),
        Outcome::Left => (Style::Warning, "Left."),
        Outcome::Error => (Style::Bad, "Ended by an error."),
    }
}

fn why_words(board: &Board, why: &Why, now: Duration) -> String {
    match why {
        Why::ServerSilent { remote } => {
            let server = board.servers.iter().find(|(name, _)| name == remote);
            let since = server.map(|(_, server)| clock(now.saturating_sub(server.since)));
            let since = since
                .map(|since| format!(" for {since}"))
                .unwrap_or_default();
            format!("server '{remote}' is silent{since}; what its tasks do is unknown")
        }
        Why::ServerRestarted { remote } => {
            format!("server '{remote}' was started anew; what became of its tasks is unknown")
        }
        Why::TaskUnknown => "a server does not know its task any more".to_owned(),
        Why::StartUnknown => "nobody knows whether a task was started".to_owned(),
        Why::Failed => "something did not go well".to_owned(),
        Why::TooLong => "a task takes longer than its limit".to_owned(),
    }
}

fn key_lines(board: &Board, chooser: Option<Chooser>, width: usize) -> Vec<Line> {
    let keys = match chooser {
        Some(_) => vec![
            ("1-9", "jump there".to_owned()),
            ("Up Down", "choose".to_owned()),
            ("Enter", "jump".to_owned()),
            ("Esc", "do not jump".to_owned()),
            ("Ctrl-C", "stop everything".to_owned()),
        ],
        None => keys::help(board),
    };
    let mut lines = Vec::new();
    let mut line = Line::new(width);
    for (key, words) in keys {
        let length = key.len() + words.chars().count() + 5;
        if line.width() > 0 && line.width() + length > width {
            lines.push(std::mem::replace(&mut line, Line::new(width)));
        }
        line.put(Style::Plain, " ");
        line.put(Style::Bar, &format!(" {key} "));
        line.put(Style::Plain, &format!(" {words} "));
    }
    lines.push(line);
    lines
}

#[cfg(test)]
mod tests;
