//! `ztl simple-publisher`: publishes a counter once a second, with the original's options and output (wire
//! specification 7.6).

use std::process::ExitCode;
use std::time::Duration;

use tracing::{Level, error, info};
use ztl_pickle::Pickle;
use ztl_std::Publisher;
use ztl_std::publish::PATH;

use crate::exit::Done;
use crate::option_values::port;
use crate::{log, signals};

/// The original's logger.
const LOG: &str = "simple-pub";
const PERIOD: Duration = Duration::from_secs(1);

#[derive(Debug, clap::Args)]
pub(crate) struct SimplePublisher {
    /// The port to publish at
    #[arg(short, long, value_parser = port)]
    port: u16,

    /// The scope to publish under
    #[arg(short, long)]
    scope: String,
}

impl SimplePublisher {
    pub(crate) fn run(self) -> Done {
        log::init(Level::INFO);
        signals::catch()?;
        // All interfaces, as the original.
        let publisher = Publisher::bind(&format!("tcp://*:{}", self.port), &self.scope)?;
        let mut count = 0;
        loop {
            match publisher.subscribers() {
                0 => info!(target: LOG, "Skip publishing (no subscribers)..."),
                subscribers => {
                    let value = Pickle::dict([("one", 1), ("more", 2), ("count", count)])?;
                    let shown = value.value().repr();
                    info!(target: LOG, "Publishing data to {subscribers} subscribers: {shown}...");
                    publisher.publish(PATH, &value);
                    count += 1;
                }
            }
            if signals::wait_for(PERIOD) {
                break;
            }
        }
        error!(target: LOG, "Exit signal received, exiting.");
        Ok(signals::exit_code_or(ExitCode::SUCCESS))
    }
}
