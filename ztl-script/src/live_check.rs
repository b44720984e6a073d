//! Whether the servers of a script are there and would accept its tasks: `ztl check --live`; or what they said
//! of themselves before: `ztl check --descriptions`.

use std::collections::BTreeMap;
use std::panic::resume_unwind;
use std::path::PathBuf;

use ztl_std::{Offers, Remotes, SavedDescription};
use ztl_yaml::{Span, closest};

use crate::finding::Finding;
use crate::model::{Handler, Task};
use crate::script::Script;
use crate::server::{Acceptance, Connected, Connection, Server, ServerAnswer, ServerRequest};

/// Servers asked at the same time.
const AT_ONCE: usize = 64;

/// What servers said.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct ServerCheck {
    /// What is wrong.
    pub findings: Vec<Finding>,
    /// A line for people about each server.
    pub servers: Vec<String>,
}

/// Connects to the server with this name. Called from several threads.
pub type ConnectShared<'a> = &'a (dyn Fn(&str) -> Connected + Sync);

impl Script {
    /// Asks each server of the script whether it is there, and a server of this project also whether it has
    /// the handlers and components and would accept the goals. Starts nothing. Servers are asked
    /// concurrently; one that does not answer costs 2 s.
    #[must_use]
    pub fn check_live(&self, remotes: &Remotes, connect: ConnectShared<'_>) -> ServerCheck {
        let answers = ask_at_once(&self.remotes(), remotes, |name, endpoint| {
            let (line, met) = meet(name, endpoint, connect);
            let mut check = ServerCheck {
                findings: Vec::new(),
                servers: vec![line],
            };
            match met {
                Ok(Some(mut server)) => {
                    let offers = server.offers();
                    let accepts = &mut |handler: &str, task: &Task| {
                        server.would_accept(handler, &task.component, &task.goal)
                    };
                    self.check_tasks(name, offers.as_ref(), accepts, &mut check);
                }
                Ok(None) => {}
                Err(message) => {
                    let first = self.first_handler(name);
                    let found = first.map(|handler| self.mistake(handler.span, message, None));
                    check.findings.extend(found);
                }
            }
            check
        });
        let mut all = ServerCheck::default();
        for answer in answers {
            all.findings.extend(answer.findings);
            all.servers.extend(answer.servers);
        }
        all
    }

    /// Compares the tasks of the script with what its servers said of themselves, by scope. A name that
    /// `remotes` does not have, and an ambiguous one, is not compared.
    #[must_use]
    pub fn check_described(
        &self,
        remotes: &Remotes,
        saved: &[(PathBuf, SavedDescription)],
    ) -> ServerCheck {
        let mut check = ServerCheck::default();
        for name in self.remotes() {
            let Ok(remote) = remotes.task(name) else {
                continue;
            };
            let scope = remote.scope.as_str();
            let mut fitting: Vec<_> = saved
                .iter()
                .filter(|(_, told)| told.scopes.contains_key(scope))
                .collect();
            let endpoint = remote.endpoint();
            if fitting.iter().any(|(_, told)| told.endpoint == endpoint) {
                fitting.retain(|(_, told)| told.endpoint == endpoint);
            }
            let [(path, told)] = fitting.as_slice() else {
                let how_many = match fitting.as_slice() {
                    [] => "no file describes",
                    _ => "more than one file describes",
                };
                let line =
                    format!("{name}: {how_many} {scope} at {endpoint}; its tasks are not checked");
                check.servers.push(line);
                continue;
            };
            let path = path.display();
            check
                .servers
                .push(format!("{name}: as {path} describes {scope}"));
            let components = told.scope(scope);
            let accepts = &mut |handler: &str, task: &Task| {
                Acceptance::described(&components, handler, &task.component, &task.goal)
            };
            self.check_tasks(name, told.scopes.get(scope), accepts, &mut check);
        }
        check
    }

