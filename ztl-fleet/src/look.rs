//! The commands that look at a fleet, and the one that stops it.

mod stop;

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::{Duration, Instant, UNIX_EPOCH};

use serde_json::Value;
use ztl_core::Message;
use ztl_core::client::is_unknown_outcome;
use ztl_fleet::caller::Caller;
use ztl_fleet::config::EndpointConfig;
use ztl_fleet::session;
use ztl_fleet::wire::{AgentQuery, RobotInfo, Verdict};
use ztl_std::time::rfc3339;
use ztl_std::{Description, RemoteId, State};

use crate::{Done, line};

/// How long it may take to reach a router.
const CONNECTING: Duration = Duration::from_secs(5);
/// How long robots may take to answer.
const LIMIT: Duration = Duration::from_secs(2);
/// How long a list asks for robots that do not answer.
const LISTING: Duration = Duration::from_secs(5);
/// Pause before they are asked again.
const AGAIN: Duration = Duration::from_millis(200);
/// Pause between two ABORTs.
const PAUSE: Duration = Duration::from_millis(50);
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

/// Names with the agents that claim them.
pub(crate) type Agents = Vec<(String, String)>;

pub(crate) fn refusal(robot: &str, agent: &str) -> String {
    format!("{robot}  refused  agent {agent} does not have the key of this name")
}

/// Prints what is amiss.
fn tell(text: String) {
    // Who does not read this may need the answer all the same.
    let _ = line(text);
}

/// Puts a question to agents. Who does not answer is asked again: a router may not know the way yet, or the machine is
/// busy.
fn until_told<T>(
    agents: &Agents,
    end: Instant,
    question: impl Fn(&Agents, Duration) -> Vec<Option<T>>,
) -> Vec<Option<T>> {
    let mut answers = question(agents, LIMIT);
    loop {
        let open = answers.iter().enumerate().filter(|(_, it)| it.is_none());
        let open: Vec<usize> = open.map(|(index, _)| index).collect();
        let left = end.saturating_duration_since(Instant::now());
        if open.is_empty() || left <= AGAIN {
            return answers;
        }
        std::thread::sleep(AGAIN);
        let again = open.iter().filter_map(|index| agents.get(*index).cloned());
        let again: Agents = again.collect();
        for (index, answer) in open.into_iter().zip(question(&again, LIMIT.min(left))) {
            if let Some(slot) = answers.get_mut(index) {
                *slot = answer;
            }
        }
    }
}

/// What agents say, for a list.
fn infos(caller: &Caller, agents: &Agents) -> Vec<Option<RobotInfo>> {
    let end = Instant::now() + LISTING;
    until_told(agents, end, |agents, limit| caller.infos(agents, limit))
}

/// A robot that belongs to the fleet.
#[derive(Debug)]
pub(crate) struct Found {
    pub(crate) name: String,
    /// Its agent, and what that says, if it answers.
    pub(crate) agent: Option<(String, Option<RobotInfo>)>,
    /// Whether several machines answered as this agent.
    pub(crate) is_doubted: bool,
}

/// What is seen of a fleet.
pub(crate) struct Looked {
    /// The robots that are there or should be.
    pub(crate) found: Vec<Found>,
    /// Agents that do not have the key of their name.
    pub(crate) refused: Agents,
    /// That no robot is known to belong to the group, and which groups there are.
    pub(crate) note: Option<String>,
}

fn no_group(group: &str, infos: &[Option<RobotInfo>]) -> Option<String> {
    let known = infos.iter().flatten().flat_map(|info| &info.groups);
    let known: BTreeSet<&str> = known.map(String::as_str).collect();
    if known.contains(group) {
        return None;
    }
    let known: Vec<&str> = known.into_iter().collect();
    let others = match known.is_empty() {
        true => "no robot tells a group".to_owned(),
        false => format!("there are: {}", known.join(", ")),
    };
    Some(format!(
        "no robot is known to belong to group '{group}'; {others}"
    ))
}

impl Select {
    /// Connects to the fleet, if a router is reached within the limit.
    pub(crate) fn open(
        &self,
        limit: Option<Duration>,
    ) -> Result<(Caller, EndpointConfig), session::ZenohError> {
        let config = EndpointConfig::load(&self.file)?;
        let session = match limit {
            Some(limit) => session::open_within(&config.links, limit)?,
            None => session::open(&config.links)?,
        };
        Ok((Caller::new(session, &config), config))
    }

    fn find(&self) -> Result<(Caller, Vec<Found>), session::ZenohError> {
        let infos = |caller: &Caller, agents: &Agents| caller.infos(agents, LIMIT);
        let (caller, all, _) = self.find_with(tell, infos)?;
        Ok((caller, all))
    }

