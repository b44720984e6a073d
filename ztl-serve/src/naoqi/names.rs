//! Whether the services, methods and signals of a file are there, and take its arguments: asked by `--check`, while the
//! robot runs.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use ztl_naoqi::{CallError, MetaObject};
use ztl_yaml::{Diagnostic, closest};

use super::arguments::Arguments;
use super::connection::Robot;

/// Where NAOqi listens on the robot itself.
const DIRECTORY: &str = "tcp://127.0.0.1:9559";

/// How long the robot may take to answer.
const WAIT: Duration = Duration::from_secs(5);

/// What is needed to read the components of NAOqi.
#[derive(Debug)]
pub(crate) struct Naoqi {
    pub(crate) robot: Arc<Robot>,
    /// Where the file names it, if it does.
    pub(crate) place: Option<Diagnostic>,
    /// What of the robot the file uses.
    pub(crate) used: Vec<Used>,
}

impl Default for Naoqi {
    fn default() -> Self {
        Self {
            robot: Robot::new(DIRECTORY.to_owned(), None),
            place: None,
            used: Vec::new(),
        }
    }
}

/// A method or signal that the file uses.
#[derive(Debug, Clone)]
pub(crate) struct Used {
    /// Where the file has it; its message is still to be written.
    pub(super) place: Diagnostic,
    pub(super) service: String,
    pub(super) what: What,
}

/// Which part of a service.
#[derive(Debug, Clone)]
pub(super) enum What {
    Method(String, Arguments),
    Signal(String),
    /// The service itself.
    Service,
}

/// Asks the robot for what the file uses. Returns what is not there or does not fit, or why nobody can tell.
pub(crate) fn missing(naoqi: &Naoqi) -> Vec<Diagnostic> {
    let Naoqi { robot, place, used } = naoqi;
    let Some(first) = used.first() else {
        return Vec::new();
    };
    // What is wrong with the connection, is not wrong with what uses it.
    let at = place.as_ref().unwrap_or(&first.place);
    let client = match robot.client() {
        Ok(client) => client,
        Err(error) => return vec![warning(at, error, None)],
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
                    return vec![warning(at, error.to_string(), Some(help))];
                }
                let known = known.iter().map(String::as_str);
                let help = closest(service, known).map(|it| format!("did you mean '{it}'?"));
                warnings.push(warning(&used.place, error.to_string(), help));
            }
        }
    }
    warnings
}

fn warning(place: &Diagnostic, message: String, help: Option<String>) -> Diagnostic {
    let mut warning = place.clone();
    warning.message = format!("warning: {message}");
    warning.help = help;
    warning
}

impl Used {
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
                    true if arguments.is_empty() => Some(format!(
                        "write arguments: […] beside it; as an abort: {{naoqi: {service}.{bare}, arguments: […]}}"
                    )),
                    true => None,
                    false => {
                        closest(bare, names()).map(|it| format!("did you mean '{service}.{it}'?"))
                    }
                };
                Some(warning(&self.place, mistake, help))
            }
            What::Signal(name) => {
                let members = meta.signals.iter().chain(&meta.properties);
                let names: Vec<&str> = members.map(|member| member.name.as_str()).collect();
                if names.contains(&name.as_str()) {
                    return None;
                }
                let help = closest(name, names.iter().copied());
                let help = help.map(|it| format!("did you mean '{service}.{it}'?"));
                let mistake = format!("{service} has no signal or property {name}");
                Some(warning(&self.place, mistake, help))
            }
        }
    }
}
