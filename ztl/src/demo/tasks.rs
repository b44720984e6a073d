//! Runs the tasks of a step in parallel and shows each on one line.

use std::time::{Duration, Instant};

use ztl_std::{RemoteTask, State, Status, TriggerError};

use crate::signals;
use crate::terminal::{is_live, line, rewrite, up};

/// A task of the demo.
#[derive(Debug, Clone, Copy)]
pub(crate) struct DemoTask {
    pub(crate) handler: &'static str,
    pub(crate) component: &'static str,
    pub(crate) goal: &'static str,
    /// Positions at its start and end, to compute its progress.
    pub(crate) way: (f32, f32),
    pub(crate) unit: &'static str,
}

/// The line of a task.
struct TaskLine<'a> {
    task: &'a DemoTask,
    asked: Instant,
    id: Option<ztl_std::RemoteId>,
    accepted: Option<Duration>,
    /// Progress in percent, at each answer.
    marks: Vec<u8>,
    position: String,
    end: Option<String>,
    completed: bool,
}

/// Time between two STATUS requests.
const PAUSE: Duration = Duration::from_millis(40);
/// Time limit for a task; the demo continues without it.
const LIMIT: Duration = Duration::from_secs(20);

/// Starts all tasks of a step, waits for all, and returns whether all completed.
pub(crate) fn play(remote: &mut RemoteTask, start: Instant, step: &[DemoTask]) -> bool {
    let mut shown: Vec<TaskLine<'_>> = step.iter().map(TaskLine::new).collect();
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

fn draw(shown: &[TaskLine<'_>], start: Instant) {
    for task in shown {
        rewrite(&task.picture(start), "\n");
    }
}

impl<'a> TaskLine<'a> {
    fn new(task: &'a DemoTask) -> Self {
        Self {
            task,
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
        let task = self.task;
        self.asked = Instant::now();
        match remote.trigger(task.handler, task.component, task.goal) {
            Ok(task) => {
                self.id = Some(task.id);
                self.accepted = Some(self.asked.elapsed());
            }
            Err(TriggerError::Rejected { reason, .. }) => {
                self.end = Some(format!("REJECTED: {reason}"));
            }
            Err(other) => self.end = Some(format!("UNKNOWN: {other}")),
        }
    }

    /// Aborts the task after Ctrl-C.
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
                let unit = if self.completed { self.task.unit } else { "" };
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
            // Unknown does not mean final: asks again until the limit.
            Err(error) if self.asked.elapsed() > LIMIT => {
                self.end = Some(format!("UNKNOWN: {error}"));
            }
            Err(_) => {}
        }
        if self.asked.elapsed() > LIMIT && self.end.is_none() {
            self.end = Some("UNKNOWN: it takes too long".to_owned());
        }
    }

    /// The progress at a position.
    fn percent(&self, position: &str) -> Option<u8> {
        let (from, to) = self.task.way;
        let position: f32 = position.parse().ok()?;
        let part = (position - from) / (to - from);
        Some((part * 100.0).clamp(0.0, 100.0) as u8)
    }

    fn head(&self, start: Instant) -> String {
        let at = self.asked.duration_since(start).as_secs_f32();
        let DemoTask {
            handler,
            component,
            goal,
            ..
        } = self.task;
        let task = format!("{handler}:{component}:{goal}");
        let accepted = self.accepted.map_or_else(String::new, |time| {
            format!("accepted {:>4.1} ms", time.as_secs_f32() * 1000.0)
        });
        format!("{at:>5.2} s  {task:<18} {accepted:<17}")
    }

    /// The line on a terminal.
    fn picture(&self, start: Instant) -> String {
        let head = self.head(start);
        if let Some(end) = &self.end {
            return format!("{head} {end}");
        }
        let percent = self.marks.last().copied().unwrap_or(0);
        let full = usize::from(percent / 10);
        let bar = format!("{}{}", "█".repeat(full), "░".repeat(10 - full.min(10)));
        let DemoTask { unit, .. } = self.task;
        format!("{head} {bar} {percent:>3} %  {} {unit}", self.position)
    }

    /// The line for a file, with some of the progress.
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