    /// The same, with what the file says; `tell` is told what is amiss, and `infos` asks what the agents say.
    fn find_with(
        &self,
        mut tell: impl FnMut(String),
        infos: impl FnOnce(&Caller, &Agents) -> Vec<Option<RobotInfo>>,
    ) -> Result<(Caller, Vec<Found>, EndpointConfig), session::ZenohError> {
        let (caller, config) = self.open(Some(CONNECTING))?;
        let mut looked = self.look_with(&caller, &config, infos)?;
        for found in &mut looked.found {
            if let Some((agent, _)) = &found.agent {
                // A command does not look twice.
                found.is_doubted |= caller.hears_several(&found.name, agent);
            }
        }
        for (robot, agent) in looked.refused {
            tell(refusal(&robot, &agent));
        }
        if let Some(note) = looked.note {
            if looked.found.is_empty() {
                return Err(note.into());
            }
            // Some of those that do not answer may belong to it.
            tell(note);
        }
        Ok((caller, looked.found, config))
    }

    /// Looks who is there.
    pub(crate) fn look(
        &self,
        caller: &Caller,
        config: &EndpointConfig,
    ) -> Result<Looked, session::ZenohError> {
        self.look_with(caller, config, |caller, agents| caller.infos(agents, LIMIT))
    }

    fn look_with(
        &self,
        caller: &Caller,
        config: &EndpointConfig,
        infos: impl FnOnce(&Caller, &Agents) -> Vec<Option<RobotInfo>>,
    ) -> Result<Looked, session::ZenohError> {
        let present = session::present(caller.session(), "*", LIMIT)?;
        let (agents, refused): (Agents, Agents) = present
            .into_iter()
            .partition(|(robot, agent)| caller.accepts(robot, agent));
        let infos = infos(caller, &agents);
        let note = self
            .group
            .as_ref()
            .and_then(|group| no_group(group, &infos));
        let there: BTreeSet<&String> = agents.iter().map(|(robot, _)| robot).collect();
        let missing = config.robots.keys().filter(|name| !there.contains(name));
        let missing = missing.map(|name| Found {
            name: name.clone(),
            agent: None,
            is_doubted: false,
        });
        let mut all: Vec<Found> = missing.collect();
        for ((name, agent), info) in agents.into_iter().zip(infos) {
            // A robot that does not answer may belong to the group.
            let fits = match (&self.group, &info) {
                (Some(group), Some(info)) => info.groups.contains(group),
                _ => true,
            };
            if fits {
                let is_doubted = caller.is_in_doubt(&name, &agent);
                let agent = Some((agent, info));
                all.push(Found {
                    name,
                    agent,
                    is_doubted,
                });
            }
        }
        all.sort_by(|a, b| a.name.cmp(&b.name));
        Ok(Looked {
            found: all,
            refused,
            note,
        })
    }

    /// Exit code 0 if all robots are there and ready.
    pub(crate) fn ls(self) -> Done {
        let (caller, all, _) = self.find_with(tell, infos)?;
        let mut good = true;
        for found in &all {
            let name = &found.name;
            let (is_ready, state, more) = match &found.agent {
                None => (false, "not there", String::new()),
                Some((agent, _)) if found.is_doubted => {
                    let more = format!("several machines answer as agent {agent}");
                    (false, "in doubt", more)
                }
                Some((_, None)) => (false, "does not answer", caller.why_nobody().to_owned()),
                Some((_, Some(info))) => match &info.problem {
                    None => {
                        let scopes = info.scopes.join(" ");
                        let streams = if info.streams { "  streams" } else { "" };
                        let since = wall(info.since);
                        let groups = match info.groups.is_empty() {
                            true => String::new(),
                            false => format!("  in {}", info.groups.join(", ")),
                        };
                        (
                            true,
                            "ready",
                            format!("{scopes}  since {since}{groups}{streams}"),
                        )
                    }
                    Some(problem) => (false, "not ready", problem.clone()),
                },
            };
            good &= is_ready;
            line(format_args!("{name}  {state}  {more}"))?;
        }
        Ok(code(good))
    }

