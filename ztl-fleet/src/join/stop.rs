//! Stops everything that runs on a robot, at once and where it runs.

use std::collections::BTreeSet;
use std::sync::{Arc, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use serde::Deserialize;
use tracing::{error, info, warn};
use ztl_core::Message;

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
pub(super) struct Started(BTreeSet<(String, String)>);

/// Tasks that run, by scopes and ids, and why there may be more.
type Running = (BTreeSet<(String, String)>, Option<String>);

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
        let (mut all, mut running) = (BTreeSet::new(), BTreeSet::new());
        loop {
            let (unknown, is_silent) = match self.running() {
                Ok((now, unknown)) => {
                    running = now;
                    (unknown, false)
                }
                // A server that falls silent has not stopped what it was running.
                Err(error) => (Some(error), true),
            };
            all.extend(running.iter().cloned());
            if running.is_empty() && !is_silent || Instant::now() + ROUND > end {
                let name = |(scope, id): &(String, String)| format!("{scope} {id}");
                let stopped = all.difference(&running);
                return Stopped {
                    boot: self.rules().agent.boot(),
                    stopped: stopped.map(name).collect(),
                    again: is_silent || !running.is_empty(),
                    running: running.iter().map(name).collect(),
                    unknown,
                    copy: false,
                };
            }
            // All at once: no task waits for another one to stop.
            std::thread::scope(|threads| {
                for (scope, id) in &running {
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
            std::thread::sleep(PAUSE);
        }
    }

    /// The tasks that run, and why there may be more; an error if the server does not answer.
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
                message.state.parse::<u8>().ok()
            });
            state.is_none_or(|state| state <= 1)
        });
        self.started().0.retain(|task| running.contains(task));
        let unknown = "its server cannot list tasks that were not started through the fleet";
        Ok((running, Some(unknown.to_owned())))
    }
}

/// The running tasks of a list, and why there may be more.
fn list(answer: &[u8]) -> Option<Running> {
    let message = Message::parse(answer).ok()?;
    let list: List = serde_json::from_str(message.payload).ok()?;
    let unknown = (list.elsewhere > 0).then(|| {
        let elsewhere = list.elsewhere;
        format!("{elsewhere} tasks run in scopes that the agent's key may not use")
    });
    let running = list.tasks.into_iter().filter(|task| task.state < 2);
    let task = |task: Listed| (task.scope, task.id.to_string());
    Some((running.map(task).collect(), unknown))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tasks_that_the_agent_may_not_stop_are_not_taken_for_none() {
        let listed = |more: &str| list(format!("$ztl;5;0;{{\"tasks\":[]{more}}}").as_bytes());
        assert_eq!(listed(""), Some((BTreeSet::new(), None)));
        assert_eq!(listed(",\"elsewhere\":0"), listed(""));
        let (running, unknown) = listed(",\"elsewhere\":2").unwrap();
        let says = "2 tasks run in scopes that the agent's key may not use";
        assert_eq!((running.len(), unknown.as_deref()), (0, Some(says)));
    }
}
