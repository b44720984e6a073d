//! `ztl task-client`: a task on a server, with the original's options and output (wire
//! specification 7.2).

use tracing::Level;

use crate::conversation::{Conversation, FATES, Words, connect};
use crate::reach::Identity;
use crate::terminal::line;
use crate::tool::{port, seconds, specification};
use crate::{Done, log, signals};

#[derive(Debug, clap::Args)]
#[command(after_help = FATES)]
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

impl TaskClient {
    pub(crate) fn run(self, called: &str) -> Done {
        log::init(Level::INFO);
        signals::catch()?;
        let request = match specification(&self.payload, called, "task-client") {
            Ok(request) => request,
            Err(code) => return Ok(code),
        };
        let (host, port) = (self.remote.as_str(), self.port);
        line(format_args!(
            "Connecting to host '{host}:{port}' at scope '{}'...",
            self.scope
        ));
        let mut remote = self.identity.apply(connect(host, port, &self.scope)?)?;
        let conversation = Conversation {
            host,
            port,
            request: &request,
            words: Words::TaskClient(self.timeout),
            exit_status: self.exit_status,
        };
        conversation.run(&mut remote)
    }
}
