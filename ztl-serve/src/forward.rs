//! Forwards tasks to another server, ours or the original's.
//!
//! While the other server does not answer, the task continues. It fails, with a reason that begins with `unknown:`,
//! only when its outcome can never be learned.

use std::error::Error;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use ztl_core::State;
use ztl_core::dispatcher::{NOTHING_KNOWN, UNKNOWN_OUTCOME};
use ztl_std::keys::KeyFiles;
use ztl_std::server::KEEP;
use ztl_std::{RemoteTask, RequestError, Status, TriggerError, scope};
use ztl_yaml::{Fields, Node};

use crate::call::Call;
use crate::human::human_time;
use crate::kind::{Effect, JobContext, Kind, Outcome, Services, Start};
use crate::reader::{ComponentContext, ConfigReader};
use crate::thread_job;

/// Pause between two attempts to reach a server.
const PAUSE: Duration = Duration::from_millis(100);

/// Where tasks are sent.
#[derive(Debug, Clone)]
pub(crate) struct Forward {
    /// A ZeroMQ endpoint.
    pub(crate) to: String,
    pub(crate) scope: String,
    /// The handler's name there, if it differs.
    pub(crate) handler: Option<String>,
    pub(crate) component: Option<String>,
    pub(crate) keys: Option<KeyFiles>,
}

/// Reads where tasks are sent.
pub(crate) fn read<'d>(
    reader: &mut ConfigReader<'d>,
    node: &'d Node,
    _: Option<&mut Fields<'d>>,
    _: ComponentContext<'_>,
) -> Option<Arc<dyn Kind>> {
    let mut fields = reader.yaml.fields(node, "to: tcp://HOST:PORT, scope")?;
    let to = fields.required("to", "to: tcp://10.0.0.7:12345");
    let to = to.and_then(|node| {
        let what = "an address, as tcp://10.0.0.7:12345";
        reader.yaml.parsed(node, what, |text| {
            let port = text
                .strip_prefix("tcp://")
                .and_then(|rest| rest.rsplit_once(':'));
            let port = port.filter(|(host, _)| !host.is_empty());
            match port.map(|(_, port)| port.parse::<u16>()) {
                Some(Ok(1..)) => Ok(text.to_owned()),
                _ => Err(format!("'{text}' is not {what}")),
            }
        })
    });
    let scope = fields.required("scope", "scope: /cob");
    let scope = scope.and_then(|node| {
        let what = "a scope, as /cob";
        reader.yaml.parsed(node, what, |text| {
            scope::cannot_be_asked(text).map_or_else(|| Ok(text.to_owned()), Err)
        })
    });
    let handler = fields.optional("handler");
    let handler = handler.and_then(|node| reader.name(node, "a handler"));
    let component = fields.optional("component");
    let component = component.and_then(|node| reader.name(node, "a component"));
    let at = fields.optional("key");
    let keys = KeyFiles::take(&mut reader.yaml, &mut fields, reader.base);
    fields.finish(&mut reader.yaml);
    if let (Some(node), Some(keys)) = (at, &keys) {
        match keys.read() {
            Ok(_) => reader.warn_if_exposed(node, &keys.own),
            Err(mistake) => reader.warn(node, format!("its tasks will be rejected: {mistake}")),
        }
    }
    Some(Arc::new(Forward {
        to: to?,
        scope: scope?,
        handler,
        component,
        keys,
    }))
}

impl Kind for Forward {
    fn start(self: Arc<Self>, call: Arc<Call>, task: JobContext, _: &Services) -> Start {
        thread_job::start(task, move |task, abort| self.run(&call, task, abort))
    }
}

impl Forward {
    /// Connects to the server.
    pub(crate) fn connect(&self) -> Result<RemoteTask, Box<dyn Error>> {
        let remote = RemoteTask::connect(&self.to, &self.scope)?;
        let Some(keys) = &self.keys else {
            return Ok(remote);
        };
        let (own, server) = keys.read()?;
        Ok(remote.with_keys(own, server)?)
    }

