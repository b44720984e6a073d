//! The message above the keys: what the operator has to know now.

use std::time::Duration;

use ztl_script::event::{Question, RunCommand, RunOutcome, ServerState, TaskState, WaitReason};

use super::choose::Chooser;
use super::text::{self, Line, Paragraph, Style, clock};
use ztl_script::board::{Note, RunBoard, Stopping, TaskRun};

/// Most lines of one paragraph.
const LONGEST: usize = 40;

/// Most servers that the message names for one reason.
const NAMED: usize = 2;
/// Most notes in the message.
const MOST_NOTES: usize = 3;

/// Wraps paragraphs. If there are more than `most` lines, the last one says how to see the rest. Returns the number of
/// whole paragraphs too.
pub(super) fn lines(said: &[Paragraph], width: usize, most: usize) -> (Vec<Line>, usize) {
    let mut lines = Vec::new();
    // The number of lines up to the end of each paragraph.
    let mut ends = Vec::new();
    for (style, text) in said {
        if lines.len() > most {
            break;
        }
        let pieces = text::wrap(text, width.saturating_sub(1), LONGEST);
        let line = |text: &String| Line::new(width).and(*style, &format!(" {text}"));
        lines.extend(pieces.iter().map(line));
        ends.push(lines.len());
    }
    let mut visible = lines.len();
    if lines.len() > most {
        lines.truncate(most);
        visible = most;
        if let Some(last) = lines.get_mut(1..).and_then(<[Line]>::last_mut) {
            *last = Line::new(width).and(Style::Soft, "   … (d shows the rest)");
            visible -= 1;
        }
    }
    let whole = ends.iter().filter(|end| **end <= visible).count();
    (lines, whole)
}

/// What the message says.
#[derive(Debug, Default)]
pub(super) struct Message {
    pub(super) said: Vec<Paragraph>,
    /// The paragraphs that are notes, with their numbers.
    notes: Vec<(usize, u64)>,
}

impl Message {
    /// The numbers of the notes among the first `paragraphs`.
    pub(super) fn notes(&self, paragraphs: usize) -> Vec<u64> {
        let notes = self.notes.iter().filter(|(at, _)| *at < paragraphs);
        notes.map(|(_, number)| *number).collect()
    }
}

/// The message while the chooser is open.
pub(super) fn choosing(board: &RunBoard, chooser: &Chooser) -> Message {
    let scenes = &board.outline.scenes;
    let words = match chooser.cursor.and_then(|at| Some((at, scenes.get(at)?))) {
        Some((at, scene)) => format!("Jump to: {}  ▶ {} {}", chooser.typed, at + 1, scene.name),
        None => format!(
            "Jump to: {}  ✗ no such scene, there are 1 to {}",
            chooser.typed,
            scenes.len()
        ),
    };
    Message {
        said: vec![(Style::Strong, words)],
        ..Message::default()
    }
}

pub(super) fn message(board: &RunBoard, now: Duration) -> Message {
    let mut said = Vec::new();
    if let Some((outcome, running, text)) = &board.ended {
        said.extend(over(*outcome, running.len()));
        if !text.is_empty() {
            said.push((Style::Bad, text.clone()));
        }
    } else if let Some(stopping) = board.stopping.as_ref().filter(|it| !it.over) {
        said.extend(confirmations(board, stopping));
    } else if let Some((why, tasks)) = &board.waiting {
        let decide = match board.question {
            Some(_) => " Decide.",
            None => "",
        };
        let words = format!("WAITING: {}.{decide}", why_words(board, why, now));
        said.push((Style::Warning, words));
        let tasks = tasks.iter().filter_map(|number| board.tasks.get(number));
        said.extend(tasks.map(reason));
    } else {
        match board.question {
            Some(Question::Scene { scene }) => {
                let scene = board.outline.scenes.get(scene);
                let name = scene.map_or("", |scene| scene.name.as_str());
                said.push((Style::Strong, format!("Next: {name}")));
            }
            Some(Question::End) => said.push((Style::Strong, "The last scene is over.".to_owned())),
            Some(Question::Pause) => said.push((Style::Warning, "PAUSE".to_owned())),
            Some(Question::Step { .. }) => {
                said.push((Style::Warning, "Decide how to go on.".to_owned()));
            }
            None if board.pause => {
                let words = "There will be a pause after this step.".to_owned();
                said.push((Style::Warning, words));
            }
            None => {}
        }
        if board.question.is_some() {
            match &board.stopping {
                Some(stopping) => said.extend(confirmations(board, stopping)),
                None => said.extend(failures(board).map(reason)),
            }
            said.extend(missing(board, now, NAMED));
        }
    }
    let unseen: Vec<&Note> = board.unseen_notes().collect();
    let more = unseen.len().saturating_sub(MOST_NOTES);
    let newest = unseen.get(more..).unwrap_or_default();
    let places = said.len()..;
    let notes = places.zip(newest.iter().map(|note| note.number)).collect();
    let words = newest
        .iter()
        .map(|note| (Style::Warning, note.text.clone()));
    said.extend(words);
    if more > 0 {
        let s = if more == 1 { "" } else { "s" };
        said.push((Style::Warning, format!("and {more} more note{s}")));
    }
    if let Some((key, None, at)) = &board.key
        && board.ended.is_none()
        && now.saturating_sub(*at) < Duration::from_secs(3)
    {
        said.push((Style::Soft, format!("{key} has no effect now")));
    }
    Message { said, notes }
}

