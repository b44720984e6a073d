//! Whether the servers of a script are there and would take its tasks: `ztl check --live`.

use std::collections::BTreeMap;
use std::panic::resume_unwind;

use ztl_core::TaskId;

use super::finding::Finding;
use super::model::{Handler, Script, Task};
use ztl_std::encoded;
use ztl_std::remotes::Remote;
use ztl_std::{Offers, RemoteTask, Remotes, RequestError};
use ztl_yaml::closest;

/// Servers that are asked at the same time.
const AT_ONCE: usize = 64;

/// What the servers of a script say.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Said {
    /// What is wrong, by the servers' words.
    pub findings: Vec<Finding>,
    /// How it is with each server, in lines for people.
    pub servers: Vec<String>,
}

impl Script {
    /// Asks each server that the script uses whether it is there, and if it is one of ours, whether it has
    /// the handlers and components and would take the goals. Nothing is started. Servers are asked at the
    /// same time; one that does not answer costs 2 s.
    #[must_use]
    pub fn ask_servers(&self, remotes: &Remotes) -> Said {
        let answers = ask_at_once(&self.remotes(), remotes, |name, remote| {
            let (line, met) = meet(name, remote);
            let mut said = Said {
                findings: Vec::new(),
                servers: vec![line],
            };
            match met {
                Err(message) => self.at_first_use(name, &message, &mut said),
                Ok(None) => {}
                Ok(Some(mut client)) => {
                    self.ask_server(name, &mut client, &remote.scope, &mut said);
                }
            }
            said
        });
        let mut said = Said {
            findings: Vec::new(),
            servers: Vec::new(),
        };
        for answer in answers {
            said.findings.extend(answer.findings);
            said.servers.extend(answer.servers);
        }
        said
    }

    fn at_first_use(&self, name: &str, message: &str, said: &mut Said) {
        let handlers = self
            .scenes
            .iter()
            .flat_map(|scene| &scene.steps)
            .flat_map(|step| &step.handlers);
        if let Some(handler) = handlers.into_iter().find(|handler| handler.remote == name) {
            said.findings.push(Finding::mistake(
                self.document().mistake(handler.span, message),
            ));
        }
    }

    /// Asks a server of ours about each task that the script has for it.
    fn ask_server(&self, name: &str, client: &mut RemoteTask, scope: &str, said: &mut Said) {
        let told = client.describe().ok().flatten();
        let known = told.and_then(|mut told| told.scopes.remove(scope));
        let mut silent = false;
        for step in self.scenes.iter().flat_map(|scene| &scene.steps) {
            for task in &step.tasks {
                let Some(handler) = step.handler(task).filter(|handler| handler.remote == name)
                else {
                    continue;
                };
                let wrong = match known
                    .as_ref()
                    .and_then(|known| missing(known, handler, task))
                {
                    Some(wrong) => Some(wrong),
                    None if silent => None,
                    None => match ask_task(client, scope, handler, task) {
                        Takes::Yes => None,
                        Takes::No(why) => Some((task.span, why, None)),
                        Takes::Unknown => {
                            silent = known.as_ref().is_none_or(BTreeMap::is_empty);
                            None
                        }
                    },
                };
                if let Some((span, message, help)) = wrong {
                    let mut found = self
                        .document()
                        .mistake(span, format!("server '{name}': {message}"));
                    found.help = help;
                    said.findings.push(Finding::mistake(found));
                }
            }
        }
        if silent && let Some(line) = said.servers.last_mut() {
            line.push_str("; its handlers do not tell what they take");
        }
    }
}

/// How it is with each server of a configuration, in lines for people: what can be said without a script.
#[must_use]
pub fn ask_all(remotes: &Remotes) -> Vec<String> {
    let names: Vec<&str> = remotes.task_names().collect();
    ask_at_once(&names, remotes, |name, remote| meet(name, remote).0)
}

