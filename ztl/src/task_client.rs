//! `ztl task-client`: runs a task on a server, with the original's options and output.

use tracing::Level;
use ztl_std::RemoteTask;

use crate::called::Called;
use crate::client::AFTER_HELP;
use crate::client::task::{ClientTask, ReportOptions, Target, Wording};
use crate::connect_options::ConnectOptions;
use crate::exit::{Done, Misuse};
use crate::log;
use crate::option_values::{request, seconds};
use crate::server_address::AddressOptions;

#[derive(Debug, clap::Args)]
#[command(after_help = AFTER_HELP)]
pub(crate) struct TaskClient {
    #[command(flatten)]
    address: AddressOptions,

    /// The scope that the server is listening to [default: the configuration file's, else $ZTL_SCOPE]
    #[arg(short, long)]
    scope: Option<String>,

    /// Seconds to wait for the task to end before it is aborted; 0 or less waits forever
    #[arg(short, long, default_value_t = -1, allow_negative_numbers = true, value_parser = seconds)]
    timeout: i64,

    #[command(flatten)]
    pub(crate) report: ReportOptions,

    #[command(flatten)]
    connecting: ConnectOptions,

    /// The task: handler, component and goal separated by ':', e.g. 'handler:component:goal'
    payload: String,
}

impl TaskClient {
    /// The client, if the task is this text. It was parsed from a line that is being typed.
    pub(crate) fn remote_at(self, task: &str) -> Option<RemoteTask> {
        let address = self.address.resolve().ok()?;
        let scope = address.scope(self.scope.as_ref()).ok()??;
        let remote = RemoteTask::connect(&address.endpoint(), &scope).ok()?;
        let remote = self.connecting.apply(remote, address.keys.as_ref()).ok()?;
        (self.payload == task).then_some(remote)
    }

    pub(crate) fn run(self, called: &Called) -> Done {
        log::init(Level::INFO);
        let request = request(&self.payload)?;
        let address = self.address.resolve()?;
        let scope = address.scope(self.scope.as_ref())?.ok_or_else(|| {
            let how = "give --scope, or --remote NAME for a server in the configuration file, or set ZTL_SCOPE";
            Misuse(format!("no scope: {how}"))
        })?;
        let task = ClientTask {
            target: Target {
                host: &address.host,
                port: address.port,
                scope: &scope,
            },
            request: &request,
            wording: Wording::TaskClient(self.timeout),
            as_original: called.is_original(),
            report: &self.report,
        };
        task.run(|remote| self.connecting.apply(remote, address.keys.as_ref()))
    }
}
