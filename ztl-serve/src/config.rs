//! The configuration file. `docs/serve.md` describes each key.

mod goal_rule;

use std::io;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use ztl_std::Publisher;
use ztl_std::describe::{CheckGoal, ComponentDescription, GoalRule, described};
use ztl_std::listen::Listen;
use ztl_yaml::{Diagnostic, Diagnostics, Document, Node, NodeValue};

use crate::admission::BusyPolicy;
use crate::built_in::BUILT_INS;
use crate::component_config::{ComponentConfig, TotalLimit};
use crate::components::WILDCARD;
use crate::handler::ScopeHandler;
use crate::kinds::{KINDS, LIST, WORD};
use crate::naoqi;
use crate::program::processes::ProcessRegistry;
use crate::reader::{ComponentContext, ConfigReader};
use crate::ros1::connection::Connection;
use crate::ros1::names::missing;
use crate::ros1::used_name::UsedName;
use crate::stream::read::cannot_have_streams;
use crate::stream::{StreamConfig, Streams};

/// How many tasks may run or wait in all, unless the file says otherwise.
const AT_ONCE: usize = 200;
/// The highest such limit: each program needs two of a process's files, which are often 1024.
const MOST: usize = 400;
/// The longest time that a task may usually take.
const LONGEST_USUAL: Duration = Duration::from_hours(24);

/// A configuration file.
#[derive(Debug, Clone)]
#[non_exhaustive]
pub struct Config {
    /// Where the server listens, who may use it, and what it logs.
    pub listen: Listen,
    /// The scopes, in the file's order.
    pub scopes: Vec<Scope>,
    /// What may not be as intended, such as a program that is not installed.
    pub warnings: Vec<Diagnostic>,
    /// The mistake that there are streams and no port to publish them at, unless that is given elsewhere.
    pub unpublished: Option<Diagnostic>,
    pub(crate) streams: Vec<Arc<StreamConfig>>,
    at_once: usize,
    /// The node of ROS 1, and the names there that the file uses.
    ros1: (Arc<Connection>, Vec<UsedName>),
    /// The robot with NAOqi, and what of it the file uses.
    naoqi: Arc<naoqi::names::Naoqi>,
}

/// A scope and its handlers.
#[derive(Debug, Clone)]
pub struct Scope {
    name: String,
    /// With handler and component, in the file's order.
    configs: Vec<(String, String, Arc<ComponentConfig>)>,
}

impl Scope {
    /// The name, as `/robot`.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// The number of components.
    #[must_use]
    pub fn components(&self) -> usize {
        self.configs.len()
    }

    pub(crate) fn configs(&self) -> impl Iterator<Item = (&str, &str, &Arc<ComponentConfig>)> {
        let configs = self.configs.iter();
        configs.map(|(handler, component, config)| (handler.as_str(), component.as_str(), config))
    }
}

impl Config {
    /// Reads a file. Paths in it are relative to its directory.
    ///
    /// # Errors
    /// All mistakes in it, each with its place.
    pub fn load(path: &Path) -> Result<Self, Diagnostics> {
        Self::of(&ztl_std::files::load_yaml(path)?)
    }

    /// Reads a file that is parsed already.
    ///
    /// # Errors
    /// As [`load`](Self::load).
    pub fn of(document: &Document) -> Result<Self, Diagnostics> {
        let path = Path::new(document.name());
        let base = path.parent().unwrap_or(Path::new(""));
        // Absolute, since programs run in other directories.
        let base = std::path::absolute(base.join(".")).unwrap_or_else(|_| base.to_owned());
        Self::read(document, &base)
    }

    /// Reads a document; paths are relative to `base`.
    ///
    /// # Errors
    /// As [`load`](Self::load).
    pub fn read(document: &Document, base: &Path) -> Result<Self, Diagnostics> {
        let mut reader = ConfigReader::new(document, base);
        let config = reader.config(document.root());
        let mut config = reader.yaml.finish(config)?;
        config.warnings = reader.warnings;
        Ok(config)
    }

