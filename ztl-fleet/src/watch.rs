//! `ztl-fleet watch`: who comes and goes, and which tasks start and end.

use std::collections::BTreeMap;
use std::sync::mpsc::RecvTimeoutError;
use std::time::{Duration, Instant};

use crate::look::{Found, Looked, Select, Task, refusal, tasks};
use crate::{Done, line, signals};

/// Pause between two looks.
const PAUSE: Duration = Duration::from_millis(500);

/// What was last seen of a robot.
#[derive(Debug, Default)]
struct Seen {
    state: String,
    /// By id; `None` before the robot told its tasks.
    tasks: Option<BTreeMap<String, Task>>,
}

impl Select {
    /// Ends with a signal.
    pub(crate) fn watch(self) -> Done {
        let signals = signals::catch()?;
        let (caller, config) = self.open(None)?;
        let signals = signals.awaited();
        let mut seen: BTreeMap<String, Seen> = BTreeMap::new();
        let mut refused = Vec::new();
        let mut noted = None;
        loop {
            let Looked {
                found: all,
                refused: now_refused,
                note: now_noted,
            } = self.look(&caller, &config)?;
            if noted != now_noted
                && let Some(note) = &now_noted
            {
                line(note)?;
            }
            noted = now_noted;
            for (robot, agent) in &now_refused {
                if !refused.contains(&(robot.clone(), agent.clone())) {
                    line(refusal(robot, agent))?;
                }
            }
            refused = now_refused;
            for gone in seen
                .iter_mut()
                .filter(|(name, _)| all.iter().all(|found| found.name != **name))
            {
                tell(gone.0, gone.1, "is not there".to_owned())?;
            }
            for (found, tasks) in all.iter().zip(tasks(&caller, &all, Instant::now())) {
                let known = seen.entry(found.name.clone()).or_default();
                tell(&found.name, known, state(found))?;
                // Without an answer, nothing is known to have changed.
                if let Some(tasks) = tasks {
                    for text in changes(&found.name, known.tasks.as_ref(), &tasks.of) {
                        line(text)?;
                    }
                    known.tasks = Some(tasks.of);
                }
            }
            match signals.recv_timeout(PAUSE) {
                Ok(signal) => return Ok(signals::code(signal)),
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => std::thread::sleep(PAUSE),
            }
        }
    }
}

fn state(found: &Found) -> String {
    match &found.agent {
        None => "is not there".to_owned(),
        Some(_) if found.is_doubted => "is in doubt: several machines answer as it".to_owned(),
        Some((_, None)) => "does not answer".to_owned(),
        Some((_, Some(info))) => match &info.problem {
            None => "is there".to_owned(),
            Some(problem) => format!("is there, not ready: {problem}"),
        },
    }
}

fn tell(name: &str, known: &mut Seen, state: String) -> std::io::Result<()> {
    if known.state != state {
        line(format_args!("{name}  {state}"))?;
        known.state = state;
    }
    Ok(())
}

/// What became of tasks. At the first look, only what runs is told.
fn changes(
    name: &str,
    before: Option<&BTreeMap<String, Task>>,
    after: &BTreeMap<String, Task>,
) -> Vec<String> {
    let mut texts = Vec::new();
    for (id, task) in after {
        let Task {
            scope, goal, text, ..
        } = task;
        let known = before.and_then(|before| before.get(id));
        let place = format!("{id}  /{name}{scope}");
        let is_news = known.is_none() && (before.is_some() || task.runs());
        if is_news {
            texts.push(format!("{place}  started  {goal}"));
        }
        if !task.runs() && (is_news || known.is_some_and(Task::runs)) {
            let state = task.state.map(|state| state.to_string());
            let state = state.unwrap_or_default();
            texts.push(format!("{place}  {state}  {text}"));
        }
    }
    texts
}
