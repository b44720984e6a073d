//! `ztl remote-task`: runs a task on a named server, with the original's options and output.

use tracing::{Level, info};
use ztl_std::remotes::Remote;

use crate::called::Called;
use crate::client::AFTER_HELP;
use crate::client::task::{ClientTask, ReportOptions, Target, Wording};
use crate::connect_options::ConnectOptions;
use crate::exit::{Done, Misuse};
use crate::log;
use crate::option_values::{request, seconds};
use crate::remotes_options::RemotesOptions;

#[derive(Debug, clap::Args)]
#[command(after_help = AFTER_HELP)]
pub(crate) struct RemoteTask {
    /// Seconds to wait for the task to end before it is aborted; 0 or less waits forever
    #[arg(short, long, default_value_t = -1, allow_negative_numbers = true, value_parser = seconds)]
    timeout: i64,

    #[command(flatten)]
    remotes: RemotesOptions,

    #[command(flatten)]
    pub(crate) report: ReportOptions,

    #[command(flatten)]
    connecting: ConnectOptions,

    /// Name of the server in the configuration
    remote: String,

    /// The task: handler, component and goal separated by ':', e.g. 'handler:component:goal'
    payload: String,
}

impl RemoteTask {
    /// The client, if the task is this text. It was parsed from a line that is being typed.
    pub(crate) fn remote_at(self, task: &str) -> Option<ztl_std::RemoteTask> {
        let remotes = self.remotes.read().ok()?;
        let at = remotes.task(&self.remote).ok()?;
        let remote = ztl_std::RemoteTask::connect(&at.endpoint(), &at.scope).ok()?;
        let remote = self.connecting.apply(remote, at.keys.as_ref()).ok()?;
        (self.payload == task).then_some(remote)
    }

    pub(crate) fn run(self, called: &Called) -> Done {
        log::init(Level::INFO);
        let remotes = self.remotes.read()?;
        let request = request(&self.payload)?;
        let name = &self.remote;
        let Remote {
            host,
            port,
            scope,
            keys,
        } = remotes.task(name).map_err(Misuse::of)?;
        info!(target: "remote-config", "Initialising remote task interface '{name}'...");
        let task = ClientTask {
            target: Target {
                host,
                port: i64::from(*port),
                scope,
            },
            request: &request,
            wording: Wording::RemoteTask(self.timeout),
            as_original: called.is_original(),
            report: &self.report,
        };
        task.run(|remote| self.connecting.apply(remote, keys.as_ref()))
    }
}