    /// The names of all scopes, those of handlers first.
    #[must_use]
    pub fn scope_names(&self) -> Vec<&str> {
        let mut names: Vec<&str> = self.scopes.iter().map(Scope::name).collect();
        for (scope, _) in self.streams() {
            if !names.contains(&scope) {
                names.push(scope);
            }
        }
        names
    }

    /// Gives all scopes this name: for a file that has only one.
    ///
    /// # Errors
    /// If there are streams, which cannot have this scope: why.
    pub fn rename_scopes(&mut self, name: &str) -> Result<(), String> {
        if !self.streams.is_empty()
            && let Some(mistake) = cannot_have_streams(name)
        {
            return Err(mistake);
        }
        for scope in &mut self.scopes {
            name.clone_into(&mut scope.name);
        }
        for stream in &mut self.streams {
            name.clone_into(&mut Arc::make_mut(stream).scope);
        }
        Ok(())
    }

    /// Asks the master of ROS 1, and NAOqi, for the names that the file uses, and warns of those that are not there or of
    /// another type. Blocks for some seconds if they do not answer.
    #[must_use]
    pub fn missing_names(&self) -> Vec<Diagnostic> {
        let (connection, names) = &self.ros1;
        let mut missing = missing(connection, names);
        missing.extend(naoqi::names::missing(&self.naoqi));
        missing
    }

    /// The number of streams of each scope that has any.
    #[must_use]
    pub fn streams(&self) -> Vec<(&str, usize)> {
        let mut counts: Vec<(&str, usize)> = Vec::new();
        for stream in &self.streams {
            match counts.iter_mut().find(|(scope, _)| *scope == stream.scope) {
                Some((_, count)) => *count += 1,
                None => counts.push((&stream.scope, 1)),
            }
        }
        counts
    }

    /// Starts the streams, which are published under their scopes; `None` if the file has none.
    ///
    /// # Errors
    /// If the system has no more threads or files.
    pub fn start_streams(
        &self,
        processes: &ProcessRegistry,
        publisher: &Publisher,
    ) -> io::Result<Option<Streams>> {
        match self.streams.is_empty() {
            true => Ok(None),
            false => Streams::start(&self.streams, processes, publisher).map(Some),
        }
    }

    /// Makes the handler of each scope, to be registered under the scope's name.
    ///
    /// # Errors
    /// If the system has no more threads or files.
    pub fn handlers(&self, processes: &ProcessRegistry) -> io::Result<Vec<(String, ScopeHandler)>> {
        let total = TotalLimit::new(self.at_once);
        let scopes = self.scopes.iter();
        scopes
            .map(|scope| {
                let (total, processes) = (total.clone(), processes.clone());
                let handler = ScopeHandler::new(&scope.name, scope.configs(), total, processes)?;
                Ok((scope.name.clone(), handler))
            })
            .collect()
    }
}

impl<'d> ConfigReader<'d> {
    fn config(&mut self, root: &'d Node) -> Option<Config> {
        let mut fields = self.yaml.fields(root, "port, scopes")?;
        let listen = Listen::read(&mut self.yaml, &mut fields, self.base);
        let at_once = fields.optional("at-once");
        let at_once = at_once.and_then(|node| self.count(node, MOST));
        if let Some(node) = fields.optional("ros1") {
            self.ros1(node);
        }
        if let Some(node) = fields.optional("naoqi") {
            self.naoqi(node);
        }
        if let Some(node) = fields.optional("http") {
            self.http_hosts(node);
        }
        let mut scopes = Vec::new();
        let example = "scopes: {/robot: {tts: {say: [espeak-ng, '{goal}']}}}";
        let streams_node = fields.optional("streams");
        let scopes_node = match streams_node {
            Some(_) => fields.optional("scopes"),
            None => fields.required("scopes", example),
        };
        if let Some(node) = scopes_node {
            for (name, node) in self.non_empty(node, "scopes, as /robot") {
                scopes.extend(self.scope(name, node));
            }
        }
        let streams = streams_node.map(|node| self.streams(node));
        let unpublished = streams_node.filter(|_| listen.publish.is_none());
        let message =
            "streams need a port where they are published; write publish: 12346, or give --publish";
        let unpublished = unpublished.map(|node| self.yaml.mistake(node, message));
        fields.finish(&mut self.yaml);
        Some(Config {
            listen,
            scopes,
            warnings: Vec::new(),
            unpublished,
            streams: streams.unwrap_or_default(),
            ros1: (
                Arc::clone(&self.ros1.connection),
                std::mem::take(&mut self.ros1.names),
            ),
            naoqi: Arc::new(std::mem::take(&mut self.naoqi)),
            at_once: at_once.unwrap_or(AT_ONCE),
        })
    }