/// Asks servers, at most [`AT_ONCE`] at a time, and tells their answers in the order of their names. What is
/// wrong with an entry is found without asking.
fn ask_at_once<T: Send>(
    names: &[&str],
    remotes: &Remotes,
    ask: impl Fn(&str, &Remote) -> T + Sync,
) -> Vec<T> {
    let servers = names.iter();
    let servers: Vec<_> = servers
        .filter_map(|name| Some((*name, remotes.task(name).ok()?)))
        .collect();
    let ask = &ask;
    let mut answers = Vec::new();
    for servers in servers.chunks(AT_ONCE) {
        std::thread::scope(|scope| {
            let asked: Vec<_> = servers
                .iter()
                .map(|(name, remote)| {
                    let thread = std::thread::Builder::new();
                    // Without a thread it is asked here.
                    thread
                        .spawn_scoped(scope, move || ask(name, remote))
                        .map_err(|_| ask(name, remote))
                })
                .collect();
            answers.extend(asked.into_iter().map(|asked| match asked {
                Ok(thread) => thread.join().unwrap_or_else(|panic| resume_unwind(panic)),
                Err(answer) => answer,
            }));
        });
    }
    answers
}

/// Asks a server whether it is there. A line for people, and the client of a server of ours; `None` for
/// the original's, which cannot be asked more; or why it is missing.
fn meet(name: &str, remote: &Remote) -> (String, Result<Option<RemoteTask>, String>) {
    let endpoint = remote.endpoint();
    let met = RemoteTask::connect(&endpoint, &remote.scope).and_then(|mut client| {
        let info = client.server_info(true)?;
        let there = serves(&mut client)?;
        Ok((client, info, there))
    });
    match met {
        Err(error) => (
            format!("{name}: MISSING: {error}"),
            Err(format!("server '{name}' does not answer: {error}")),
        ),
        Ok((_, _, false)) => {
            let message = format!("the server at {endpoint} has no scope '{}'", remote.scope);
            (format!("{name}: MISSING: {message}"), Err(message))
        }
        Ok((_, None, true)) => (
            format!(
                "{name}: at {endpoint}, one of the original's: it is there, and cannot be asked what it takes"
            ),
            Ok(None),
        ),
        Ok((client, Some(info), true)) => (
            format!("{name}: at {endpoint}, ztl {}", info.version),
            Ok(Some(client)),
        ),
    }
}

/// Whether a server has the client's scope.
pub(super) fn serves(client: &mut RemoteTask) -> Result<bool, RequestError> {
    // Nobody gives this id, and to ask about it does nothing.
    match client.status(TaskId::MAX) {
        Err(RequestError::NotTold { text, .. }) => Ok(!text.starts_with("No controller for scope")),
        Err(error) if !error.was_answered() => Err(error),
        _ => Ok(true),
    }
}

enum Takes {
    Yes,
    No(String),
    /// The server cannot tell.
    Unknown,
}

fn ask_task(client: &mut RemoteTask, scope: &str, handler: &Handler, task: &Task) -> Takes {
    let payload = encoded(&handler.name, &task.component, &task.goal);
    if let Err(error) = client.check_length(&payload) {
        return Takes::No(error.to_string());
    }
    let Ok(Some(answer)) = client.ask_server(&format!("takes {payload}")) else {
        return Takes::Unknown;
    };
    let scopes: Option<BTreeMap<String, Option<String>>> = serde_json::from_str(&answer).ok();
    match scopes.and_then(|mut scopes| scopes.remove(scope)) {
        Some(Some(why)) => Takes::No(why),
        Some(None) => Takes::Yes,
        None => Takes::Unknown,
    }
}

type Wrong = (ztl_yaml::Span, String, Option<String>);

/// What of a task the server has not.
fn missing(known: &Offers, handler: &Handler, task: &Task) -> Option<Wrong> {
    // `*` stands for each that has no entry of its own; an empty list for what is not known.
    let any = |names: &[String]| names.iter().any(|name| name == "*");
    let help = |written: &str, names: &[&str]| match closest(written, names.iter().copied()) {
        Some(meant) => format!("did you mean '{meant}'?"),
        None => format!("there are: {}", names.join(", ")),
    };
    if known.is_empty() {
        return None;
    }
    let Some(components) = known.get(&handler.name).or_else(|| known.get("*")) else {
        let names: Vec<&str> = known.keys().map(String::as_str).collect();
        let message = format!("it has no handler '{}'", handler.name);
        return Some((handler.span, message, Some(help(&handler.name, &names))));
    };
    if components.is_empty() || any(components) || components.contains(&task.component) {
        return None;
    }
    let names: Vec<&str> = components.iter().map(String::as_str).collect();
    let message = format!("'{}' has no component '{}'", handler.name, task.component);
    Some((task.span, message, Some(help(&task.component, &names))))
}
