//! The robots of the configuration, grouped by server, and the names of their actions.

use std::sync::Arc;

use ztl_std::keys::KeyFiles;
use ztl_std::{Offers, RemoteTask};

/// Connects to a scope of a server.
pub type Connect = Arc<dyn Fn(&str) -> Result<RemoteTask, String> + Send + Sync>;

/// A robot, as the configuration names it.
pub struct Robot {
    /// Its name.
    pub name: String,
    /// Where its server is.
    pub endpoint: String,
    /// Its scope at that server.
    pub scope: String,
    /// Its own keys in the configuration, if it has any. What a key may use, another need not see.
    pub keys: Option<KeyFiles>,
    /// Connects to any scope of its server.
    pub connect: Connect,
}

/// A server with the keys for it, which several names of the configuration may share.
pub(crate) struct Server {
    /// The names, joined.
    pub(crate) name: String,
    pub(crate) endpoint: String,
    keys: Option<KeyFiles>,
    pub(crate) scopes: Vec<ConfiguredScope>,
    pub(crate) connect: Connect,
}

/// Longest answer of a server, in bytes: a list of 1,000 tasks has much less.
const LONGEST_ANSWER: usize = 4 << 20;

impl Server {
    /// The scope of a robot, if this is its server.
    pub(crate) fn scope_of(&self, robot: &str) -> Option<&str> {
        let mut scopes = self.scopes.iter();
        let scope = scopes.find(|scope| scope.names.iter().any(|name| name == robot));
        scope.map(|scope| scope.scope.as_str())
    }

    /// A client of a scope of this server.
    pub(crate) fn remote(&self, scope: &str) -> Result<RemoteTask, String> {
        let remote = (self.connect)(scope)?.with_longest_answer(LONGEST_ANSWER);
        remote.map_err(|error| error.to_string())
    }
}

pub(crate) struct ConfiguredScope {
    pub(crate) scope: String,
    /// What the names of its actions begin with: the scope; `NAME:SCOPE` if there is the same one elsewhere, or one is
    /// below the other.
    pub(crate) prefix: String,
    names: Vec<String>,
}

/// A component that an action names.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Target {
    /// Index of the server.
    pub(crate) server: usize,
    pub(crate) scope: String,
    pub(crate) handler: String,
    pub(crate) component: String,
}

/// Groups robots by their server and keys.
pub(crate) fn group(robots: Vec<Robot>) -> Vec<Server> {
    let mut servers: Vec<Server> = Vec::new();
    for robot in robots {
        let known = servers
            .iter_mut()
            .find(|server| server.endpoint == robot.endpoint && server.keys == robot.keys);
        let scope = ConfiguredScope {
            prefix: robot.scope.clone(),
            scope: robot.scope,
            names: vec![robot.name.clone()],
        };
        let Some(server) = known else {
            servers.push(Server {
                name: robot.name,
                endpoint: robot.endpoint,
                keys: robot.keys,
                scopes: vec![scope],
                connect: robot.connect,
            });
            continue;
        };
        server.name = format!("{}, {}", server.name, robot.name);
        let mut scopes = server.scopes.iter_mut();
        match scopes.find(|known| known.scope == scope.scope) {
            Some(known) => known.names.push(robot.name),
            None => server.scopes.push(scope),
        }
    }
    let scopes = servers.iter().flat_map(|server| &server.scopes);
    let all: Vec<String> = scopes.map(|scope| scope.scope.clone()).collect();
    for scope in servers.iter_mut().flat_map(|server| &mut server.scopes) {
        let alike =
            |other: &&String| is_below(other, &scope.scope) || is_below(&scope.scope, other);
        // One of them is itself.
        if all.iter().filter(alike).count() > 1
            && let Some(name) = scope.names.first()
        {
            scope.prefix = format!("{name}:{}", scope.scope);
        }
    }
    servers
}

/// Whether a scope is another one, or below it.
fn is_below(scope: &str, other: &str) -> bool {
    let rest = scope.strip_prefix(other);
    rest.is_some_and(|rest| rest.is_empty() || rest.starts_with('/'))
}

/// Whether a scope offers a component.
#[derive(Debug, PartialEq, Eq)]
enum Offer {
    Yes,
    /// The server does not report it.
    Perhaps,
    No,
}

fn offer(offers: Option<&Offers>, handler: &str, component: &str) -> Offer {
    let Some(offers) = offers.filter(|offers| !offers.is_empty()) else {
        return Offer::Perhaps;
    };
    match offers.get(handler) {
        Some(components) if components.iter().any(|known| known == component) => Offer::Yes,
        Some(components) if components.is_empty() => Offer::Perhaps,
        Some(components) if components.iter().any(|known| known == "*") => Offer::Perhaps,
        None if offers.contains_key("*") => Offer::Perhaps,
        _ => Offer::No,
    }
}

