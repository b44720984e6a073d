//! Stops everything that runs on a robot, at once and where it runs.

use std::collections::BTreeSet;
use std::sync::{Arc, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use serde::Deserialize;
use tracing::{error, info, warn};
use ztl_core::client::is_unknown_outcome;
use ztl_core::{Message, State};

use super::Shared;
use super::asked::Asked;
use crate::wire::{Stopped, Verdict};

/// How long this may take, also if the server falls silent: `stop-all` waits 10 s for the answer.
const STOPPING: Duration = Duration::from_secs(8);
const LIMIT: Duration = Duration::from_secs(2);
const PAUSE: Duration = Duration::from_millis(50);
/// Longest time for ABORTs and the question what still runs.
const ROUND: Duration = LIMIT.saturating_mul(2).saturating_add(PAUSE);
/// Most tasks that are remembered of a server that cannot list them.
const MOST: usize = 1000;

/// Tasks that were started through this agent, and may be running: scopes and ids.
#[derive(Debug, Default)]
pub(super) struct Started(Tasks);

/// Scopes and ids.
type Tasks = BTreeSet<(String, String)>;

/// What runs on a robot.
#[derive(Debug, PartialEq, Eq, Default)]
struct Running {
    tasks: Tasks,
    /// Those whose end the server could not learn: they may run.
    doubtful: Tasks,
    /// Why there may be more.
    unknown: Option<String>,
}

#[derive(Deserialize)]
struct List {
    tasks: Vec<Listed>,
    /// How many run in scopes that the server does not let this agent use.
    #[serde(default)]
    elsewhere: u64,
}

#[derive(Deserialize)]
struct Listed {
    id: serde_json::Value,
    scope: String,
    state: u8,
    #[serde(default)]
    text: String,
}

impl Running {
    /// Why more than the running tasks may run.
    fn unknown(self) -> Option<String> {
        let doubtful = self.doubtful.iter().map(name).collect::<Vec<_>>();
        let ends = (!doubtful.is_empty()).then(|| {
            format!(
                "the server could not learn the end of {}, so it may still run",
                doubtful.join(", ")
            )
        });
        let all: Vec<String> = ends.into_iter().chain(self.unknown).collect();
        (!all.is_empty()).then(|| all.join("; "))
    }
}

fn name((scope, id): &(String, String)) -> String {
    format!("{scope} {id}")
}

impl Started {
    /// An answer to an INIT, or to the question for its outcome.
    pub(super) fn note(&mut self, answer: &[u8]) {
        if let Ok(message) = Message::parse(answer)
            && message.scope != "$ztl"
            && !matches!(message.id, "0" | "-1")
            && self.0.len() < MOST
        {
            self.0
                .insert((message.scope.to_owned(), message.id.to_owned()));
        }
    }
}

impl Shared {
    pub(super) fn started(&self) -> MutexGuard<'_, Started> {
        self.started.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(super) fn on_stop(self: &Arc<Self>, asked: &Asked) {
        if !self.may_use(asked, None) {
            let reason = "the robot's 'client-keys' do not allow this";
            return asked.reply(&Verdict::NotStarted(reason.to_owned()));
        }
        if self.refuse_stale(asked) {
            return;
        }
        info!(target: "fleet", "{} stops all tasks.", asked.who());
        let mut stopped = self.stop_all();
        self.look_for_copy();
        stopped.copy = self.has_copy();
        let (ended, running) = (stopped.stopped.len(), stopped.running.join(", "));
        match (&stopped.running[..], &stopped.unknown) {
            ([], None) => info!(target: "fleet", "All tasks have ended: {ended} were stopped."),
            ([], Some(why)) => {
                warn!(target: "fleet", "{ended} tasks were stopped, and more may run: {why}.")
            }
            (_, why) => {
                let why = why.as_deref().unwrap_or("they did not stop in time");
                error!(target: "fleet", "{ended} tasks were stopped, and these still run: {running}: {why}.");
            }
        }
        if let Ok(body) = serde_json::to_vec(&stopped) {
            asked.reply(&Verdict::Answer(body));
        }
    }

    fn stop_all(&self) -> Stopped {
        let end = Instant::now() + STOPPING;
        let (mut all, mut running) = (Tasks::new(), Running::default());
        let mut is_first = true;
        loop {
            let is_silent = match self.running() {
                Ok(now) => {
                    running = now;
                    false
                }
                // A server that falls silent has not stopped what it was running.
                Err(error) => {
                    running.unknown = Some(error);
                    true
                }
            };
            all.extend(running.tasks.iter().cloned());
            // An ABORT may stop the doubtful ones, too.
            let are_told = !is_first || running.doubtful.is_empty();
            let is_over = running.tasks.is_empty() && !is_silent && are_told;
            if is_over || Instant::now() + ROUND > end {
                let has_ended =
                    |task: &&_| !running.tasks.contains(*task) && !running.doubtful.contains(*task);
                return Stopped {
                    boot: self.rules().agent.boot(),
                    stopped: all.iter().filter(has_ended).map(name).collect(),
                    again: is_silent || !running.tasks.is_empty(),
                    running: running.tasks.iter().map(name).collect(),
                    unknown: running.unknown(),
                    copy: false,
                };
            }
            // All at once: no task waits for another one to stop.
            std::thread::scope(|threads| {
                for (scope, id) in running.tasks.iter().chain(&running.doubtful) {
                    let abort = move || {
                        let body = format!("{scope};3;{id};abort command");
                        // Whether it has ended is asked afterwards.
                        let _ = self.client.ask(None, body.as_bytes(), LIMIT);
                    };
                    let thread = std::thread::Builder::new().name("ztl-fleet-stop".to_owned());
                    if thread.spawn_scoped(threads, abort).is_err() {
                        abort();
                    }
                }
            });
            is_first = false;
            std::thread::sleep(PAUSE);
        }
    }

    /// What runs; an error if the server does not answer.
    fn running(&self) -> Result<Running, String> {
        let asked = self.client.ask(None, b"$ztl;2;-1;tasks", LIMIT);
        if let Some(listed) = list(&asked.map_err(|error| error.to_string())?) {
            return Ok(listed);
        }
        // A server of the original cannot list its tasks.
        let mut running = self.started().0.clone();
        let mut is_silent = false;
        running.retain(|(scope, id)| {
            if is_silent {
                return true;
            }
            let body = format!("{scope};2;{id};status update");
            let answer = self.client.ask(None, body.as_bytes(), LIMIT);
            is_silent = answer.is_err();
            let state = answer.ok().and_then(|answer| {
                let message = Message::parse(&answer).ok()?;
                State::from_code(message.state.parse().ok()?)
            });
            runs(state)
        });
        self.started().0.retain(|task| running.contains(task));
        let unknown = "its server cannot list tasks that were not started through the fleet";
        Ok(Running {
            tasks: running,
            unknown: Some(unknown.to_owned()),
            ..Running::default()
        })
    }
}

/// Whether a task in this state runs. One in a state that ZTL does not define may run.
fn runs(state: Option<State>) -> bool {
    state.is_none_or(|state| !state.is_final())
}

/// What runs by a list.
fn list(answer: &[u8]) -> Option<Running> {
    let message = Message::parse(answer).ok()?;
    let list: List = serde_json::from_str(message.payload).ok()?;
    let mut running = Running {
        unknown: (list.elsewhere > 0).then(|| {
            let elsewhere = list.elsewhere;
            format!("{elsewhere} tasks run in scopes that the agent's key may not use")
        }),
        ..Running::default()
    };
    for task in list.tasks {
        let state = State::from_code(task.state.into());
        let is_doubtful = state.is_some_and(|state| is_unknown_outcome(state, &task.text));
        let tasks = match runs(state) {
            true => &mut running.tasks,
            false if is_doubtful => &mut running.doubtful,
            false => continue,
        };
        tasks.insert((task.scope, task.id.to_string()));
    }
    Some(running)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_list_does_not_say_to_have_ended_is_not_taken_for_nothing() {
        let listed = |tasks: &str, more: &str| {
            let list = list(format!("$ztl;5;0;{{\"tasks\":[{tasks}]{more}}}").as_bytes()).unwrap();
            (list.tasks.len(), list.unknown())
        };
        let elsewhere = "2 tasks run in scopes that the agent's key may not use";
        let lost = r#"{"id":7,"scope":"/t","state":3,"text":"unknown: it was restarted"}"#;
        let failed = r#"{"id":8,"scope":"/t","state":3,"text":"it is unknown: why"}"#;
        let runs = r#"{"id":9,"scope":"/t","state":1,"text":"unknown: "}"#;
        let doubtful = "the server could not learn the end of /t 7, so it may still run";
        for (tasks, more, running, unknown) in [
            ("", "", 0, None),
            ("", ",\"elsewhere\":0", 0, None),
            ("", ",\"elsewhere\":2", 0, Some(elsewhere.to_owned())),
            (failed, "", 0, None),
            (lost, "", 0, Some(doubtful.to_owned())),
            (runs, "", 1, None),
            (
                r#"{"id":9,"scope":"/t","state":6,"text":"dancing"}"#,
                "",
                1,
                None,
            ),
            (
                lost,
                ",\"elsewhere\":2",
                0,
                Some(format!("{doubtful}; {elsewhere}")),
            ),
        ] {
            assert_eq!(listed(tasks, more), (running, unknown), "{tasks}");
        }
    }
}
