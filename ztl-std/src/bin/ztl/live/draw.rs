//! The screen, as a function of what is known: no terminal, no clock.

use std::time::Duration;

use ztl_std::script::event::{Outcome, Question, ServerState, TaskState, Why};

use super::board::{Board, Played, Server, Task};
use super::keys::{self, Chooser};
use super::rows::{body, clock, scene_line, scene_list, task_line, window};
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
