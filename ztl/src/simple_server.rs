//! `ztl simple-server`: the original's simplest server. The payload of an INIT is the number
//! of seconds that the task takes.

use std::collections::HashMap;
use std::process::ExitCode;
use std::sync::mpsc::{RecvTimeoutError, Sender, channel};
use std::time::{Duration, Instant};

use tracing::{Level, error};
use ztl_core::Request;
use ztl_std::server::{TaskHandler, TaskReporter};
use ztl_std::{Limits, TaskId, TaskRequest, TaskServer};

use crate::exit::Done;
use crate::listen_options::LimitOptions;
use crate::option_values::{no_number, port, scope_to_serve, seconds};
use crate::terminal::line;
use crate::{log, signals};

#[derive(Debug, clap::Args)]
pub(crate) struct SimpleServer {
    /// The port on the local machine that the server should listen to
    #[arg(value_parser = port)]
    port: u16,

    /// The scope that the server should respond to
    #[arg(value_parser = scope_to_serve)]
    scope: String,

    #[command(flatten)]
    limits: LimitOptions,
}

impl SimpleServer {
    pub(crate) fn run(self) -> Done {
        log::init(Level::INFO);
        signals::catch()?;
        // All interfaces, as the original.
        let mut server = TaskServer::builder()
            .limits(self.limits.over(Limits::default()))
            .bind(&format!("tcp://*:{}", self.port))?;
        server.register_handler(&self.scope, Naps::default());
        server.observe_requests(|request, id, payload| {
            let what = match request {
                Request::Abort => "Aborting",
                Request::Init | Request::Status => "Status",
            };
            line(format_args!("{what} Task ID '{id}' ({payload})..."));
        });
        let stopper = server.handle();
        signals::then(move || stopper.stop());
        server.listen()?;
        error!(target: "root", "Interrupted, exiting.");
        Ok(signals::exit_code_or(ExitCode::FAILURE))
    }
}

/// How often the original's task checks the clock.
const LOOK: Duration = Duration::from_millis(100);

/// Tasks that do nothing for a while.
#[derive(Default)]
struct Naps {
    /// Dropping the sender aborts the task.
    running: HashMap<TaskId, Sender<()>>,
}

impl TaskHandler for Naps {
    fn start(&mut self, task: TaskReporter, request: TaskRequest) {
        task.threw(no_number(&request.spec().to_string()));
    }

    fn start_payload(&mut self, task: TaskReporter, payload: &str) {
        let id = task.id();
        line(format_args!("Initialising Task ID '{id}' ({payload})..."));
        let Ok(seconds) = seconds(payload) else {
            return task.threw(no_number(payload));
        };
        // Forget ended tasks.
        self.running.retain(|_, waking| waking.send(()).is_ok());
        let (waking, woken) = channel();
        self.running.insert(id, waking);
        // Without a thread, dropping the reporter rejects the task.
        let _ = std::thread::Builder::new().spawn(move || {
            // Until the task completes, its progress is the name of the state.
            task.progress("ACCEPTED");
            task.accepted(format!(
                "Initiated task '{id}' to be active for {seconds} seconds"
            ));
            let start = Instant::now();
            let time = Duration::from_secs(u64::try_from(seconds).unwrap_or(0));
            while start.elapsed() < time {
                if woken.recv_timeout(LOOK) == Err(RecvTimeoutError::Disconnected) {
                    line("Task aborted successfully.");
                    return task.aborted("ABORTED");
                }
            }
            task.completed("True");
        });
    }

    fn abort(&mut self, id: TaskId) {
        self.running.remove(&id);
    }

    fn names_unknown_ids(&self) -> bool {
        false
    }
}