    /// Asks about each task that the script has for a server. The last line of the check is the server's.
    fn check_tasks(
        &self,
        name: &str,
        offers: Option<&Offers>,
        accepts: &mut dyn FnMut(&str, &Task) -> Acceptance,
        check: &mut ServerCheck,
    ) {
        let mut silent = offers.is_none_or(Offers::is_empty);
        let whose = |message| format!("server '{name}': {message}");
        // The places of each missing name.
        let mut names: BTreeMap<(String, Option<String>), Vec<Span>> = BTreeMap::new();
        for (handler, task) in self.tasks_of(name) {
            let missing = offers.and_then(|offers| missing(offers, handler, task));
            if let Some((span, message, help)) = missing {
                names.entry((message, help)).or_default().push(span);
                continue;
            }
            let told = accepts(&handler.name, task);
            silent &= told == Acceptance::Unknown;
            if let Acceptance::No(why) = told {
                let found = self.mistake(task.goal_span, whose(why), None);
                check.findings.push(found);
            }
        }
        for ((message, help), places) in names {
            let found = self.mistake_at(&places, whose(message), help);
            check.findings.push(found);
        }
        if silent && let Some(line) = check.servers.last_mut() {
            line.push_str("; its handlers do not tell what they take");
        }
    }
}

/// A line for people about each server of a configuration: the part of the check that needs no script.
#[must_use]
pub fn check_servers(remotes: &Remotes, connect: ConnectShared<'_>) -> Vec<String> {
    let names: Vec<&str> = remotes.task_names().collect();
    ask_at_once(&names, remotes, |name, endpoint| {
        meet(name, endpoint, connect).0
    })
}

/// Asks up to [`AT_ONCE`] servers at a time, and returns their answers in the order of their names. Skips
/// invalid entries of the configuration, which are reported without asking.
fn ask_at_once<T: Send>(
    names: &[&str],
    remotes: &Remotes,
    ask: impl Fn(&str, &str) -> T + Sync,
) -> Vec<T> {
    let servers: Vec<_> = names
        .iter()
        .filter_map(|name| Some((*name, remotes.task(name).ok()?.endpoint())))
        .collect();
    let ask = &ask;
    let mut answers = Vec::new();
    for servers in servers.chunks(AT_ONCE) {
        std::thread::scope(|scope| {
            let asked: Vec<_> = servers
                .iter()
                .map(|(name, endpoint)| {
                    // If no thread can be started, ask on this one.
                    std::thread::Builder::new()
                        .spawn_scoped(scope, move || ask(name, endpoint))
                        .map_err(|_| ask(name, endpoint))
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

/// Whether a server is there: a line for people, and the connection if more can be asked over it. The
/// original's server answers no more (`None`).
fn meet(
    name: &str,
    endpoint: &str,
    connect: ConnectShared<'_>,
) -> (String, Result<Option<Box<dyn Connection>>, String>) {
    let silent = |error| Err((format!("server '{name}' does not answer: {error}"), error));
    let met = match connect(name) {
        Err(error) => silent(error),
        Ok(mut connection) => match connection.request(&ServerRequest::Probe, &|| true) {
            ServerAnswer::There { server } => Ok((connection, server)),
            ServerAnswer::NoScope { text } => Err((text.clone(), text)),
            ServerAnswer::Nothing { text, .. }
            | ServerAnswer::NotTold { text }
            | ServerAnswer::Unclear { text } => silent(text),
            _ => silent("unexpected answer".to_owned()),
        },
    };
    match met {
        Err((message, error)) => (format!("{name}: MISSING: {error}"), Err(message)),
        Ok((_, Server::Original)) => (
            format!(
                "{name}: at {endpoint}, one of the original's: it answers, but cannot be asked which tasks it accepts"
            ),
            Ok(None),
        ),
        Ok((connection, Server::Ours { version, .. })) => (
            format!("{name}: at {endpoint}, ztl {version}"),
            Ok(Some(connection)),
        ),
    }
}

/// The handler or component of a task that the server does not have.
fn missing(
    offers: &Offers,
    handler: &Handler,
    task: &Task,
) -> Option<(Span, String, Option<String>)> {
    let help = |written: &str, names: &[&str]| {
        Some(match closest(written, names.iter().copied()) {
            Some(meant) => format!("did you mean '{meant}'?"),
            None => format!("there are: {}", names.join(", ")),
        })
    };
    if offers.is_empty() {
        return None;
    }
    // `*` stands for every handler or component without an entry of its own.
    let Some(components) = offers.get(&handler.name).or_else(|| offers.get("*")) else {
        let names: Vec<&str> = offers.keys().map(String::as_str).collect();
        let message = format!("it has no handler '{}'", handler.name);
        return Some((handler.span, message, help(&handler.name, &names)));
    };
    let names: Vec<&str> = components.iter().map(String::as_str).collect();
    // An empty list means that the server does not know them.
    if names.is_empty() || names.contains(&"*") || names.contains(&task.component.as_str()) {
        return None;
    }
    let message = format!("'{}' has no component '{}'", handler.name, task.component);
    Some((task.span, message, help(&task.component, &names)))
}