/// The component that an action `SCOPE/handler/component` or `NAME:SCOPE/handler/component` names. `offers` tells what a
/// scope of a server offers, if that is known.
///
/// # Errors
/// What is wrong with the name; also if it could be another component.
pub(crate) fn find(
    servers: &[Server],
    offers: impl Fn(usize, &str) -> Option<Offers>,
    action: &str,
) -> Result<Target, String> {
    // What may be meant, with an unmistakable name for it; and what only the server would reject.
    let mut meant: Vec<(Target, String)> = Vec::new();
    let mut unknown: Vec<(Target, String)> = Vec::new();
    for (server, of) in servers.iter().enumerate() {
        for scope in &of.scopes {
            let known = offers(server, &scope.scope);
            let names = scope
                .names
                .iter()
                .map(|name| format!("{name}:{}", scope.scope));
            let prefixes = names.chain([scope.scope.clone()]);
            let rests =
                prefixes.filter_map(|prefix| action.strip_prefix(&prefix)?.strip_prefix('/'));
            for rest in rests {
                for (first, (at, _)) in rest.match_indices('/').enumerate() {
                    let (handler, component) = rest.split_at(at);
                    let component = component.strip_prefix('/').unwrap_or(component);
                    let offer = offer(known.as_ref(), handler, component);
                    // Without a list, no handler has a `/` in its name.
                    if handler.is_empty() || (first > 0 && offer != Offer::Yes) {
                        continue;
                    }
                    let target = Target {
                        server,
                        scope: scope.scope.clone(),
                        handler: handler.to_owned(),
                        component: component.to_owned(),
                    };
                    let name =
                        format!("component '{component}' of '{handler}' of {}", scope.prefix);
                    let list = match offer {
                        Offer::Yes | Offer::Perhaps => &mut meant,
                        Offer::No => &mut unknown,
                    };
                    if !list.iter().any(|(known, _)| *known == target) {
                        list.push((target, name));
                    }
                }
            }
        }
    }
    let candidates = match meant.is_empty() {
        true => unknown,
        false => meant,
    };
    match candidates.as_slice() {
        [(target, _)] => Ok(target.clone()),
        [] => {
            let prefixes = servers.iter().flat_map(|server| &server.scopes);
            let prefixes: Vec<&str> = prefixes.map(|scope| scope.prefix.as_str()).collect();
            let action = crate::cut::text(action, crate::cut::LINE);
            Err(format!(
                "no action '{action}': expected SCOPE/handler/component, where SCOPE is one of {}",
                prefixes.join(" ")
            ))
        }
        several => {
            let names: Vec<&str> = several.iter().map(|(_, name)| name.as_str()).collect();
            let (action, names) = (
                crate::cut::text(action, crate::cut::LINE),
                names.join(", or "),
            );
            Err(format!(
                "not sent: '{action}' may mean {names}: write NAME:SCOPE for the scope"
            ))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn servers(robots: &[(&str, &str, &str)]) -> Vec<Server> {
        let robot = |(name, endpoint, scope): &(&str, &str, &str)| Robot {
            name: (*name).to_owned(),
            endpoint: (*endpoint).to_owned(),
            scope: (*scope).to_owned(),
            keys: None,
            connect: Arc::new(|_| Err(String::new())),
        };
        group(robots.iter().map(robot).collect())
    }

    fn offers(handlers: &[(&str, &[&str])]) -> Offers {
        let handlers = handlers.iter().map(|(handler, components)| {
            let components = components.iter().map(|name| (*name).to_owned());
            ((*handler).to_owned(), components.collect())
        });
        handlers.collect()
    }

    /// The component that an action names, as server, handler and component.
    fn found(
        servers: &[Server],
        known: &[Option<Offers>],
        action: &str,
    ) -> Result<(usize, String, String), String> {
        let known = |server: usize, _: &str| known.get(server).cloned().flatten();
        let target = find(servers, known, action)?;
        Ok((target.server, target.handler, target.component))
    }

    #[test]
    fn an_action_names_the_component_that_is_offered() {
        let servers = servers(&[("a", "tcp://a:1", "/lab"), ("b", "tcp://b:1", "/lab/arm")]);
        let prefixes = servers.iter().flat_map(|server| &server.scopes);
        let prefixes: Vec<&str> = prefixes.map(|scope| scope.prefix.as_str()).collect();
        assert_eq!(prefixes, ["a:/lab", "b:/lab/arm"]);
        let target = |server, handler: &str, component: &str| {
            Ok((server, handler.to_owned(), component.to_owned()))
        };
        let (ours, theirs) = (offers(&[("arm", &["left/x"])]), offers(&[("left", &["x"])]));
        let both = [Some(ours.clone()), Some(theirs)];
        for (action, expected) in [
            ("a:/lab/arm/left/x", target(0, "arm", "left/x")),
            ("b:/lab/arm/left/x", target(1, "left", "x")),
            ("a:/lab/arm/other", target(0, "arm", "other")),
        ] {
            assert_eq!(found(&servers, &both, action), expected, "{action}");
        }
        let wrong = found(&servers, &both, "/lab/arm/left/x").expect_err("two match");
        assert_eq!(
            wrong,
            "not sent: '/lab/arm/left/x' may mean component 'left/x' of 'arm' of a:/lab, or component 'x' of 'left' \
             of b:/lab/arm: write NAME:SCOPE for the scope"
        );
        // Only one offers it.
        let one = [Some(ours.clone()), Some(offers(&[("right", &["x"])]))];
        assert_eq!(
            found(&servers, &one, "/lab/arm/left/x"),
            target(0, "arm", "left/x")
        );
        // What the other offers is not known.
        for other in [None, Some(Offers::new()), Some(offers(&[("left", &["*"])]))] {
            let known = [Some(ours.clone()), other];
            assert!(
                found(&servers, &known, "/lab/arm/left/x").is_err(),
                "{known:?}"
            );
        }
        for wrong in [
            "",
            "/",
            "/lab",
            "/lab/",
            "/lab/arm",
            "/lab//x",
            "/labs/arm/left",
            "a:/lab/x",
            "c:/lab/x/y",
        ] {
            assert!(found(&servers, &both, wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn a_handler_with_a_slash_is_found_if_it_is_offered() {
        let servers = servers(&[("a", "tcp://a:1", "/lab")]);
        let known = [Some(offers(&[("arm/left", &["x"])]))];
        let target = Ok((0, "arm/left".to_owned(), "x".to_owned()));
        assert_eq!(found(&servers, &known, "/lab/arm/left/x"), target);
        let known = [Some(offers(&[("arm/left", &["x"]), ("arm", &["left/x"])]))];
        assert!(found(&servers, &known, "/lab/arm/left/x").is_err());
    }

    #[test]
    fn scopes_that_two_servers_have_carry_the_name_of_the_robot() {
        let servers = servers(&[
            ("a", "tcp://a:1", "/robot"),
            ("b", "tcp://b:1", "/robot"),
            ("c", "tcp://a:1", "/lamp"),
            ("d", "tcp://a:1", "/lamp"),
        ]);
        let names: Vec<&str> = servers.iter().map(|server| server.name.as_str()).collect();
        assert_eq!(names, ["a, c, d", "b"]);
        let server = |action| found(&servers, &[], action).map(|(server, ..)| server);
        for (action, expected) in [
            ("a:/robot/arm/left", 0),
            ("b:/robot/arm/left", 1),
            ("/lamp/x/y", 0),
            ("d:/lamp/x/y", 0),
        ] {
            assert_eq!(server(action), Ok(expected), "{action}");
        }
        let wrong = server("/robot/arm/left").expect_err("ambiguous");
        assert!(
            wrong.contains("of a:/robot, or") && wrong.contains("of b:/robot:"),
            "{wrong}"
        );
        let wrong = server("/robots/arm/left").expect_err("no scope");
        assert!(wrong.ends_with("one of a:/robot /lamp b:/robot"), "{wrong}");
    }

    #[test]
    fn a_server_with_other_keys_is_another_one() {
        let robot = |name: &str, key: Option<&str>| Robot {
            name: name.to_owned(),
            endpoint: "tcp://a:1".to_owned(),
            scope: format!("/{name}"),
            keys: key.map(|key| KeyFiles {
                own: key.into(),
                server: "robot.key".into(),
            }),
            connect: Arc::new(|_| Err(String::new())),
        };
        let robots = [
            ("a", Some("x")),
            ("b", Some("y")),
            ("c", Some("x")),
            ("d", None),
        ];
        let servers = group(robots.map(|(name, key)| robot(name, key)).into());
        let names: Vec<&str> = servers.iter().map(|server| server.name.as_str()).collect();
        assert_eq!(names, ["a, c", "b", "d"]);
    }
}
