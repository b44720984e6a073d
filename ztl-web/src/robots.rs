//! The robots of the configuration, grouped by server, and the names of their actions.

use std::sync::Arc;

use ztl_std::RemoteTask;

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
    /// Connects to any scope of its server.
    pub connect: Connect,
}

/// A server, which several names of the configuration may share.
pub(crate) struct Server {
    /// The names, joined.
    pub(crate) name: String,
    pub(crate) endpoint: String,
    pub(crate) scopes: Vec<ConfiguredScope>,
    pub(crate) connect: Connect,
}

pub(crate) struct ConfiguredScope {
    pub(crate) scope: String,
    /// What the names of its actions begin with: the scope; `NAME:SCOPE` if another server has the same one.
    pub(crate) prefix: String,
}

/// A component that an action names.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct Target {
    /// Index of the server.
    pub(crate) server: usize,
    pub(crate) scope: String,
    pub(crate) handler: String,
    pub(crate) component: String,
}

/// Groups robots by their server.
pub(crate) fn group(robots: Vec<Robot>) -> Vec<Server> {
    let places: Vec<(String, String)> = robots
        .iter()
        .map(|robot| (robot.endpoint.clone(), robot.scope.clone()))
        .collect();
    let mut servers: Vec<Server> = Vec::new();
    for robot in robots {
        let elsewhere = places
            .iter()
            .any(|(endpoint, scope)| *scope == robot.scope && *endpoint != robot.endpoint);
        let prefix = match elsewhere {
            true => format!("{}:{}", robot.name, robot.scope),
            false => robot.scope.clone(),
        };
        let scope = ConfiguredScope {
            scope: robot.scope,
            prefix,
        };
        let known = servers
            .iter_mut()
            .find(|server| server.endpoint == robot.endpoint);
        match known {
            Some(server) => {
                server.name = format!("{}, {}", server.name, robot.name);
                if !server.scopes.iter().any(|known| known.scope == scope.scope) {
                    server.scopes.push(scope);
                }
            }
            None => servers.push(Server {
                name: robot.name,
                endpoint: robot.endpoint,
                scopes: vec![scope],
                connect: robot.connect,
            }),
        }
    }
    servers
}

/// The component that an action `SCOPE/handler/component` names.
///
/// # Errors
/// What is wrong with the name.
pub(crate) fn find(servers: &[Server], action: &str) -> Result<Target, String> {
    let mut found: Option<(usize, Target)> = None;
    for (index, server) in servers.iter().enumerate() {
        for scope in &server.scopes {
            let rest = action.strip_prefix(&scope.prefix);
            let rest = rest.and_then(|rest| rest.strip_prefix('/'));
            let Some((handler, component)) = rest.and_then(|rest| rest.split_once('/')) else {
                continue;
            };
            // The longest prefix: a scope `/lab/arm` goes before `/lab`.
            let length = scope.prefix.len();
            if !handler.is_empty() && found.as_ref().is_none_or(|(known, _)| *known < length) {
                let target = Target {
                    server: index,
                    scope: scope.scope.clone(),
                    handler: handler.to_owned(),
                    component: component.to_owned(),
                };
                found = Some((length, target));
            }
        }
    }
    found.map(|(_, target)| target).ok_or_else(|| {
        let prefixes = servers.iter().flat_map(|server| &server.scopes);
        let prefixes: Vec<&str> = prefixes.map(|scope| scope.prefix.as_str()).collect();
        format!(
            "no action '{action}': expected SCOPE/handler/component, where SCOPE is one of {}",
            prefixes.join(" ")
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn servers(robots: &[(&str, &str, &str)]) -> Vec<Server> {
        let robot = |(name, endpoint, scope): &(&str, &str, &str)| Robot {
            name: (*name).to_owned(),
            endpoint: (*endpoint).to_owned(),
            scope: (*scope).to_owned(),
            connect: Arc::new(|_| Err(String::new())),
        };
        group(robots.iter().map(robot).collect())
    }

    #[test]
    fn an_action_names_a_component_of_the_longest_scope() {
        let servers = servers(&[("a", "tcp://a:1", "/lab"), ("b", "tcp://b:1", "/lab/arm")]);
        let target = find(&servers, "/lab/arm/left/grip/per").expect("a target");
        assert_eq!((target.server, target.scope.as_str()), (1, "/lab/arm"));
        assert_eq!(
            (target.handler.as_str(), target.component.as_str()),
            ("left", "grip/per")
        );
        let target = find(&servers, "/lab/arm/left").expect("a target");
        assert_eq!((target.server, target.handler.as_str()), (0, "arm"));
        for wrong in [
            "",
            "/",
            "/lab",
            "/lab/",
            "/lab/arm",
            "/lab//x",
            "/labs/arm/left",
        ] {
            assert!(find(&servers, wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn scopes_that_two_servers_have_carry_the_name_of_the_robot() {
        let servers = servers(&[
            ("a", "tcp://a:1", "/robot"),
            ("b", "tcp://b:1", "/robot"),
            ("c", "tcp://a:1", "/lamp"),
        ]);
        assert_eq!(servers.len(), 2);
        assert_eq!(
            servers.first().map(|server| server.name.as_str()),
            Some("a, c")
        );
        assert_eq!(
            find(&servers, "b:/robot/arm/left").map(|target| target.server),
            Ok(1)
        );
        assert_eq!(
            find(&servers, "/lamp/x/y").map(|target| target.server),
            Ok(0)
        );
        let wrong = find(&servers, "/robot/arm/left").expect_err("ambiguous");
        assert!(wrong.ends_with("one of a:/robot /lamp b:/robot"), "{wrong}");
    }
}
