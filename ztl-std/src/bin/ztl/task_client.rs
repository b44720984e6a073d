//! `ztl task-client`: a task on a server, with the original's options and output (wire
//! specification 7.2).

use tracing::Level;

use crate::conversation::{AFTER_HELP, Conversation, Target, Telling, Words};
use crate::reach::Identity;
use crate::tool::{port, seconds, specification};
use crate::{Done, log, signals};

#[derive(Debug, clap::Args)]
#[command(after_help = AFTER_HELP)]
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

    #[command(flatten)]
    telling: Telling,

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
        let conversation = Conversation {
            target: Target {
                host: &self.remote,
                port: self.port,
                scope: &self.scope,
            },
            request: &request,
            words: Words::TaskClient(self.timeout),
            telling: &self.telling,
        };
        conversation.run(|remote| self.identity.apply(remote))
    }
}