/// The page of failures in full.
pub(super) fn details(board: &RunBoard, now: Duration) -> Vec<Paragraph> {
    let mut said = missing(board, now, usize::MAX);
    let wrong = |task: &&TaskRun| task.state.is_failure() || task.state == TaskState::Unknown;
    said.extend(board.tasks.values().filter(wrong).map(reason));
    if let Some(stopping) = &board.stopping {
        said.extend(confirmations(board, stopping));
    }
    said.extend(
        board
            .notes
            .iter()
            .map(|note| (Style::Warning, note.text.clone())),
    );
    said
}

/// The state and text of a task, then its name.
fn reason(task: &TaskRun) -> Paragraph {
    let colon = if task.text.is_empty() { "" } else { ": " };
    let words = format!("  {}{colon}{} ({})", task.state, task.text, task.name);
    (Style::Plain, words)
}

/// Failed tasks of the last take.
fn failures(board: &RunBoard) -> impl Iterator<Item = &TaskRun> {
    let wrong = |task: &&TaskRun| task.current && task.state.is_failure();
    board.tasks.values().filter(wrong)
}

/// Servers of the script that do not answer. Those that are absent for the same reason come together; at most `named` of
/// them are named.
fn missing(board: &RunBoard, now: Duration, named: usize) -> Vec<Paragraph> {
    let mut reasons: Vec<(String, Vec<&str>)> = Vec::new();
    for (name, server) in &board.servers {
        let reason = match &server.state {
            Some(ServerState::Absent { text }) if text.is_empty() => ": not reachable".to_owned(),
            Some(ServerState::Absent { text }) => format!(": {text}"),
            Some(ServerState::Silent) => {
                let since = clock(now.saturating_sub(server.since));
                reasons.push((format!(" is silent for {since}"), vec![name]));
                continue;
            }
            _ => continue,
        };
        match reasons.iter_mut().find(|(known, _)| *known == reason) {
            Some((_, names)) => names.push(name),
            None => reasons.push((reason, vec![name])),
        }
    }
    let words = |(reason, names): (String, Vec<&str>)| match names.as_slice() {
        [name] => format!("MISSING: server '{name}'{reason}"),
        names => {
            let more = names.len().saturating_sub(named);
            let mut names: Vec<String> = names
                .iter()
                .take(named)
                .map(|name| format!("'{name}'"))
                .collect();
            let last = match more {
                0 => names.pop().unwrap_or_default(),
                more => format!("{more} more"),
            };
            let names = names.join(", ");
            format!("MISSING: servers {names} and {last}{reason}")
        }
    };
    let words = reasons.into_iter().map(words);
    words.map(|words| (Style::Bad, words)).collect()
}

/// The results of stopping, unconfirmed ones first.
fn confirmations(board: &RunBoard, stopping: &Stopping) -> Vec<Paragraph> {
    let head = match stopping.over {
        true => stopped(stopping),
        false => being_stopped(stopping),
    };
    let mut answers: Vec<_> = stopping.answers.iter().collect();
    answers.sort_by_key(|(_, answer)| match answer {
        Some((false, _)) => 0,
        None => 1,
        Some((true, _)) => 2,
    });
    let answer = |(number, answer): (&_, &Option<(bool, String)>)| {
        let task = board.tasks.get(number);
        let name = task.map_or("a task", |task| task.name.as_str());
        match answer {
            None => (Style::Warning, format!("  ? {name}: no answer yet")),
            Some((true, text)) => (Style::Good, format!("  ✓ {name}: {text}")),
            Some((false, text)) => (Style::Bad, format!("  ✗ {name}: {text}")),
        }
    };
    let answers = answers.into_iter().map(answer);
    std::iter::once(head).chain(answers).collect()
}

