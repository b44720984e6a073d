//! `ztl task-client`: a task on a server, with the original's options and output (wire
//! specification 7.2).

use std::net::ToSocketAddrs;
use std::process::ExitCode;
use std::time::Duration;

use tracing::Level;
use ztl_std::{RemoteTask, State, Status, TaskId, TaskSpec, TriggerError};

use crate::reach::Identity;
use crate::terminal::line;
use crate::tool::{help, port, seconds};
use crate::{Done, log, signals};

#[derive(Debug, clap::Args)]
#[command(
    after_help = "With --exit-status: 0 completed, 1 refused, 3 failed, 4 aborted, 5 unknown."
)]
pub(crate) struct TaskClient {
    /// The hostname or IP of the server to execute the task
    #[arg(short, long)]
    remote: String,

    /// The port on the remote host that should execute the task
    #[arg(short, long, value_parser = port)]
    port: u16,

    /// The scope that the server is listening to
    #[arg(short, long)]
    scope: String,

    /// Seconds to wait for the task to end before it is aborted; 0 or less waits for ever
    #[arg(short, long, default_value_t = -1, allow_negative_numbers = true, value_parser = seconds)]
    timeout: i64,

    /// Tell the task's fate by the exit code (the original's is always 0)
    #[arg(long)]
    exit_status: bool,

    #[command(flatten)]
    identity: Identity,

    /// The task: handler, component and goal separated by ':', e.g. 'handler:component:goal'
    payload: String,
}

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

impl TaskClient {
    pub(crate) fn run(self, called: &str) -> Done {
        log::init(Level::INFO);
        signals::catch()?;
        let Ok(spec) = TaskSpec::split(&self.payload) else {
            line(
                "Error: Invalid task specification. Payload needs to specify handler, component and goal separated by ':', e.g. 'handler:component:goal'",
            );
            eprintln!("{}", help(called, "task-client"));
            return Ok(ExitCode::from(255));
        };
        let (host, port) = (&self.remote, self.port);
        line(format_args!(
            "Connecting to host '{host}:{port}' at scope '{}'...",
            self.scope
        ));
        let endpoint = format!("tcp://{host}:{port}");
        let mut remote = RemoteTask::connect(&endpoint, &self.scope)
            .map_err(|_| format!("'{host}' is no name or address of a host"))?;
        remote = self.identity.apply(remote)?;
        let fate = self.play(&mut remote, &spec);
        Ok(match (self.exit_status, signals::stopped()) {
            (true, _) => ExitCode::from(fate),
            // As a shell reports it.
            (false, true) => ExitCode::from(130),
            (false, false) => ExitCode::SUCCESS,
        })
    }

    /// What is wrong with the host's name, if it has no address.
    fn nameless(&self) -> String {
        match (self.remote.as_str(), self.port).to_socket_addrs() {
            Ok(_) => String::new(),
            Err(_) => format!("; no host '{}' is known", self.remote),
        }
    }

    fn play(&self, remote: &mut RemoteTask, spec: &TaskSpec<'_>) -> u8 {
        let mut request = vec![0; spec.encoded_len()];
        let encoded = spec.encode_into(&mut request).unwrap_or_default();
        line(format_args!("Triggering task with request '{encoded}'..."));
        let (id, reply) = match remote.trigger_payload(encoded) {
            Ok(task) => (task.id, task.reply),
            Err(error) => {
                let (id, reason, fate) = match error {
                    TriggerError::Refused { id, reason } => (id, reason, 1),
                    other => (-1, format!("{other}{}", self.nameless()), UNKNOWN),
                };
                line(format_args!(
                    "Task '{id}' could not be triggered: '{reason}'."
                ));
                return fate;
            }
        };
        let timeout = self.timeout;
        line(format_args!(
            "Initialised task with ID '{id}' for {timeout}s. Reply is '{reply}'."
        ));
        let limit = u64::try_from(timeout).ok().filter(|seconds| *seconds > 0);
        let limit = limit.map(Duration::from_secs);
        match remote.wait_with(id, limit, |_| !signals::stopped()) {
            Ok(Status { state, text }) => {
                line(format_args!(
                    "Task with ID '{id}' finished in state '{state}' while waiting. Result is '{text}'."
                ));
                fate(state)
            }
            Err(error) if error.last.is_err() && !signals::stopped() => {
                line(format_args!(
                    "Could not wait for task with ID '{id}'. Reply is '{error}'."
                ));
                UNKNOWN
            }
            Err(_) => abort(remote, id),
        }
    }
}

/// The limit was reached, or Ctrl-C was pressed.
fn abort(remote: &mut RemoteTask, id: TaskId) -> u8 {
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
            // As long as the original waits.
            let (name, text, fate) = match remote.wait(id, Some(Duration::from_secs(5))) {
                Ok(status) => (status.state.name(), status.text, fate(status.state)),
                Err(error) => match error.last {
                    Ok(status) => (status.state.name(), status.text, UNKNOWN),
                    Err(cause) => ("None", cause.to_string(), UNKNOWN),
                },
            };
            line(format_args!(
                "Task with ID '{id}' finished in state '{name}' after unsuccessful abort signal. Reply is '{text}'."
            ));
            fate
        }
    }
}
