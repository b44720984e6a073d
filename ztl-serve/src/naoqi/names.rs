//! Whether the services, methods and signals of a file are there, and take its arguments: asked by `--check`, while the
//! robot runs.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use ztl_naoqi::{CallError, MetaObject};
use ztl_yaml::{Diagnostic, Node, closest};

use super::arguments::Arguments;
use super::connection::Robot;
use crate::reader::ConfigReader;

/// How long the robot may take to answer.
const WAIT: Duration = Duration::from_secs(5);

/// A method or signal that the file uses.
#[derive(Debug, Clone)]
pub(crate) struct Used {
    /// Where the file has it; its message is still to be written.
    place: Diagnostic,
    service: String,
    what: What,
}

/// Which part of a service.
#[derive(Debug, Clone)]
pub(super) enum What {
    Method(String, Arguments),
    Signal(String),
    /// The service itself.
    Service,
}

impl<'d> ConfigReader<'d> {
    /// Notes what the file uses.
    pub(super) fn naoqi_uses(&mut self, node: &'d Node, service: &str, what: What) {
        self.naoqi.used.push(Used {
            place: self.yaml.mistake(node, ""),
            service: service.to_owned(),
            what,
        });
    }
}

/// Asks the robot for what the file uses. Returns what is not there or does not fit, or why nobody can tell.
pub(crate) fn missing(robot: &Arc<Robot>, used: &[Used]) -> Vec<Diagnostic> {
    let Some(first) = used.first() else {
        return Vec::new();
    };
    let client = match robot.client() {
        Ok(client) => client,
        Err(error) => return vec![first.warning(error, None)],
    };
    let mut services: BTreeMap<&str, Result<Arc<MetaObject>, CallError>> = BTreeMap::new();
    let mut warnings = Vec::new();
    for used in used {
        let service = used.service.as_str();
        let about = services
            .entry(service)
            .or_insert_with(|| client.describe(service, WAIT));
        match about {
            Ok(meta) => warnings.extend(used.mistake(meta)),
            Err(error) => {
                let known = client.services();
                if known.is_empty() {
                    // Not connected: so are all others.
                    let help = "start the robot to have its methods checked, too".to_owned();
                    return vec![used.warning(error.to_string(), Some(help))];
                }
                let known = known.iter().map(String::as_str);
                let help = closest(service, known).map(|it| format!("did you mean '{it}'?"));
                warnings.push(used.warning(error.to_string(), help));
            }
        }
    }
    warnings
}

impl Used {
    fn warning(&self, message: String, help: Option<String>) -> Diagnostic {
        let mut warning = self.place.clone();
        warning.message = format!("warning: {message}");
        warning.help = help;
        warning
    }

    /// What is wrong with it.
    fn mistake(&self, meta: &MetaObject) -> Option<Diagnostic> {
        let service = &self.service;
        match &self.what {
            What::Service => None,
            What::Method(method, arguments) => {
                let mistake = arguments.check(meta, service, method).err()?;
                let bare = method
                    .split_once("::")
                    .map_or(method.as_str(), |(name, _)| name);
                let names = || meta.methods.iter().map(|method| method.name.as_str());
                let help = match names().any(|name| name == bare) {
                    true => None,
                    false => {
                        closest(bare, names()).map(|it| format!("did you mean '{service}.{it}'?"))
                    }
                };
                Some(self.warning(mistake, help))
            }
            What::Signal(name) => {
                let members = meta.signals.iter().chain(&meta.properties);
                let names: Vec<&str> = members.map(|member| member.name.as_str()).collect();
                if names.contains(&name.as_str()) {
                    return None;
                }
                let help = closest(name, names.iter().copied());
                let help = help.map(|it| format!("did you mean '{service}.{it}'?"));
                Some(self.warning(format!("{service} has no signal or property {name}"), help))
            }
        }
    }
}