    fn scope(&mut self, name: &'d Node, node: &'d Node) -> Option<Scope> {
        let known = self.scope_name(name);
        let mut configs = Vec::new();
        for (handler, node) in self.non_empty(node, "its handlers") {
            let handler = self.name(handler, "a handler");
            for (component, node) in self.non_empty(node, "the handler's components") {
                let component = self.name(component, "a component");
                let wildcard = [&handler, &component].map(|name| name.as_deref() == Some(WILDCARD));
                let config = self.component(node, wildcard.contains(&true));
                if let (Some(handler), Some(component), Some(config)) =
                    (&handler, component, config)
                {
                    configs.push((handler.clone(), component, Arc::new(config)));
                }
            }
        }
        Some(Scope {
            name: known?,
            configs,
        })
    }

    fn component(&mut self, node: &'d Node, wildcard: bool) -> Option<ComponentConfig> {
        let short_form = match &node.value {
            NodeValue::List(_) => LIST,
            NodeValue::Scalar { .. } if !node.is_null() => WORD,
            _ => return self.mapping(node, wildcard),
        };
        let rule = &GoalRule::Any;
        let kind = short_form(self, node, None, ComponentContext { rule, wildcard })?;
        Some(ComponentConfig {
            description: ComponentDescription {
                can_abort: kind.can_abort(),
                ..described(kind.goal_rule())
            },
            at_once: kind.at_once(),
            kind,
            busy: BusyPolicy::Reject,
            needs_client: None,
        })
    }