    /// Exit code 0 if all robots have told all their tasks.
    pub(crate) fn ps(self) -> Done {
        let end = Instant::now() + LISTING;
        let (caller, all, _) = self.find_with(tell, infos)?;
        let mut good = true;
        for (found, tasks) in all.iter().zip(tasks(&caller, &all, end)) {
            let name = &found.name;
            let Some(tasks) = tasks.filter(|_| !found.is_doubted) else {
                good = false;
                let why = match &found.agent {
                    None => "it is not there",
                    Some(_) if found.is_doubted => "several machines answer as this robot",
                    Some(_) => "it does not answer, or does not list its tasks",
                };
                line(format_args!("{name}  unknown: {why}"))?;
                continue;
            };
            for (id, task) in tasks.of {
                if task.may_run() {
                    let Task {
                        scope, goal, text, ..
                    } = task;
                    line(format_args!("{id}  /{name}{scope}  {goal}  {text}"))?;
                }
            }
            if tasks.unread > 0 {
                good = false;
                line(format_args!(
                    "{name}  unknown: {} more tasks run",
                    tasks.unread
                ))?;
            }
        }
        Ok(code(good))
    }

    /// Exit code 0 if the task has ended.
    pub(crate) fn abort(self, scope: &str, id: &RemoteId) -> Done {
        let scope = scope.strip_prefix('/').unwrap_or(scope);
        let Some((name, own)) = scope.find('/').and_then(|end| scope.split_at_checked(end)) else {
            return Err(format!("'{scope}' is not the scope of a robot, as arm-1/lab").into());
        };
        let (caller, all) = self.find()?;
        let mut there = all.into_iter().filter(|found| found.agent.is_some());
        let mut others = Vec::new();
        let found = there.find(|found| {
            others.push(found.name.clone());
            found.name == name
        });
        let Some(found) = found else {
            let others = match others.is_empty() {
                true => "and no other is".to_owned(),
                false => format!("there are: {}", others.join(", ")),
            };
            return Err(format!("robot '{name}' is not there; {others}").into());
        };
        let doubt = format!(
            "several machines answer as robot '{name}'; stop all tasks with stop-all, and give each robot its own name"
        );
        if found.is_doubted {
            return Err(doubt.into());
        }
        if let Some((_, Some(info))) = &found.agent
            && !info.scopes.is_empty()
            && !info.scopes.iter().any(|scope| scope == own)
        {
            let scopes = info.scopes.join(", ");
            return Err(format!("robot '{name}' has no scope '{own}'; it has: {scopes}").into());
        }
        let all = [found];
        let end = Instant::now() + STOPPING;
        let (mut is_first, mut has_failed) = (true, false);
        loop {
            let body = match has_failed {
                false => format!("{own};3;{id};abort command"),
                // Only a STATUS tells whether its end is known.
                true => format!("{own};2;{id};status update"),
            };
            let answer = ask(&all, |agents| {
                caller.ask_all(agents, AgentQuery::Request, body.as_bytes(), LIMIT)
            });
            let answer = answer.into_iter().flatten().next();
            if let [found] = &all[..]
                && let Some((agent, _)) = &found.agent
                && caller.is_in_doubt(name, agent)
            {
                return Err(doubt.into());
            }
            let told = answer.as_deref().and_then(|body| Message::parse(body).ok());
            let about = told.filter(|told| told.scope == own && told.id == id.to_string());
            let state = about
                .as_ref()
                .and_then(|told| told.state.parse::<i64>().ok());
            let text = about.as_ref().map_or("no answer", |told| told.payload);
            match state.and_then(State::from_code) {
                Some(State::Rejected) => {
                    line(format_args!("{id}  /{scope}  unknown: {text}"))?;
                    return Ok(code(false));
                }
                Some(State::Failed) if !has_failed => has_failed = true,
                Some(state) if is_unknown_outcome(state, text) => {
                    line(format_args!("{id}  /{scope}  may still run: {text}"))?;
                    return Ok(code(false));
                }
                Some(state) if state.is_final() => {
                    let said = match (state, is_first) {
                        (State::Aborted, _) => "it has stopped",
                        (_, true) => "it has ended by itself, before it was aborted",
                        (_, false) => "it has ended by itself",
                    };
                    line(format_args!("{id}  /{scope}  {state}: {said}"))?;
                    return Ok(code(true));
                }
                _ if Instant::now() >= end => {
                    line(format_args!("{id}  /{scope}  may still run: {text}"))?;
                    return Ok(code(false));
                }
                _ => {
                    is_first = false;
                    std::thread::sleep(PAUSE);
                }
            }
        }
    }
}

/// A task as its robot lists it.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub(crate) struct Task {
    pub(crate) scope: String,
    pub(crate) goal: String,
    pub(crate) text: String,
    pub(crate) state: Option<State>,
}

impl Task {
    pub(crate) fn runs(&self) -> bool {
        self.state.is_none_or(|state| !state.is_final())
    }

