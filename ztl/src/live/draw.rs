//! Draws the screen as a pure function of the board, the view, the time and the size.

use std::time::Duration;

use ztl_script::event::{ServerState, StepOutline, TaskOutline, TaskState};

use super::choose::Chooser;
use super::keys;
use super::message::{self, message};
use super::rows::{Seen, body, page, scene_line, scene_list, task_line, task_sign, window};
use super::text::{Line, Paragraph, Style, clip, clock, columns};
use ztl_script::board::{RunBoard, SceneRun, ServerView, TaskRun};

/// Lines of a long message that take precedence over keys.
const MESSAGE_LEAST: usize = 2;

/// What the body shows.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub(super) enum Pane {
    #[default]
    Show,
    Choose(Chooser),
    /// All cues, with their keys.
    Cues,
    /// All keys.
    Keys,
    /// All that went wrong.
    Details,
}

/// What the operator looks at.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub(super) struct View {
    pub(super) pane: Pane,
    /// The first visible row, if the operator scrolled.
    pub(super) top: Option<usize>,
}

impl View {
    pub(super) const fn of(pane: Pane) -> Self {
        Self { pane, top: None }
    }
}

/// Draws exactly `height` lines, none wider than `width`. Also returns what is visible. `now` is the time since the
/// start of the run.
pub(super) fn draw(
    board: &RunBoard,
    view: &View,
    now: Duration,
    (width, height): (usize, usize),
) -> (Vec<Line>, Seen) {
    let message = match &view.pane {
        Pane::Choose(chooser) => message::choosing(board, chooser),
        _ => message(board, now),
    };
    let said = &message.said;
    let message_least = message::lines(said, width, MESSAGE_LEAST).0.len();
    let keys = key_lines(
        board,
        view,
        width,
        height.saturating_sub(message_least).max(1),
    );
    let room = height.saturating_sub(keys.len());
    // A long message leaves some lines for the body.
    let most = if room < 8 { room } else { room * 3 / 4 };
    let (said, whole) = message::lines(said, width, most);
    let notes = message.notes(whole);
    // The parts in order of importance; those that do not fit are left out.
    let mut left = height.saturating_sub(keys.len() + said.len());
    let mut take = |lines: Vec<Line>, least: usize| {
        if lines.len() + least > left {
            return Vec::new();
        }
        left -= lines.len();
        lines
    };
    let title = take(vec![title(board, now, width)], 1);
    let servers = take(servers(board, now, width), 4);
    let most = if height < 16 { 2 } else { height / 4 };
    let background = take(background(board, now, width, most), 4);
    let cues = take(cues(board, width), 6);
    let rule = take(vec![rule(width)], 6);
    let body = match &view.pane {
        Pane::Show => body(board, view.top.is_some()),
        Pane::Choose(chooser) => scene_list(board, chooser),
        Pane::Keys => page(&all_keys(), width),
        Pane::Details => page(&details(board, now), width),
        Pane::Cues => page(&cue_page(board), width),
    };
    let (body, mut seen) = window(board, &body, view.top, now, (left, width));
    let mut lines = title;
    lines.extend(servers);
    lines.extend(body);
    let fixed = background.len() + cues.len() + rule.len() + said.len() + keys.len();
    lines.resize(height.saturating_sub(fixed), Line::new(width));
    lines.extend(background);
    lines.extend(rule);
    lines.extend(cues);
    lines.extend(said);
    lines.extend(keys);
    // A window may have no height at all.
    let surplus = lines.len().saturating_sub(height);
    if surplus == 0 {
        seen.notes = notes;
    }
    lines.drain(..surplus);
    (lines, seen)
}

/// The page of all keys.
fn all_keys() -> Vec<Paragraph> {
    let words = |(key, does): &(&str, &str)| (Style::Plain, format!("{key:<18}{does}"));
    keys::ALL.iter().map(words).collect()
}

/// The page of cues.
fn cue_page(board: &RunBoard) -> Vec<Paragraph> {
    let cue = |cue: &StepOutline| {
        let key = match cue.key {
            None => "no key".to_owned(),
            // On this page it starts the cue, even if it has another meaning on the screen.
            Some(key) => match keys::of_cue(key) {
                Some(_) => key.to_string(),
                None => format!("{key} stops here"),
            },
        };
        let tasks: Vec<String> = cue.tasks.iter().map(TaskOutline::name).collect();
        let text = format!("{key:<8}{}: {}", cue.name, tasks.join(", "));
        (Style::Plain, text)
    };
    board.outline.cues.iter().map(cue).collect()
}

/// The page of failures.
fn details(board: &RunBoard, now: Duration) -> Vec<Paragraph> {
    let mut said = message::details(board, now);
    if said.is_empty() {
        said.push((Style::Good, "Nothing went wrong.".to_owned()));
    }
    said
}

