//! `ztl simple-client`: runs a task with any payload, with the original's arguments and output.

use tracing::Level;

use crate::called::Called;
use crate::client::AFTER_HELP;
use crate::client::task::{ClientTask, ReportOptions, Target, Wording};
use crate::connect_options::ConnectOptions;
use crate::exit::Done;
use crate::log;
use crate::option_values::port_to_reach;

#[derive(Debug, clap::Args)]
#[command(after_help = AFTER_HELP)]
pub(crate) struct SimpleClient {
    /// The hostname or IP of the server
    #[arg(index = 1)]
    host: String,

    /// Port of the server
    #[arg(index = 2, value_parser = port_to_reach)]
    port: i64,

    /// The scope that the server is listening to
    #[arg(index = 3)]
    scope: String,

    /// The payload; seconds for the simple server. Write `--` before one that begins with a dash
    #[arg(index = 4, allow_negative_numbers = true)]
    request: String,

    #[command(flatten)]
    pub(crate) report: ReportOptions,

    #[command(flatten)]
    connecting: ConnectOptions,
}

impl SimpleClient {
    pub(crate) fn run(self, called: &Called) -> Done {
        log::init(Level::INFO);
        let task = ClientTask {
            target: Target {
                host: &self.host,
                port: self.port,
                scope: &self.scope,
            },
            request: &self.request,
            wording: Wording::Simple,
            as_original: called.is_original(),
            report: &self.report,
        };
        task.run(|remote| self.connecting.apply(remote, None))
    }
}
