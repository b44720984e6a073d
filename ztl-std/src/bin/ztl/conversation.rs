//! What the original's three clients do and say: ask for a task, wait for it, abort it when the
//! time is over (wire specification 7.2, 7.3, 7.5). Each says it in words of its own.

use std::net::ToSocketAddrs;
use std::process::ExitCode;
use std::time::Duration;

use ztl_std::{RemoteTask, State, Status, TaskId, TriggerError};

use crate::terminal::{is_live, line, part, rewrite};
use crate::{Done, signals};

/// What is said at the end of a client's help.
pub(crate) const FATES: &str =
    "With --exit-status: 0 completed, 1 refused, 3 failed, 4 aborted, 5 unknown.";

/// As long as the original waits after an abort that was refused.
const AFTER_ABORT: Duration = Duration::from_secs(5);

/// The exit code for a task whose end is not known.
const UNKNOWN: u8 = 5;

/// How it ended, as an exit code.
fn fate(state: State) -> u8 {
    match state {
        State::Completed => 0,
        State::Rejected => 1,
        State::Failed => 3,
        State::Aborted => 4,
        State::Initiated | State::Accepted => UNKNOWN,
    }
}

/// In whose words.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Words {
    /// `task-client`'s; with the seconds that it waits, as they were given.
    TaskClient(i64),
    /// `remote-task`'s; the same.
    RemoteTask(i64),
    /// `simple-client`'s, which waits for 5 s.
    Simple,
}

impl Words {
    /// How long is waited, for ever if this is `None`.
    fn limit(self) -> Option<Duration> {
        let seconds = match self {
            Self::TaskClient(seconds) | Self::RemoteTask(seconds) => seconds,
            Self::Simple => 5,
        };
        let seconds = u64::try_from(seconds).ok().filter(|seconds| *seconds > 0);
        seconds.map(Duration::from_secs)
    }
}

/// A task to be asked for.
pub(crate) struct Conversation<'a> {
    pub(crate) host: &'a str,
    pub(crate) port: u16,
    /// The payload of the INIT.
    pub(crate) request: &'a str,
    pub(crate) words: Words,
    /// Whether the exit code is to tell the task's fate.
    pub(crate) exit_status: bool,
}

/// A client for a host that a person has named.
pub(crate) fn connect(
    host: &str,
    port: u16,
    scope: &str,
) -> Result<RemoteTask, Box<dyn std::error::Error>> {
    let remote = RemoteTask::connect(&format!("tcp://{host}:{port}"), scope);
    Ok(remote.map_err(|_| format!("'{host}' is no name or address of a host"))?)
}

impl Conversation<'_> {
    pub(crate) fn run(&self, remote: &mut RemoteTask) -> Done {
        let fate = self.play(remote);
        Ok(match (self.exit_status, signals::stopped()) {
            (true, _) => ExitCode::from(fate),
            // As a shell reports it.
            (false, true) => ExitCode::from(130),
            (false, false) => ExitCode::SUCCESS,
        })
    }

    fn play(&self, remote: &mut RemoteTask) -> u8 {
        let request = self.request;
        line(format_args!("Triggering task with request '{request}'..."));
        let (id, reply) = match remote.trigger_payload(request) {
            Ok(task) => (task.id, task.reply),
            Err(error) => return self.not_triggered(error),
        };
        match self.words {
            Words::TaskClient(seconds) | Words::RemoteTask(seconds) => line(format_args!(
                "Initialised task with ID '{id}' for {seconds}s. Reply is '{reply}'."
            )),
            Words::Simple => {
                line(format_args!(
                    "Initialised task with ID '{id}'. Reply is '{reply}'."
                ));
                line("Waiting maximum 5s for the task to finish...");
            }
        }
        let live = is_live();
        let ended = remote.wait_with(id, self.words.limit(), |answer| {
            if let (true, Ok(Status { state, text })) = (live, answer) {
                rewrite(&format!("{state}: {}", shown(text)), "");
            }
            !signals::stopped()
        });
        if live {
            // The line of the progress makes room.
            part("\r\x1b[K");
        }
        match ended {
            Ok(Status { state, text }) => {
                line(format_args!(
                    "Task with ID '{id}' finished{} while waiting. Result is '{text}'.",
                    self.in_state(state.name())
                ));
                fate(state)
            }
            Err(error) if error.last.is_err() && !signals::stopped() => {
                line(format_args!(
                    "Could not wait for task with ID '{id}'. Reply is '{error}'."
                ));
                UNKNOWN
            }
            Err(_) => self.abort(remote, id),
        }
    }

    fn not_triggered(&self, error: TriggerError) -> u8 {
        let (id, reason, fate) = match error {
            TriggerError::Refused { id, reason } => (id, reason, 1),
            other => (-1, format!("{other}{}", self.nameless()), UNKNOWN),
        };
        let which = match self.words {
            Words::TaskClient(_) => format!(" '{id}'"),
            Words::RemoteTask(_) => String::new(),
            Words::Simple => format!(" '{}'", self.request),
        };
        line(format_args!(
            "Task{which} could not be triggered: '{reason}'."
        ));
        fate
    }

    /// What is wrong with the host's name, if it has no address.
    fn nameless(&self) -> String {
        match (self.host, self.port).to_socket_addrs() {
            Ok(_) => String::new(),
            Err(_) => format!("; no host '{}' is known", self.host),
        }
    }

    /// The state, where these words tell it.
    fn in_state(&self, name: &str) -> String {
        match self.words {
            Words::TaskClient(_) | Words::RemoteTask(_) => format!(" in state '{name}'"),
            Words::Simple => String::new(),
        }
    }

    /// The limit was reached, or Ctrl-C was pressed.
    fn abort(&self, remote: &mut RemoteTask, id: TaskId) -> u8 {
        line(format_args!("Aborting task with ID '{id}'..."));
        let aborted = remote.abort(id);
        let reply = match &aborted {
            Ok(status) => status.text.clone(),
            Err(error) => error.to_string(),
        };
        match aborted.as_ref().map(|status| status.state) {
            Ok(State::Aborted) => {
                line(format_args!(
                    "Task with ID '{id}' aborted. Reply is '{reply}'."
                ));
                fate(State::Aborted)
            }
            Ok(state) if state.is_final() => fate(state),
            _ => {
                line(format_args!(
                    "Could not abort Task with ID '{id}', waiting for completion. Reply is '{reply}'."
                ));
                let (name, text, fate) = match remote.wait(id, Some(AFTER_ABORT)) {
                    Ok(status) => (status.state.name(), status.text, fate(status.state)),
                    Err(error) => match error.last {
                        Ok(status) => (status.state.name(), status.text, UNKNOWN),
                        Err(cause) => ("None", cause.to_string(), UNKNOWN),
                    },
                };
                let text = match self.words {
                    Words::TaskClient(_) | Words::RemoteTask(_) => text,
                    // The original's says once more what the abort was answered.
                    Words::Simple => reply,
                };
                line(format_args!(
                    "Task with ID '{id}' finished{} after unsuccessful abort signal. Reply is '{text}'.",
                    self.in_state(name)
                ));
                fate
            }
        }
    }
}

/// A progress as one line of a terminal.
fn shown(text: &str) -> String {
    text.replace(char::is_control, " ")
}