/// The lines that remain on the terminal after the run: scenes, tasks that did not complete, and the outcome.
pub(super) fn summary(board: &RunBoard, width: usize) -> Vec<Line> {
    let scenes = board.outline.scenes.iter().enumerate();
    let mut lines: Vec<Line> = scenes
        .map(|(nth, scene)| scene_line(board, nth, scene, board.at, width))
        .collect();
    let bad = board
        .tasks
        .values()
        .filter(|task| task.state != TaskState::Completed);
    lines.extend(bad.map(|task| task_line(task, 0, board.at, width)));
    let message = message(board, board.at);
    lines.extend(message::lines(&message.said, width, usize::MAX).0);
    lines
}

fn rule(width: usize) -> Line {
    Line::new(width).and(Style::Soft, &"─".repeat(width))
}

fn title(board: &RunBoard, now: Duration, width: usize) -> Line {
    let mut words = format!(" {} ", board.script);
    if let Some(scene) = board.scene {
        let of = board.outline.scenes.len();
        words += &format!("  scene {} of {of}", scene + 1);
    }
    let again = |played: &&SceneRun| played.take > 1 && played.to.is_none();
    if let Some(played) = board.played.as_ref().filter(again) {
        words += &format!(", take {}", played.take);
    }
    let time = format!(" {} ", clock(now));
    let room = width.saturating_sub(time.len());
    let mut line = Line::new(width).and(Style::Bar, &clip(&words, room));
    line.put_right(Style::Bar, &time);
    line
}

/// The cues with their keys, and what became of them, wrapped.
fn cues(board: &RunBoard, width: usize) -> Vec<Line> {
    if !board.has_cues() {
        return Vec::new();
    }
    let mut lines = Vec::new();
    let mut line = Line::new(width).and(Style::Soft, " cues");
    for (index, cue) in board.outline.cues.iter().enumerate() {
        let key = cue.key.and_then(keys::of_cue).unwrap_or_default();
        let of_it = board.tasks.values().filter(|task| task.cue == Some(index));
        // First what runs, then what went wrong.
        let worst = of_it.max_by_key(|task| {
            let state = task.state;
            (!state.is_over(), state != TaskState::Completed)
        });
        let (style, sign) = worst.map_or((Style::Soft, "·"), |task| task_sign(task.state));
        let length = columns(&key) + columns(&cue.name) + 7;
        if line.width() + length > width && line.width() > 5 {
            let next = Line::new(width).and(Style::Soft, "     ");
            lines.push(std::mem::replace(&mut line, next));
        }
        line.put(Style::Plain, "  ");
        if !key.is_empty() {
            line.put(Style::Bar, &format!(" {key} "));
        }
        line.put(Style::Plain, &format!(" {} ", cue.name));
        line.put(style, sign);
    }
    lines.push(line);
    lines
}

/// The servers, wrapped.
fn servers(board: &RunBoard, now: Duration, width: usize) -> Vec<Line> {
    let mut lines = Vec::new();
    let mut line = Line::new(width).and(Style::Soft, " servers");
    for (name, server) in &board.servers {
        let (style, says) = server_words(server, now);
        let length = columns(name) + columns(&says) + 3;
        if line.width() + length > width && line.width() > 8 {
            let next = Line::new(width).and(Style::Soft, "        ");
            lines.push(std::mem::replace(&mut line, next));
        }
        line.put(Style::Plain, &format!("  {name} "));
        line.put(style, &says);
    }
    lines.push(line);
    lines
}

fn server_words(server: &ServerView, now: Duration) -> (Style, String) {
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
        Some(ServerState::Absent { .. }) => (Style::Bad, "✗ MISSING".to_owned()),
        Some(ServerState::Restarted) => (Style::Warning, "restarted".to_owned()),
    }
}

fn background(board: &RunBoard, now: Duration, width: usize, most: usize) -> Vec<Line> {
    let tasks: Vec<&TaskRun> = board.in_background().collect();
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

/// The keys, on at most `most` lines. The first lines and the last one, which has the keys that stop, remain.
fn key_lines(board: &RunBoard, view: &View, width: usize, most: usize) -> Vec<Line> {
    let mut keys = match view {
        View {
            pane: Pane::Choose(_),
            ..
        } => keys::choosing(),
        _ => keys::help(board),
    };
    if view.pane == Pane::Cues {
        keys = keys::cueing()
            .into_iter()
            .chain(keys.into_iter().filter(|(key, _)| keys::stops(key)))
            .collect();
    }
    if matches!(view.pane, Pane::Keys | Pane::Details) || view.top.is_some() {
        keys.splice(0..0, keys::looking());
    }
    let mut lines = wrap_keys(&keys, width);
    if lines.len() > most {
        keys.retain(|(key, _)| !matches!(*key, "d" | "?"));
        lines = wrap_keys(&keys, width);
    }
    if lines.len() > most {
        lines.drain(most.saturating_sub(1)..lines.len() - 1);
    }
    lines
}

fn wrap_keys(keys: &[(&str, String)], width: usize) -> Vec<Line> {
    let mut lines = Vec::new();
    let mut line = Line::new(width);
    for (key, words) in keys {
        let length = columns(key) + columns(words) + 5;
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
