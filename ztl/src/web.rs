//! `ztl web`: the web console.

use std::net::{IpAddr, TcpListener};
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::mpsc::channel;

use tracing::Level;
use ztl_std::RemoteTask;
use ztl_web::{Options, Robot, Tokens, serve};

use crate::connect_options::ConnectOptions;
use crate::exit::{Done, Misuse};
use crate::option_values::port;
use crate::remotes_options::RemotesOptions;
use crate::terminal::line;
use crate::{log, signals};

/// The original's port.
const PORT: u16 = 1060;

#[derive(Debug, clap::Args)]
#[command(
    after_help = "Exit codes: 0 ended by Ctrl-C, 1 the console cannot run, 2 wrong options.\n\n\
    Everything that the page does goes over /rosbridge, for any rosbridge client (docs/web.md)."
)]
pub(crate) struct Web {
    #[command(flatten)]
    remotes: RemotesOptions,

    #[command(flatten)]
    connecting: ConnectOptions,

    /// Port of the console; 0 chooses a free one
    #[arg(short, long, default_value_t = PORT, value_parser = port)]
    port: u16,

    /// Address to serve at; for any other than 127.0.0.1 and ::1, the printed links are needed
    #[arg(long, value_name = "ADDRESS", default_value = "127.0.0.1")]
    bind: IpAddr,

    /// A name under which browsers reach this machine, besides its addresses (repeatable)
    #[arg(long, value_name = "NAME")]
    host: Vec<String>,
}

impl Web {
    pub(crate) fn run(self) -> Done {
        signals::catch()?;
        log::init(Level::WARN);
        let remotes = self.remotes.read()?;
        let mut robots = Vec::new();
        for name in remotes.task_names() {
            let remote = remotes
                .task(name)
                .map_err(|wrong| Misuse(wrong.to_string()))?;
            let (endpoint, of_server) = (remote.endpoint(), remote.keys.clone());
            let (options, at) = (self.connecting.clone(), endpoint.clone());
            let connect = move |scope: &str| {
                let client = RemoteTask::connect(&at, scope).map_err(|error| error.to_string())?;
                let client = options.apply(client, of_server.as_ref());
                client.map_err(|error| error.to_string())
            };
            // A missing key is a mistake of now, not of the first task.
            connect(&remote.scope).map_err(Misuse)?;
            robots.push(Robot {
                name: name.to_owned(),
                endpoint,
                scope: remote.scope.clone(),
                keys: remote.keys.clone(),
                connect: Arc::new(connect),
            });
        }
        if robots.is_empty() {
            let file = self.remotes.path();
            let why = format!(
                "no robots: give --task NAME HOST PORT SCOPE, or `remotes:` in {}",
                file.display()
            );
            return Err(Misuse(why).into());
        }
        let place = (self.bind, self.port);
        let listener = TcpListener::bind(place).map_err(|error| {
            format!("cannot serve at {} port {}: {error}", self.bind, self.port)
        })?;
        let address = listener.local_addr()?;
        let tokens = match self.bind.is_loopback() {
            true => None,
            false => Some(Tokens::random()?),
        };
        match &tokens {
            None => line(format_args!("http://{address}/")),
            Some(Tokens { operator, watcher }) => {
                let host = match (self.host.first(), self.bind.is_unspecified()) {
                    (Some(name), _) => format!("{name}:{}", address.port()),
                    (None, true) => format!("ADDRESS-OF-THIS-MACHINE:{}", address.port()),
                    (None, false) => address.to_string(),
                };
                line(format_args!("operators: http://{host}/?token={operator}"));
                line(format_args!("watchers:  http://{host}/?token={watcher}"));
            }
        }
        let (ending, end) = channel();
        let failing = ending.clone();
        signals::then(move || drop(ending.send(None)));
        std::thread::Builder::new()
            .name("ztl-web".to_owned())
            .spawn(move || {
                let options = Options {
                    listener,
                    robots,
                    tokens,
                    hosts: self.host,
                };
                drop(failing.send(serve(options).err()));
            })?;
        match end.recv()? {
            Some(error) => Err(error.into()),
            None => Ok(signals::exit_code_or(ExitCode::SUCCESS)),
        }
    }
}