    /// A component with keys.
    fn mapping(&mut self, node: &'d Node, wildcard: bool) -> Option<ComponentConfig> {
        let words = BUILT_INS.map(|(name, _)| name).join(", ");
        let what = format!("run: [PROGRAM, ARGUMENT, …], shell, forward, or one of: {words}");
        let mut fields = self.yaml.fields(node, &what)?;
        let rule_node = fields.optional("goal");
        let rule = rule_node.map(|node| self.rule(node));
        let mut line = |key| {
            let node = fields.optional(key)?;
            let text = self.yaml.text(node, "a line of text")?;
            Some(Arc::<str>::from(text))
        };
        let (about, returns) = (line("about"), line("returns"));
        let examples = fields.optional("examples");
        let streams = fields.optional("streams");
        let usually = fields.optional("usually");
        let usually = usually.and_then(|node| self.time(node, LONGEST_USUAL));
        let usually_ms = usually.and_then(|time| u32::try_from(time.as_millis()).ok());
        let at_once = fields.optional("at-once");
        let at_once = at_once.and_then(|node| self.count(node, MOST));
        let busy_node = fields.optional("busy");
        let busy = busy_node.and_then(|node| self.busy(node));
        let client_node = fields.optional("needs-client");
        let needs_client = client_node.and_then(|node| self.silence(node));
        let given = KINDS.map(|(key, read)| Some((fields.optional(key)?, read)));
        let mut given = given.into_iter().flatten();
        let kind = match given.next() {
            Some((value, read)) => {
                // If the rule is wrong, the kind is checked for any goal, so that it causes no more mistakes.
                let rule = rule.clone().flatten().unwrap_or_default();
                let context = ComponentContext {
                    rule: &rule,
                    wildcard,
                };
                read(self, value, Some(&mut fields), context)
            }
            None => {
                let keys = KINDS.map(|(key, _)| key);
                let example = match fields.has_one_of(&["get", "post", "put", "patch", "delete"]) {
                    true => "http: {post: \"http://{robot}/api/halt\"}",
                    false => "run: [PROGRAM, ARGUMENT]",
                };
                fields.lacks_one_of(keys, "nothing does this task", example);
                None
            }
        };
        if let Some((second, _)) = given.next() {
            let keys = KINDS.map(|(key, _)| key).join(", ");
            self.yaml.wrong(second, format!("give only one of: {keys}"));
        }
        fields.finish(&mut self.yaml);
        let kind = kind?;
        if !kind.can_abort() {
            let replace = busy_node.filter(|_| busy == Some(BusyPolicy::Replace));
            for (node, key) in [(replace, "busy: replace"), (client_node, "needs-client")] {
                if let Some(node) = node {
                    let message = format!("{key} aborts tasks; remove abort: no");
                    self.yaml.wrong(node, message);
                }
            }
        }
        let goal = match rule {
            Some(rule) => rule?,
            None => kind.goal_rule(),
        };
        let examples = examples.map(|node| self.examples(node, &goal));
        let streams = streams.map(|node| self.topics(node));
        Some(ComponentConfig {
            description: ComponentDescription {
                about,
                examples: examples.unwrap_or_default(),
                streams: streams.unwrap_or_default(),
                result: returns,
                usually_ms,
                can_abort: kind.can_abort(),
                ..described(goal)
            },
            at_once: at_once.unwrap_or(kind.at_once()),
            kind,
            busy: busy.unwrap_or(BusyPolicy::Reject),
            needs_client,
        })
    }

    /// Goals that the component takes.
    fn examples(&mut self, node: &'d Node, rule: &GoalRule) -> Arc<[Arc<str>]> {
        let nodes = self.yaml.list(node, "goals, as [1, 2]").unwrap_or_default();
        let mut examples = Vec::new();
        for node in nodes {
            let Some(text) = self.yaml.text(node, "a goal, in quotes if it has brackets") else {
                continue;
            };
            if let Err(why) = rule.check(text, false) {
                self.yaml.wrong(node, why);
            }
            examples.push(Arc::from(text));
        }
        examples.into()
    }

    /// Topics that the component's program publishes.
    fn topics(&mut self, node: &'d Node) -> Arc<[Arc<str>]> {
        let nodes = self.yaml.list(node, "topics, as [/robot/pose]");
        let nodes = nodes.unwrap_or_default().iter();
        nodes
            .filter_map(|node| {
                self.yaml
                    .text(node, "a topic, as /robot/pose")
                    .map(Arc::from)
            })
            .collect()
    }

    fn busy(&mut self, node: &'d Node) -> Option<BusyPolicy> {
        let what = "refuse, replace, or queue with how many may wait, as queue 3";
        self.yaml.parsed(node, what, |text| {
            let mut words = text.split_whitespace();
            let number = |word: &str| word.parse().ok().filter(|most| (1..=MOST).contains(most));
            match (words.next(), words.next().map(number), words.next()) {
                (Some("refuse"), None, None) => Ok(BusyPolicy::Reject),
                (Some("replace"), None, None) => Ok(BusyPolicy::Replace),
                (Some("queue"), Some(Some(most)), None) => Ok(BusyPolicy::Queue(most)),
                _ => Err(format!("'{text}' is not {what}")),
            }
        })
    }

    /// How long a client may be silent.
    fn silence(&mut self, node: &'d Node) -> Option<Duration> {
        self.at_least(node, 2, "a client that waits asks every second; better 5s")
    }
}

#[cfg(test)]
mod tests;
