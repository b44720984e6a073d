//! Tasks that another server does: a relay across networks. The other server may be ours or the original's.
//!
//! What is not known of a task is never told as its end: while the other server does not answer, the task
//! goes on. Only when nothing can ever be learned it is FAILED, with a reason that begins `unknown:`.

use std::error::Error;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use ztl_core::State;
use ztl_core::dispatcher::UNKNOWN_END;

use super::run::{End, time};
use super::template::Call;
use ztl_std::keys::{KeyError, KeyPair, PublicKey, can_encrypt};
use ztl_std::server::KEEP;
use ztl_std::{RemoteTask, RequestError, Status, TriggerError};

/// Where tasks are sent.
#[derive(Debug, Clone)]
pub(super) struct Forward {
    /// A ZeroMQ endpoint.
    pub(super) to: String,
    pub(super) scope: String,
    /// What the handler and the component are called there, if not as here.
    pub(super) handler: Option<String>,
    pub(super) component: Option<String>,
    /// One's own secret key and the server's public one.
    pub(super) keys: Option<(PathBuf, PathBuf)>,
}

/// What is heard of a task on its way.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Told {
    Accepted,
    Progress(String),
    AbortRefused,
    End(End),
}

impl Forward {
    /// A client of the server, or why there can be none.
    fn remote(&self, context: zmq::Context) -> Result<RemoteTask, Box<dyn Error>> {
        let remote = RemoteTask::connect_in(context, &self.to, &self.scope)?;
        let Some((own, server)) = &self.keys else {
            return Ok(remote);
        };
        if !can_encrypt() {
            return Err(KeyError::NoCurve.into());
        }
        Ok(remote.with_keys(KeyPair::read(own)?, PublicKey::read(server)?)?)
    }

    /// Has a task done there, and says how it ended. `abort` may be set at any time.
    pub(super) fn run(
        &self,
        context: zmq::Context,
        call: &Call,
        abort: &AtomicBool,
        tell: impl Fn(Told),
    ) -> End {
        let to = &self.to;
        let mut remote = match self.remote(context) {
            Ok(remote) => remote,
            Err(error) => return End::Rejected(format!("{to}: {error}")),
        };
        let handler = self.handler.as_deref().unwrap_or(&call.handler);
        let component = self.component.as_deref().unwrap_or(&call.component);
        let id = match remote.trigger(handler, component, &call.goal.text) {
            Ok(task) => task.id,
            Err(TriggerError::Refused { reason, .. }) => return End::Rejected(reason),
            // It is wanted until an answer says what became of it.
            Err(TriggerError::NeverCame | TriggerError::GivenUp) => {
                return End::Rejected(format!("{to} did not get it, and will not start it"));
            }
            Err(TriggerError::Request(error)) => {
                if error.nothing_was_sent() {
                    return End::Rejected(TriggerError::Request(error).to_string());
                }
                tell(Told::Accepted);
                return End::Failed(format!("{UNKNOWN_END}whether it was started: {error}"));
            }
        };
        tell(Told::Accepted);
        let mut said = String::new();
        // Since when it has not answered.
        let mut silent: Option<Instant> = None;
        let mut asked_to_abort = false;
        loop {
            let mut seen = |answer: &Result<Status, RequestError>| {
                let text = match answer {
                    Ok(status) => {
                        silent = None;
                        status.text.clone()
                    }
                    Err(error) => {
                        silent.get_or_insert_with(Instant::now);
                        format!("{UNKNOWN_END}{error}")
                    }
                };
                if text != said && text != "None" {
                    said.clone_from(&text);
                    tell(Told::Progress(text));
                }
                let given_up = silent.is_some_and(|since| since.elapsed() >= KEEP);
                let to_abort = abort.load(Ordering::Relaxed) && !asked_to_abort;
                !given_up && !to_abort
            };
            match remote.wait_with(&id, None, &mut seen) {
                Ok(status) => return end(status),
                Err(wait) => match wait.last {
                    // It may tell more when it is asked again.
                    Err(RequestError::NotTold { .. }) => std::thread::sleep(PAUSE),
                    Err(error) if error.was_answered() => {
                        return End::Failed(format!("{UNKNOWN_END}{to}: {error}"));
                    }
                    _ => {}
                },
            }
            if silent.is_some_and(|since| since.elapsed() >= KEEP) {
                // It would have forgotten by now how the task ended.
                let kept = time(KEEP);
                return End::Failed(format!("{UNKNOWN_END}no answer from {to} for {kept}"));
            }
            if asked_to_abort || !abort.load(Ordering::Relaxed) {
                continue;
            }
            match remote.abort(&id) {
                Ok(status) if status.state.is_final() => return end(status),
                Ok(status) if status.text == "False" => {
                    abort.store(false, Ordering::Relaxed);
                    tell(Told::AbortRefused);
                }
                Ok(_) => asked_to_abort = true,
                // A STATUS says how it ends.
                Err(RequestError::UnknownTask { .. }) => asked_to_abort = true,
                // Asked again: an abort must reach the task.
                Err(_) => std::thread::sleep(PAUSE),
            }
        }
    }
}

/// Pause between two tries to reach a server.
const PAUSE: Duration = Duration::from_millis(100);

/// How it ended there is how it ends here.
fn end(status: Status) -> End {
    let text = status.text;
    match status.state {
        State::Completed => End::Completed(text),
        State::Aborted => End::Aborted(text),
        State::Rejected => End::Failed(format!("refused there: {text}")),
        _ => End::Failed(text),
    }
}