    /// Whether it runs, or its server could not learn its end.
    fn may_run(&self) -> bool {
        let is_unknown = |state| is_unknown_outcome(state, &self.text);
        self.runs() || self.state.is_some_and(is_unknown)
    }
}

/// The tasks of a robot.
#[derive(Debug, Default)]
pub(crate) struct Tasks {
    /// By id.
    pub(crate) of: BTreeMap<String, Task>,
    /// How many more run.
    unread: usize,
}

/// The tasks of each robot by its list and by its probe; `None` where it has not told them, also when asked again until
/// `end`.
pub(crate) fn tasks(caller: &Caller, all: &[Found], end: Instant) -> Vec<Option<Tasks>> {
    let told = |question: &str| {
        let question = format!("$ztl;2;-1;{question}");
        ask(all, |agents| {
            until_told(agents, end, |agents, limit| {
                caller.ask_all(agents, AgentQuery::Request, question.as_bytes(), limit)
            })
        })
    };
    let pairs = told("tasks").into_iter().zip(told("probe"));
    pairs
        .map(|(list, probe)| {
            let mut all = listed(&list?)?;
            let probe = probe?;
            let probe = Message::parse(&probe).ok()?;
            let probe = Description::read(probe.payload.to_owned()).ok()?;
            all.unread = all.unread.saturating_add(probe.unread);
            for (id, scope) in probe.running.into_iter().flatten() {
                if !scope.starts_with('/') {
                    all.unread = all.unread.saturating_add(1);
                    continue;
                }
                let task = Task {
                    scope,
                    ..Task::default()
                };
                all.of.entry(id.to_string()).or_insert(task);
            }
            Some(all)
        })
        .collect()
}

fn listed(body: &[u8]) -> Option<Tasks> {
    let message = Message::parse(body).ok()?;
    let told: Value = serde_json::from_str(message.payload).ok()?;
    // They run in scopes that the agent's key may not use.
    let elsewhere = told.get("elsewhere").and_then(Value::as_u64);
    let mut all = Tasks {
        unread: usize::try_from(elsewhere.unwrap_or_default()).unwrap_or(usize::MAX),
        ..Tasks::default()
    };
    for task in told.get("tasks")?.as_array()? {
        let text = |key| task.get(key).and_then(Value::as_str).unwrap_or_default();
        let state = task.get("state").and_then(Value::as_i64);
        let id = task.get("id").map(Value::to_string).unwrap_or_default();
        let task = Task {
            scope: text("scope").to_owned(),
            goal: text("task").to_owned(),
            text: text("text").to_owned(),
            state: state.and_then(State::from_code),
        };
        // Behind the robot's name, another text could name another robot.
        match task.scope.starts_with('/') {
            true => drop(all.of.insert(id, task)),
            false => all.unread = all.unread.saturating_add(task.may_run().into()),
        }
    }
    Some(all)
}

/// Asks all robots at once; `None` where there is no answer.
fn ask(
    all: &[Found],
    question: impl FnOnce(&Agents) -> Vec<Option<Verdict>>,
) -> Vec<Option<Vec<u8>>> {
    let there = all.iter().filter_map(|found| {
        let (agent, _) = found.agent.as_ref()?;
        Some((found.name.clone(), agent.clone()))
    });
    let agents: Agents = there.collect();
    let mut verdicts = question(&agents).into_iter();
    let answers = all.iter().map(|found| match &found.agent {
        None => None,
        Some(_) => match verdicts.next().flatten() {
            Some(Verdict::Answer(body)) => Some(body),
            _ => None,
        },
    });
    answers.collect()
}

/// Seconds since 1970 in RFC 3339.
fn wall(seconds: u64) -> String {
    let at = UNIX_EPOCH.checked_add(Duration::from_secs(seconds));
    let text = at.and_then(|at| rfc3339::serialize(&at, serde_json::value::Serializer).ok());
    let text = text.as_ref().and_then(Value::as_str);
    text.unwrap_or("an unknown time").to_owned()
}

fn code(good: bool) -> ExitCode {
    if good {
        ExitCode::SUCCESS
    } else {
        ExitCode::FAILURE
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_robot_lists_no_task_of_another_one() {
        let list = br#"$ztl;5;0;{"tasks": [
            {"id": 4, "scope": "/lab", "state": 1}, {"id": 5, "scope": "-1/lab", "state": 1},
            {"id": 6, "scope": "-1/lab", "state": 4}, {"id": 7, "state": 1}], "elsewhere": 2}"#;
        let tasks = listed(list).unwrap();
        assert_eq!(tasks.of.into_keys().collect::<Vec<_>>(), ["4"]);
        assert_eq!(tasks.unread, 4);
    }
}
