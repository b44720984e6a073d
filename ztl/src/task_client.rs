//! `ztl task-client`: a task on a server, with the original's options and output (wire
//! specification 7.2).

use tracing::Level;

use crate::address::Address;
use crate::conversation::{AFTER_HELP, Conversation, Target, Telling, Words};
use crate::exit::{Done, Misuse};
use crate::reach::Identity;
use crate::tool::{Called, seconds, specification};
use crate::{log, signals};

#[derive(Debug, clap::Args)]
#[command(after_help = AFTER_HELP)]
pub(crate) struct TaskClient {
    #[command(flatten)]
    address: Address,

    /// The scope that the server is listening to [default: the configuration file's, else $ZTL_SCOPE]
    #[arg(short, long)]
    scope: Option<String>,

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
    pub(crate) fn run(self, called: &Called) -> Done {
        log::init(Level::INFO);
        signals::catch()?;
        let request = match specification(&self.payload, called, "task-client") {
            Ok(request) => request,
            Err(code) => return Ok(code),
        };
        let place = self.address.place()?;
        let scope = place.scope(self.scope.as_ref())?.ok_or_else(|| {
            let how = "give --scope, or --remote NAME for a server in the configuration file, or set ZTL_SCOPE";
            Misuse(format!("no scope: {how}"))
        })?;
        let conversation = Conversation {
            target: Target {
                host: &place.host,
                port: place.port,
                scope: &scope,
            },
            request: &request,
            words: Words::TaskClient(self.timeout),
            as_original: called.is_original(),
            telling: &self.telling,
        };
        conversation.run(|remote| self.identity.apply(remote))
    }
}
