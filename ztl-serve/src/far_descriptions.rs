//! What a scope's components say of themselves, with what the servers behind `forward` say of theirs.
//!
//! A thread asks those servers again and again, so that no answer and no task waits for them. A server that does not
//! answer, or is one of the original's, says nothing.

use std::collections::BTreeMap;
use std::io;
use std::sync::{Arc, Mutex, PoisonError, Weak};
use std::time::Duration;

use ztl_std::RemoteTask;
use ztl_std::describe::{ComponentDescription, Descriptions, GoalRule, ScopeDescriptions};

use crate::components::{Components, WILDCARD};
use crate::forward::Forward;

/// Pause between two questions to a server.
const AGAIN: Duration = Duration::from_secs(5);

/// Another server's scope.
struct FarScope<'c> {
    place: &'c Forward,
    /// `None` if there can be no client.
    remote: Option<RemoteTask>,
    said: ScopeDescriptions,
}

/// What the components of a scope say of themselves at this moment.
#[derive(Debug)]
pub(crate) struct ScopeDescription {
    current: Current,
}

type Current = Arc<Mutex<Arc<ScopeDescriptions>>>;

impl ScopeDescription {
    pub(crate) fn new(components: &Arc<Components>) -> io::Result<Self> {
        let first = Arc::new(all(components, &[]));
        let current = Arc::new(Mutex::new(first));
        if components.iter().any(|(.., it)| it.forward().is_some()) {
            let (components, current) = (Arc::clone(components), Arc::downgrade(&current));
            let thread = std::thread::Builder::new().name("ztl-far".to_owned());
            thread.spawn(move || ask(&components, &current))?;
        }
        Ok(Self { current })
    }

    /// What tells it.
    pub(crate) fn teller(&self) -> Descriptions {
        let current = Arc::clone(&self.current);
        Box::new(move || Arc::clone(&current.lock().unwrap_or_else(PoisonError::into_inner)))
    }
}

/// Asks the servers behind `forward` for as long as anybody wants to know.
fn ask(components: &Components, current: &Weak<Mutex<Arc<ScopeDescriptions>>>) {
    let mut scopes: Vec<FarScope<'_>> = Vec::new();
    for place in components.iter().filter_map(|(.., it)| it.forward()) {
        if !scopes.iter().any(|known| known.place.is_same_scope(place)) {
            scopes.push(FarScope {
                place,
                remote: place.connect().ok(),
                said: ScopeDescriptions::new(),
            });
        }
    }
    loop {
        for scope in &mut scopes {
            let said = scope.remote.as_mut().map(RemoteTask::describe_scope);
            scope.said = said.and_then(Result::ok).unwrap_or_default();
        }
        let all = Arc::new(all(components, &scopes));
        let Some(current) = current.upgrade() else {
            return;
        };
        *current.lock().unwrap_or_else(PoisonError::into_inner) = all;
        drop(current);
        std::thread::sleep(AGAIN);
    }
}

/// The descriptions of all components, by the names that clients of this server use.
fn all(components: &Components, far: &[FarScope<'_>]) -> ScopeDescriptions {
    let mut all = ScopeDescriptions::new();
    let mut add = |handler: &str, component: &str, is: ComponentDescription| {
        let components = all.entry(handler.to_owned()).or_default();
        components.entry(component.to_owned()).or_insert(is);
    };
    for (handler, component, config) in components.iter() {
        let own = &config.description;
        if let Some(place) = config.forward()
            && let Some(scope) = far.iter().find(|far| far.place.is_same_scope(place))
        {
            let is_named = |name: &str| components.has_handler(name);
            let handlers = reached(&scope.said, handler, place.handler.as_deref(), is_named);
            for (name, said) in handlers {
                let is_named = |name: &str| components.has(handler, name);
                let said = reached(said, component, place.component.as_deref(), is_named);
                for (component, is) in said {
                    add(name, component, over(own, is));
                }
            }
        }
        add(handler, component, own.clone());
    }
    // The handlers of another server also have what `*` has here.
    let others = all.get(WILDCARD).into_iter().flatten();
    let others: Vec<_> = others
        .map(|(name, is)| (name.clone(), is.clone()))
        .collect();
    for (handler, there) in &mut all {
        if !components.has_handler(handler) {
            for (component, is) in &others {
                let is = || is.clone();
                there.entry(component.clone()).or_insert_with(is);
            }
        }
    }
    all
}

/// What clients reach under a name of this server: an entry there, which may have another name. Behind `*`, all that have
/// no entry of their own here.
fn reached<'a, T>(
    there: &'a BTreeMap<String, T>,
    here: &'a str,
    renamed: Option<&str>,
    is_named: impl Fn(&str) -> bool,
) -> Vec<(&'a str, &'a T)> {
    if renamed.is_none() && here == WILDCARD {
        let all = there.iter().map(|(name, of)| (name.as_str(), of));
        return all
            .filter(|(name, _)| *name == WILDCARD || !is_named(name))
            .collect();
    }
    let one = there.get(renamed.unwrap_or(here));
    let one = one.or_else(|| there.get(WILDCARD));
    one.map(|of| (here, of)).into_iter().collect()
}