/// What is known while the run waits for answers.
fn being_stopped(stopping: &Stopping) -> Paragraph {
    let all = stopping.answers.len();
    let (confirmed, unconfirmed) = (stops(stopping, true), stops(stopping, false));
    let asked = listed(stopping, None);
    let what = match stopping.command {
        RunCommand::StopScene => "STOPPING THE SCENE",
        _ => "STOPPING EVERYTHING",
    };
    let mut words = Vec::new();
    if all > 0 {
        words.push(format!("{confirmed} of {all} confirmed"));
    }
    if unconfirmed > 0 {
        words.push(format!("{unconfirmed} may still move"));
    }
    if !asked.is_empty() {
        words.push(format!("asking {} which tasks run", names(&asked)));
    }
    let style = match unconfirmed {
        0 => Style::Warning,
        _ => Style::Bad,
    };
    let colon = if words.is_empty() { "" } else { ": " };
    (style, format!("{what}{colon}{}", words.join(", ")))
}

/// What is known when the run waits for no more answers.
fn stopped(stopping: &Stopping) -> Paragraph {
    let (all, confirmed) = (stopping.answers.len(), stops(stopping, true));
    if confirmed < all {
        let words = format!("STOPPED ONLY {confirmed} OF {all}: the others may still move");
        return (Style::Bad, words);
    }
    let mut unlisted = listed(stopping, Some(false));
    unlisted.extend(listed(stopping, None));
    let what = match stopping.command {
        RunCommand::StopScene => "STOPPED THE SCENE",
        _ => "STOPPED EVERYTHING",
    };
    let words = match (all, unlisted.is_empty()) {
        (0, true) => format!("{what}: no task was running"),
        (_, true) => format!("{what}: {confirmed} of {all} confirmed"),
        (_, false) => {
            let known = match all {
                0 => "FOUND NOTHING TO STOP:".to_owned(),
                _ => format!("STOPPED WHAT IS KNOWN: {confirmed} of {all} confirmed;"),
            };
            let unlisted = names(&unlisted);
            format!("{known} what others started on {unlisted} may still run")
        }
    };
    (Style::Warning, words)
}

/// How many stops were answered so.
fn stops(stopping: &Stopping, confirmed: bool) -> usize {
    let answers = stopping.answers.values().flatten();
    answers.filter(|(answer, _)| *answer == confirmed).count()
}

/// The servers that answered so when they were asked for their tasks.
fn listed(stopping: &Stopping, complete: Option<bool>) -> Vec<&str> {
    let lists = stopping.lists.iter();
    let lists = lists.filter(|(_, answer)| **answer == complete);
    lists.map(|(remote, _)| remote.as_str()).collect()
}

fn names(servers: &[&str]) -> String {
    match servers {
        [server] => format!("'{server}'"),
        servers => format!("{} servers", servers.len()),
    }
}

/// The outcome of the run, and how many tasks may still run.
fn over(outcome: RunOutcome, running: usize) -> Vec<Paragraph> {
    let (tasks, they) = match running {
        1 => ("1 task".to_owned(), "it"),
        _ => (format!("{running} tasks"), "they"),
    };
    let (style, words) = match outcome {
        RunOutcome::NotConfirmed => {
            let words =
                format!("Over: stopping was not confirmed for {tasks}; {they} may still run");
            return vec![(Style::Bad, words)];
        }
        RunOutcome::Completed => (Style::Good, "Over: everything completed."),
        RunOutcome::Failures => (Style::Bad, "Over: not everything completed."),
        RunOutcome::Stopped => (Style::Warning, "Over: everything was stopped."),
        RunOutcome::Left => (Style::Warning, "Left."),
        RunOutcome::Error => (Style::Bad, "Ended by an error."),
    };
    let mut said = vec![(style, words.to_owned())];
    if running > 0 {
        said.push((Style::Warning, format!("{tasks} may still run")));
    }
    said
}

fn why_words(board: &RunBoard, why: &WaitReason, now: Duration) -> String {
    match why {
        WaitReason::ServerSilent { remote } => {
            let server = board.servers.iter().find(|(name, _)| name == remote);
            let since = server.map(|(_, server)| clock(now.saturating_sub(server.since)));
            let since = since
                .map(|since| format!(" for {since}"))
                .unwrap_or_default();
            format!("server '{remote}' is silent{since}; what its tasks do is unknown")
        }
        WaitReason::ServerRestarted { remote } => {
            format!("server '{remote}' was restarted; the outcome of its tasks is unknown")
        }
        WaitReason::TaskUnknown => "a server does not know its task any more".to_owned(),
        WaitReason::NotTold { remote } => {
            format!("server '{remote}' answers, but does not report its tasks")
        }
        WaitReason::AnswerUnclear { remote } => {
            format!("server '{remote}' gives no usable answer; what its task does is unknown")
        }
        WaitReason::StartUnknown => "it is unknown whether a task was started".to_owned(),
        WaitReason::Failed => "something failed".to_owned(),
        WaitReason::TooLong => "a task takes longer than its limit".to_owned(),
    }
}
