//! `ztl publish`: publishes values.

use std::io::BufRead as _;
use std::process::ExitCode;
use std::sync::mpsc::RecvTimeoutError;
use std::time::{Duration, Instant};

use serde_yaml_ng::Value;
use tracing::Level;
use ztl_pickle::Pickle;
use ztl_std::Publisher;

use crate::exit::{Done, Misuse};
use crate::listen_options::{AccessOptions, bind};
use crate::option_values::{duration, port};
use crate::terminal::error_line;
use crate::{log, signals};

/// How often it looks for subscribers.
const TURN: Duration = Duration::from_millis(20);

const AFTER_HELP: &str = "\
Examples:
  ztl publish -p 6000 /lab/door open                 waits for a subscriber, publishes, and ends
  ztl publish -p 6000 /lab/pose '{x: 1.5, y: 2}'
  vmstat 1 | ztl publish -p 6000 /lab/load --text -  each line of stdin

Exit codes: 0 when all is published, 1 if no subscriber came in time or a line is not a value, 2 for a wrong command line.";

#[derive(Debug, clap::Args)]
#[command(after_help = AFTER_HELP)]
pub(crate) struct Publish {
    /// The port to publish at
    #[arg(short, long, value_parser = port)]
    port: u16,

    /// The address to publish at; `*` is every interface of this machine
    #[arg(long, value_name = "ADDR", default_value = "127.0.0.1", value_parser = bind)]
    bind: String,

    #[command(flatten)]
    access: AccessOptions,

    /// The scope and path to publish under, such as /lab/door
    topic: String,

    /// The value, in YAML; `-` publishes each line of stdin
    #[arg(value_name = "VALUE|-", allow_hyphen_values = true)]
    value: String,

    /// Publish the value as text, also if it looks like a number
    #[arg(long)]
    text: bool,

    /// Publish a state: who subscribes later gets the newest one
    #[arg(long)]
    state: bool,

    /// Wait for so many subscribers first
    #[arg(long, value_name = "NUMBER", default_value_t = 1)]
    subscribers: usize,

    /// Wait at most so long for subscribers [default: without end]
    #[arg(short, long, value_name = "DURATION", value_parser = duration)]
    timeout: Option<Duration>,
}

impl Publish {
    pub(crate) fn run(self) -> Done {
        log::init(Level::WARN);
        signals::catch()?;
        let value = match self.value.as_str() {
            "-" => None,
            text => Some(self.read(text)?),
        };
        let access = self.access.of_publisher()?;
        let endpoint = format!("tcp://{}:{}", self.bind, self.port);
        let publisher = Publisher::builder().access(access);
        let publisher = publisher.bind(&endpoint, &self.topic)?;
        if self.port == 0 {
            error_line(format_args!("Publishing at {}.", publisher.endpoint()));
        }
        let end = self.timeout.map(|limit| Instant::now() + limit);
        while publisher.subscribers() < self.subscribers {
            if signals::wait_for(TURN) {
                return Ok(signals::exit_code_or(ExitCode::SUCCESS));
            }
            if end.is_some_and(|end| end <= Instant::now()) {
                let found = publisher.subscribers();
                return Err(
                    format!("{found} of {} subscribers came in time", self.subscribers).into(),
                );
            }
        }
        match value {
            Some(value) => self.publish(&publisher, &value),
            None if !self.publish_lines(&publisher)? => return Ok(ExitCode::FAILURE),
            None => {}
        }
        // Dropping the publisher sends what waits.
        Ok(signals::exit_code_or(ExitCode::SUCCESS))
    }

    /// Publishes each line of stdin, until its end or a signal. Returns whether all lines were values.
    fn publish_lines(&self, publisher: &Publisher) -> Result<bool, Box<dyn std::error::Error>> {
        let (put, lines) = std::sync::mpsc::sync_channel(1);
        std::thread::Builder::new().spawn(move || {
            for text in std::io::stdin().lock().lines() {
                if put.send(text).is_err() {
                    return;
                }
            }
        })?;
        let mut number = 0;
        let mut all_read = true;
        while !signals::stopped() {
            let text = match lines.recv_timeout(TURN) {
                Ok(text) => text?,
                Err(RecvTimeoutError::Timeout) => continue,
                Err(RecvTimeoutError::Disconnected) => break,
            };
            number += 1;
            match self.read(&text) {
                Ok(value) => self.publish(publisher, &value),
                Err(mistake) => {
                    all_read = false;
                    error_line(format_args!("ztl: line {number} of stdin: {mistake}"));
                }
            }
        }
        Ok(all_read)
    }

    /// Publishes a value as soon as there is room.
    fn publish(&self, publisher: &Publisher, value: &Pickle) {
        let body = value.to_bytes();
        while !publisher.publish_bytes("", &body, self.state) && !signals::wait_for(TURN) {}
    }

    /// Reads a value.
    fn read(&self, text: &str) -> Result<Pickle, Misuse> {
        if self.text {
            return Pickle::text(text).map_err(|error| Misuse(error.to_string()));
        }
        let value = serde_yaml_ng::from_str(text)
            .map_err(|error| Misuse(format!("'{text}' is not YAML: {error}")))?;
        pickled(&value).map_err(|wrong| Misuse(format!("'{text}' cannot be published: {wrong}")))
    }
}

/// A value of YAML as one of Python.
fn pickled(value: &Value) -> Result<Pickle, String> {
    let made = match value {
        Value::Null => Ok(Pickle::none()),
        Value::Bool(value) => Ok((*value).into()),
        Value::Number(number) => Ok(match (number.as_i64(), number.as_u64()) {
            (Some(number), _) => number.into(),
            (None, Some(number)) => number.into(),
            (None, None) => number.as_f64().unwrap_or(f64::NAN).into(),
        }),
        Value::String(text) => Pickle::text(text),
        Value::Sequence(items) => {
            let items: Result<Vec<_>, _> = items.iter().map(pickled).collect();
            Pickle::list(items?)
        }
        Value::Mapping(pairs) => {
            let pairs = pairs
                .iter()
                .map(|(key, value)| Ok((pickled(key)?, pickled(value)?)));
            Pickle::dict(pairs.collect::<Result<Vec<_>, String>>()?)
        }
        Value::Tagged(tagged) => return Err(format!("it has the tag {}", tagged.tag)),
    };
    made.map_err(|error| error.to_string())
}