/// A description there, with what the file here says instead.
fn over(own: &ComponentDescription, far: &ComponentDescription) -> ComponentDescription {
    let (own, far) = (own.clone(), far.clone());
    let (goal, examples) = match own.goal {
        GoalRule::Any => (far.goal, far.examples),
        goal => (goal, Arc::default()),
    };
    let or = |own: Arc<[Arc<str>]>, far| if own.is_empty() { far } else { own };
    ComponentDescription {
        goal,
        about: own.about.or(far.about),
        examples: or(own.examples, examples),
        result: own.result.or(far.result),
        streams: or(own.streams, far.streams),
        can_abort: own.can_abort && far.can_abort,
        usually_ms: own.usually_ms.or(far.usually_ms),
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use ztl_std::describe::{described, find};
    use ztl_yaml::Document;

    use super::*;
    use crate::Config;

    /// What clients of a server with these handlers are told, if another one says this.
    fn told(handlers: &str, far: &[(&str, &str, &str)]) -> Vec<String> {
        let text = format!("scopes: {{/near: {handlers}}}");
        let document = Document::parse("robot.yaml", text.as_bytes()).expect("YAML");
        let config = Config::read(&document, Path::new("/")).expect("a configuration");
        let components = Components::new(config.scopes[0].configs());
        let mut said = ScopeDescriptions::new();
        for (handler, component, word) in far {
            let word = GoalRule::OneOf([Arc::from(*word)].into());
            let components = said.entry((*handler).to_owned()).or_default();
            components.insert((*component).to_owned(), described(word));
        }
        let place = components.iter().find_map(|(.., it)| it.forward());
        let far = FarScope {
            place: place.expect("a forward"),
            remote: None,
            said,
        };
        let all = all(&components, &[far]);
        let listed = all.iter().flat_map(|(handler, components)| {
            let components = components.iter();
            components.map(move |(name, is)| format!("{handler}:{name}:{}", is.goal))
        });
        assert!(find(&all, "x", "y").is_none_or(|is| is.can_abort));
        listed.collect()
    }

    #[test]
    fn another_servers_components_are_listed_under_the_names_of_this_one() {
        const FAR: &[(&str, &str, &str)] = &[
            ("arm", "left", "up"),
            ("arm", "right", "down"),
            ("base", "drive", "on"),
            ("*", "*", "any"),
        ];
        let to = "forward: {to: 'tcp://h:1', scope: /far";
        for (handlers, expected) in [
            (
                format!("{{arm: {{left: {{{to}}}}}, x: echo}}}}"),
                &["arm:left:up", "arm:x:anything"][..],
            ),
            (
                format!("{{hand: {{x: {{{to}, handler: arm, component: right}}}}}}}}"),
                &["hand:x:down"],
            ),
            (
                format!("{{arm: {{left: echo, '*': {{{to}}}}}}}}}"),
                &["arm:*:anything", "arm:left:anything", "arm:right:down"],
            ),
            (
                format!("{{a: {{'*': {{{to}, handler: base}}}}}}}}"),
                &["a:*:anything", "a:drive:on"],
            ),
            (
                format!("{{arm: {{left: echo}}, '*': {{'*': {{{to}}}}}}}}}"),
                &[
                    "*:*:any",
                    "arm:left:anything",
                    "base:*:any",
                    "base:drive:on",
                ],
            ),
            (
                format!("{{'*': {{own: echo, '*': {{{to}}}}}}}}}"),
                &[
                    "*:*:any",
                    "*:own:anything",
                    "arm:*:any",
                    "arm:left:up",
                    "arm:own:anything",
                    "arm:right:down",
                    "base:*:any",
                    "base:drive:on",
                    "base:own:anything",
                ],
            ),
            (
                format!("{{arm: {{left: {{goal: truth, {to}}}}}}}}}"),
                &["arm:left:True or False"],
            ),
        ] {
            assert_eq!(told(&handlers, FAR), expected, "{handlers}");
        }
        let handlers = format!("{{arm: {{left: {{{to}}}}}}}}}");
        assert_eq!(told(&handlers, &[]), ["arm:left:anything"]);
    }
}
