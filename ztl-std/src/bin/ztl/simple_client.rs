//! `ztl simple-client`: a task with any payload, with the original's arguments and output (wire
//! specification 7.5).

use tracing::Level;

use crate::conversation::{Conversation, FATES, Words, connect};
use crate::reach::Identity;
use crate::terminal::line;
use crate::tool::port;
use crate::{Done, log, signals};

#[derive(Debug, clap::Args)]
#[command(after_help = FATES)]
pub(crate) struct SimpleClient {
    /// The hostname or IP of the server
    host: String,

    /// Its port
    #[arg(value_parser = port)]
    port: u16,

    /// The scope that the server is listening to
    scope: String,

    /// What is asked for, as the server understands it; seconds for the simple server
    #[arg(allow_hyphen_values = true)]
    request: String,

    /// Tell the task's fate by the exit code (the original's is always 0)
    #[arg(long)]
    exit_status: bool,

    #[command(flatten)]
    identity: Identity,
}

impl SimpleClient {
    pub(crate) fn run(self) -> Done {
        log::init(Level::INFO);
        signals::catch()?;
        let (host, port) = (self.host.as_str(), self.port);
        line(format_args!(
            "Connecting to host '{host}:{port}' at scope '{}'...",
            self.scope
        ));
        let mut remote = self.identity.apply(connect(host, port, &self.scope)?)?;
        let conversation = Conversation {
            host,
            port,
            request: &self.request,
            words: Words::Simple,
            exit_status: self.exit_status,
        };
        conversation.run(&mut remote)
    }
}
