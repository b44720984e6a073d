//! A task that a client runs, and how the client reports it.

use std::time::Duration;

use ztl_std::RemoteTask;

use crate::server_address::no_client;

/// Options for what a client reports.
#[derive(Debug, clap::Args)]
pub(crate) struct ReportOptions {
    /// Tell the outcome by the exit code (the original's is always 0)
    #[arg(long)]
    pub(crate) exit_status: bool,

    /// Report events as JSON, one object a line (docs/tools.md)
    #[arg(long)]
    pub(crate) json: bool,
}

/// A server and its scope.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Target<'a> {
    pub(crate) host: &'a str,
    /// Any number, since the original's tools accept that.
    pub(crate) port: i64,
    pub(crate) scope: &'a str,
}

impl Target<'_> {
    /// Connects to it.
    pub(crate) fn connect(&self) -> Result<RemoteTask, Box<dyn std::error::Error>> {
        let Self { host, port, scope } = self;
        let port = u16::try_from(*port)
            .map_err(|_| format!("invalid port '{port}': expected 0 to 65535"))?;
        let remote = RemoteTask::connect(&format!("tcp://{host}:{port}"), scope);
        remote.map_err(no_client)
    }
}

/// The tool whose messages are printed. The seconds are the time limit, as given.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Wording {
    TaskClient(i64),
    RemoteTask(i64),
    /// `simple-client` waits for 5 s.
    Simple,
}

impl Wording {
    /// How long to wait; forever if `None`.
    pub(crate) fn limit(self) -> Option<Duration> {
        let seconds = match self {
            Self::TaskClient(seconds) | Self::RemoteTask(seconds) => seconds,
            Self::Simple => 5,
        };
        let seconds = u64::try_from(seconds).ok().filter(|seconds| *seconds > 0);
        seconds.map(Duration::from_secs)
    }
}

/// A task to run on a server.
pub(crate) struct ClientTask<'a> {
    pub(crate) target: Target<'a>,
    /// The payload of the INIT.
    pub(crate) request: &'a str,
    pub(crate) wording: Wording,
    /// Whether to print exactly what the original prints.
    pub(crate) as_original: bool,
    pub(crate) report: &'a ReportOptions,
}
