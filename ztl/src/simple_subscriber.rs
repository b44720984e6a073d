//! `ztl simple-subscriber`: shows what a publisher publishes, with the original's options and output (wire
//! specification 7.6).

use std::process::ExitCode;
use std::time::Duration;

use tracing::{Level, error, info, warn};
use ztl_std::Subscriber;

use crate::exit::Done;
use crate::option_values::port_to_reach;
use crate::{log, signals};

/// The original's logger.
const LOG: &str = "object-subscriber";
/// How often signals are noticed.
const TURN: Duration = Duration::from_millis(100);

#[derive(Debug, clap::Args)]
pub(crate) struct SimpleSubscriber {
    /// The remote host to subscribe to
    #[arg(short, long)]
    remote: String,

    /// The remote port to subscribe to
    #[arg(short, long, value_parser = port_to_reach)]
    port: i64,

    /// The scope that is published under
    #[arg(short, long)]
    scope: String,
}

impl SimpleSubscriber {
    pub(crate) fn run(self) -> Done {
        log::init(Level::INFO);
        signals::catch()?;
        let endpoint = format!("tcp://{}:{}", self.remote, self.port);
        let mut subscriber = Subscriber::connect(&endpoint, &self.scope)?;
        info!(target: LOG, "Start listening...");
        let mut damaged = 0;
        while !signals::stopped() {
            let heard = subscriber.next_within(TURN)?;
            if subscriber.damaged() > damaged {
                damaged = subscriber.damaged();
                warn!(target: LOG, "{damaged} messages were dropped: they are not ZTL's");
            }
            let Some(heard) = heard else {
                continue;
            };
            match heard.value() {
                Ok(value) => {
                    let shown = value.value();
                    match shown.as_str() {
                        Some(text) => info!(target: LOG, "Received data: {text}..."),
                        None => info!(target: LOG, "Received data: {}...", shown.repr()),
                    }
                }
                Err(error) => error!(target: LOG, "A message was dropped: {error}"),
            }
        }
        Ok(signals::exit_code_or(ExitCode::SUCCESS))
    }
}