    /// Whether both send tasks to the same scope of the same server, as the same client.
    pub(crate) fn is_same_scope(&self, other: &Self) -> bool {
        self.to == other.to && self.scope == other.scope && self.keys == other.keys
    }

    /// Runs a task there. `abort` may be set at any time.
    fn run(&self, call: &Call, task: &JobContext, abort: &AtomicBool) -> Outcome {
        let to = &self.to;
        let mut remote = match self.connect() {
            Ok(remote) => remote,
            Err(error) => return Outcome::Rejected(format!("{to}: {error}")),
        };
        let handler = self.handler.as_deref().unwrap_or(&call.handler);
        let component = self.component.as_deref().unwrap_or(&call.component);
        let id = match remote.trigger(handler, component, &call.goal.text) {
            Ok(started) => started.id,
            Err(TriggerError::Rejected { reason, .. }) => return Outcome::Rejected(reason),
            Err(TriggerError::NeverCame | TriggerError::GivenUp) => {
                return Outcome::Rejected(format!("{to} did not get it, and will not start it"));
            }
            Err(TriggerError::Request(error)) => {
                if error.nothing_was_sent() {
                    return Outcome::Rejected(TriggerError::Request(error).to_string());
                }
                task.effect(Effect::Accept);
                return Outcome::Unknown(format!("whether it was started: {error}"));
            }
        };
        task.effect(Effect::Accept);
        let mut reported = String::new();
        // Since when the server has not answered.
        let mut silent: Option<Instant> = None;
        let mut abort_sent = false;
        loop {
            let mut seen = |answer: &Result<Status, RequestError>| {
                let text = match answer {
                    Ok(status) => {
                        silent = None;
                        status.text.clone()
                    }
                    Err(error) => {
                        silent.get_or_insert_with(Instant::now);
                        format!("{UNKNOWN_OUTCOME}{error}")
                    }
                };
                if text != reported && text != NOTHING_KNOWN {
                    reported.clone_from(&text);
                    task.effect(Effect::Progress(text));
                }
                let given_up = silent.is_some_and(|since| since.elapsed() >= KEEP);
                let to_abort = abort.load(Ordering::Relaxed) && !abort_sent;
                !given_up && !to_abort
            };
            match remote.wait_with(&id, None, &mut seen) {
                Ok(status) => return outcome(status),
                Err(wait) => match wait.last {
                    // The next answer may say more.
                    Err(RequestError::NotTold { .. }) => std::thread::sleep(PAUSE),
                    Err(error) if error.was_answered() => {
                        return Outcome::Unknown(format!("{to}: {error}"));
                    }
                    _ => {}
                },
            }
            if silent.is_some_and(|since| since.elapsed() >= KEEP) {
                // Servers forget outcomes after this time.
                let kept = human_time(KEEP);
                return Outcome::Unknown(format!("no answer from {to} for {kept}"));
            }
            if abort_sent || !abort.load(Ordering::Relaxed) {
                continue;
            }
            match remote.abort(&id) {
                Ok(status) if status.state.is_final() => return outcome(status),
                Ok(status) if status.is_abort_rejected() => {
                    abort.store(false, Ordering::Relaxed);
                    let reason = format!("{to} has rejected it");
                    task.effect(Effect::RejectAbort(reason));
                }
                Ok(_) => abort_sent = true,
                // The next status says how it ended.
                Err(RequestError::UnknownTask { .. }) => abort_sent = true,
                // Try again: an abort must reach the task.
                Err(_) => std::thread::sleep(PAUSE),
            }
        }
    }
}

/// The outcome here of one there.
fn outcome(status: Status) -> Outcome {
    let text = status.text;
    match status.state {
        State::Completed => Outcome::Completed(text),
        State::Aborted => Outcome::Aborted(text),
        State::Rejected => Outcome::Failed(format!("rejected there: {text}")),
        _ => Outcome::Failed(text),
    }
}
