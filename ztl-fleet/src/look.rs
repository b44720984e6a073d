//! The commands that look at a fleet, and the one that stops it.

use std::collections::BTreeSet;
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Duration;

use serde_json::Value;
use ztl_core::Message;
use ztl_fleet::caller::Caller;
use ztl_fleet::config::EndpointConfig;
use ztl_fleet::join::Stopped;
use ztl_fleet::session;
use ztl_fleet::wire::{RobotInfo, Verdict};

use crate::{Done, line};

/// How long robots may take to answer.
const LIMIT: Duration = Duration::from_secs(2);
/// How long they may take to stop.
const STOPPING: Duration = Duration::from_secs(10);

#[derive(Debug, clap::Args)]
pub(crate) struct Select {
    /// The file of an endpoint (docs/fleet.md)
    #[arg(value_name = "FILE")]
    file: PathBuf,

    /// Only robots of this group
    #[arg(long)]
    group: Option<String>,
}

/// A robot that belongs to the fleet.
struct Found {
    name: String,
    /// Its agent, and what that says, if it answers.
    agent: Option<(String, Option<RobotInfo>)>,
}

impl Select {
    fn find(&self) -> Result<(Caller, Vec<Found>), session::ZenohError> {
        let config = EndpointConfig::load(&self.file)?;
        let session = session::open(&config.links, false)?;
        let mut agents = session::present(&session, "*", LIMIT)?;
        let caller = Caller::new(session, &config);
        for (robot, agent) in agents.extract_if(.., |(robot, agent)| !caller.accepts(robot, agent))
        {
            line(format_args!(
                "{robot}  refused  agent {agent} does not have the key of this name"
            ))?;
        }
        let infos = caller.infos(&agents, LIMIT);
        let there: BTreeSet<&String> = agents.iter().map(|(robot, _)| robot).collect();
        let missing = config.robots.keys().filter(|name| !there.contains(name));
        let missing = missing.map(|name| Found {
            name: name.clone(),
            agent: None,
        });
        let mut all: Vec<Found> = missing.collect();
        for ((name, agent), info) in agents.into_iter().zip(infos) {
            // A robot that does not answer may belong to the group.
            let fits = match (&self.group, &info) {
                (Some(group), Some(info)) => info.groups.contains(group),
                _ => true,
            };
            if fits {
                let agent = Some((agent, info));
                all.push(Found { name, agent });
            }
        }
        all.sort_by(|a, b| a.name.cmp(&b.name));
        Ok((caller, all))
    }

    /// Exit code 0 if all robots are there and ready.
    pub(crate) fn ls(self) -> Done {
        let (_caller, all) = self.find()?;
        let mut good = true;
        for found in &all {
            let name = &found.name;
            let (state, more) = match &found.agent {
                None => ("not there", String::new()),
                Some((agent, None)) => ("does not answer", format!("agent {agent}")),
                Some((_, Some(info))) => match &info.problem {
                    None => ("ready", info.scopes.join(" ")),
                    Some(problem) => ("not ready", problem.clone()),
                },
            };
            good &= state == "ready";
            line(format_args!("{name}  {state}  {more}"))?;
        }
        Ok(code(good))
    }

    /// Exit code 0 if all robots have answered.
    pub(crate) fn ps(self) -> Done {
        let (caller, all) = self.find()?;
        let mut good = true;
        let answers = ask(&caller, &all, "request", b"$ztl;2;-1;tasks", LIMIT);
        for (found, answer) in all.iter().zip(answers) {
            let name = &found.name;
            let tasks = answer.and_then(|body| {
                let message = Message::parse(&body).ok()?;
                let told: Value = serde_json::from_str(message.payload).ok()?;
                Some(told.get("tasks")?.as_array()?.clone())
            });
            let Some(tasks) = tasks else {
                good = false;
                line(format_args!("{name}  unknown: it does not list its tasks"))?;
                continue;
            };
            for task in tasks {
                let state = task.get("state").and_then(Value::as_u64);
                if state.is_some_and(|state| state < 2) {
                    let text = |key| task.get(key).and_then(Value::as_str).unwrap_or_default();
                    let id = task.get("id").map(Value::to_string).unwrap_or_default();
                    let (scope, goal, text) = (text("scope"), text("task"), text("text"));
                    line(format_args!("{id}  /{name}{scope}  {goal}  {text}"))?;
                }
            }
        }
        Ok(code(good))
    }

    /// Exit code 0 if every robot has confirmed that nothing runs.
    pub(crate) fn stop_all(self) -> Done {
        let (caller, all) = self.find()?;
        let mut good = true;
        let answers = ask(&caller, &all, "stop", b"", STOPPING);
        for (found, answer) in all.iter().zip(answers) {
            let name = &found.name;
            let told = answer.and_then(|body| serde_json::from_slice::<Stopped>(&body).ok());
            let said = match (&found.agent, told) {
                (None, _) => "was not there".to_owned(),
                (Some(_), None) => "not reached: it did not confirm".to_owned(),
                (Some(_), Some(told)) => match (&told.running[..], told.unknown) {
                    ([], None) => format!("stopped: {} tasks", told.stopped.len()),
                    ([], Some(why)) => format!("not confirmed: {why}"),
                    (running, _) => format!("still running: {}", running.join(", ")),
                },
            };
            good &= said.starts_with("stopped");
            line(format_args!("{name}  {said}"))?;
        }
        Ok(code(good))
    }
}

/// Asks all robots at once; `None` where there is no answer.
fn ask(
    caller: &Caller,
    all: &[Found],
    what: &str,
    payload: &[u8],
    limit: Duration,
) -> Vec<Option<Vec<u8>>> {
    let there = all.iter().filter_map(|found| {
        let (agent, _) = found.agent.as_ref()?;
        Some((found.name.clone(), agent.clone()))
    });
    let agents: Vec<(String, String)> = there.collect();
    let mut verdicts = caller.ask_all(&agents, what, payload, limit).into_iter();
    let answers = all.iter().map(|found| match &found.agent {
        None => None,
        Some(_) => match verdicts.next().flatten() {
            Some(Verdict::Answer(body)) => Some(body),
            _ => None,
        },
    });
    answers.collect()
}

fn code(good: bool) -> ExitCode {
    if good {
        ExitCode::SUCCESS
    } else {
        ExitCode::FAILURE
    }
}
