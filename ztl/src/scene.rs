//! Tasks played side by side, each shown on one line while it runs.

use std::time::{Duration, Instant};

use ztl_std::{RemoteTask, State, Status, TriggerError};

use crate::signals;
use crate::terminal::{is_live, line, rewrite, up};

/// A task of a scene.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Act {
    pub(crate) handler: &'static str,
    pub(crate) component: &'static str,
    pub(crate) goal: &'static str,
    /// Where it starts and ends, to tell how far it has come.
    pub(crate) way: (f32, f32),
    pub(crate) unit: &'static str,
}

/// A task under way, and what its line says.
struct Shown<'a> {
    act: &'a Act,
    asked: Instant,
    id: Option<ztl_std::RemoteId>,
    accepted: Option<Duration>,
    /// Percent of the way at which it was seen.
    marks: Vec<u8>,
    position: String,
    end: Option<String>,
    completed: bool,
}

/// How often a task is asked about.
const PAUSE: Duration = Duration::from_millis(40);
/// Longest that a task may take before the scene goes on without it.
const LIMIT: Duration = Duration::from_secs(20);

/// Plays the acts of a step at once and waits for all; says whether all completed.
pub(crate) fn play(remote: &mut RemoteTask, start: Instant, step: &[Act]) -> bool {
    let mut shown: Vec<Shown<'_>> = step.iter().map(Shown::new).collect();
    for task in &mut shown {
        task.trigger(remote);
    }
    let live = is_live();
    if live {
        draw(&shown, start);
    }
    while shown.iter().any(|task| task.end.is_none()) {
        std::thread::sleep(PAUSE);
        let stop = signals::stopped();
        for task in shown.iter_mut().filter(|task| task.end.is_none()) {
            if stop {
                task.abort(remote);
            }
            task.ask(remote);
        }
        if live {
            up(shown.len());
            draw(&shown, start);
        }
    }
    if !live {
        for task in &shown {
            line(task.trail(start));
        }
    }
    shown.iter().all(|task| task.completed)
}

fn draw(shown: &[Shown<'_>], start: Instant) {
    for task in shown {
        rewrite(&task.picture(start), "\n");
    }
}

impl<'a> Shown<'a> {
    fn new(act: &'a Act) -> Self {
        Self {
            act,
            asked: Instant::now(),
            id: None,
            accepted: None,
            marks: Vec::new(),
            position: String::new(),
            end: None,
            completed: false,
        }
    }

    fn trigger(&mut self, remote: &mut RemoteTask) {
        let act = self.act;
        self.asked = Instant::now();
        match remote.trigger(act.handler, act.component, act.goal) {
            Ok(task) => {
                self.id = Some(task.id);
                self.accepted = Some(self.asked.elapsed());
            }
            Err(TriggerError::Refused { reason, .. }) => {
                self.end = Some(format!("REJECTED: {reason}"));
            }
            Err(other) => self.end = Some(format!("UNKNOWN: {other}")),
        }
    }

    /// Ctrl-C stops what was started.
    fn abort(&mut self, remote: &mut RemoteTask) {
        if let Some(id) = &self.id
            && let Err(error) = remote.abort(id)
        {
            self.end = Some(format!("UNKNOWN: {error}"));
        }
    }

    fn ask(&mut self, remote: &mut RemoteTask) {
        let Some(id) = &self.id else { return };
        match remote.status(id) {
            Ok(Status { state, text }) if state.is_final() => {
                self.completed = state == State::Completed;
                let unit = if self.completed { self.act.unit } else { "" };
                let seconds = self.asked.elapsed().as_secs_f32();
                let space = if unit.is_empty() { "" } else { " " };
                self.end = Some(format!("{state} {text}{space}{unit}, {seconds:.2} s"));
                self.position = text;
            }
            Ok(Status { text, .. }) => {
                if let Some(percent) = self.percent(&text)
                    && self.marks.last().is_none_or(|last| *last < percent)
                {
                    self.marks.push(percent);
                }
                self.position = text;
            }
            // Unknown is not done: it is asked again, until the limit.
            Err(error) if self.asked.elapsed() > LIMIT => {
                self.end = Some(format!("UNKNOWN: {error}"));
            }
            Err(_) => {}
        }
        if self.asked.elapsed() > LIMIT && self.end.is_none() {
            self.end = Some("UNKNOWN: it takes too long".to_owned());
        }
    }

    /// How much of the way lies behind a position.
    fn percent(&self, position: &str) -> Option<u8> {
        let (from, to) = self.act.way;
        let position: f32 = position.parse().ok()?;
        let part = (position - from) / (to - from);
        Some((part * 100.0).clamp(0.0, 100.0) as u8)
    }

    fn head(&self, start: Instant) -> String {
        let at = self.asked.duration_since(start).as_secs_f32();
        let Act {
            handler,
            component,
            goal,
            ..
        } = self.act;
        let task = format!("{handler}:{component}:{goal}");
        let accepted = self.accepted.map_or_else(String::new, |time| {
            format!("accepted {:>4.1} ms", time.as_secs_f32() * 1000.0)
        });
        format!("{at:>5.2} s  {task:<18} {accepted:<17}")
    }

    /// The line while it is looked at.
    fn picture(&self, start: Instant) -> String {
        let head = self.head(start);
        if let Some(end) = &self.end {
            return format!("{head} {end}");
        }
        let percent = self.marks.last().copied().unwrap_or(0);
        let full = usize::from(percent / 10);
        let bar = format!("{}{}", "█".repeat(full), "░".repeat(10 - full.min(10)));
        let Act { unit, .. } = self.act;
        format!("{head} {bar} {percent:>3} %  {} {unit}", self.position)
    }

    /// The line for a file: some of the places it came by.
    fn trail(&self, start: Instant) -> String {
        let every = (self.marks.len() / 5).max(1);
        let marks: Vec<String> = self
            .marks
            .iter()
            .step_by(every)
            .map(|percent| format!("{percent} %"))
            .collect();
        let end = self.end.as_deref().unwrap_or_default();
        format!("{} {}  {end}", self.head(start), marks.join(" "))
    }
}
