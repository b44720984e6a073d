//! `ztl subscribe`: shows what a publisher publishes.

use std::fs::File;
use std::io::{self, IsTerminal as _, Write};
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::{Duration, Instant, UNIX_EPOCH};

use tracing::Level;
use ztl_pickle::{Kind, Pickle};
use ztl_std::publish::{Content, Heard};

use crate::chosen_publisher::{ChosenPublisher, Connected, Noticed, Presence};
use crate::connect_options::KeyOptions;
use crate::exit::{Done, Misuse};
use crate::option_values::duration;
use crate::terminal::{error_line, flat, line};
use crate::{log, signals};

/// How often signals are noticed.
const TURN: Duration = Duration::from_millis(100);
/// How often rates are shown.
const PERIOD: Duration = Duration::from_secs(1);
/// Fields of a value that tell when it was made, in seconds since 1970.
const TIMES: [&str; 3] = ["time", "stamp", "timestamp"];

/// In seconds.
const A_DAY: f64 = 86_400.0;

const AFTER_HELP: &str = "\
Examples:
  ztl subscribe battery                             a publisher of the configuration file
  ztl subscribe tcp://robot:6000 /robot/arm         topics of the scope /robot/arm
  ztl subscribe microphone --raw - | aplay -f S16_LE -r 16000
  ztl subscribe camera --rate                       messages and bytes a second

Exit codes: 0 at the end, 1 if the messages of --count do not come in time, 2 for a wrong command line.";

#[derive(Debug, clap::Args)]
#[command(after_help = AFTER_HELP)]
pub(crate) struct Subscribe {
    /// A publisher of the configuration file, or its address, such as tcp://robot:6000
    #[arg(value_name = "NAME|tcp://HOST:PORT")]
    publisher: String,

    /// Show only these scopes and what is below them [default: the publisher's scope in the configuration file, or all]
    #[arg(value_name = "SCOPE")]
    scopes: Vec<String>,

    /// The configuration file [default: zmq-remotes.yaml in $XDG_CONFIG_HOME or ~/.config]
    #[arg(short, long, value_name = "FILE")]
    config: Option<PathBuf>,

    /// Print each message as a line of JSON
    #[arg(long, conflicts_with_all = ["raw", "rate"])]
    json: bool,

    /// Write the bytes of each message into a file, or to stdout (-): of bytes, arrays and text
    #[arg(long, value_name = "FILE|-", conflicts_with = "rate")]
    raw: Option<PathBuf>,

    /// Print messages, bytes and missed messages of each second, and how old messages with a time are
    #[arg(long)]
    rate: bool,

    /// End after so many messages
    #[arg(short = 'n', long, value_name = "NUMBER")]
    count: Option<u64>,

    /// End after this time; with --count, exit with 1 if the messages have not come by then
    #[arg(short, long, value_name = "DURATION", value_parser = duration)]
    timeout: Option<Duration>,

    #[command(flatten)]
    keys: KeyOptions,
}

impl Subscribe {
    pub(crate) fn run(self) -> Done {
        log::init(Level::WARN);
        signals::catch()?;
        let connected = self.connect()?;
        let mut subscriber = connected.subscriber;
        let mut presence = Presence::new();
        let mut output = Output::new(&self)?;
        let end = self.timeout.map(|limit| Instant::now() + limit);
        let mut missed = 0;
        let mut damaged = 0;
        let mut left = self.count;
        let mut advice = None;
        while left != Some(0) && !signals::stopped() {
            let until_end = end.map(|end| end.saturating_duration_since(Instant::now()));
            if until_end == Some(Duration::ZERO) {
                break;
            }
            let heard = subscriber.next_within(until_end.unwrap_or(TURN).min(TURN))?;
            let newly = subscriber.advice();
            if newly != advice {
                if let Some(newly) = &newly {
                    error_line(format_args!("ztl: warning: {newly}"));
                }
                advice = newly;
            }
            if presence.notice(subscriber.is_connected()) == Some(Noticed::Absent)
                && advice.is_none()
            {
                let endpoint = flat(&connected.endpoint);
                error_line(format_args!(
                    "ztl: no publisher at {endpoint} yet; its messages are shown as soon as it is there"
                ));
            }
            if subscriber.damaged() > damaged {
                damaged = subscriber.damaged();
                error_line(format_args!(
                    "ztl: warning: {damaged} messages were dropped: they are not ZTL's"
                ));
            }
            let newly_missed = subscriber.missed() - missed;
            missed = subscriber.missed();
            if newly_missed > 0 && !self.rate {
                error_line(format_args!(
                    "ztl: warning: {newly_missed} messages were missed: this subscriber is too slow, or a connection behind the publisher was lost"
                ));
            }
            output.on_time(newly_missed);
            if let Some(heard) = heard
                && output.show(&heard)?
            {
                left = left.map(|left| left - 1);
            }
        }
        match left {
            None | Some(0) => Ok(signals::exit_code_or(ExitCode::SUCCESS)),
            Some(_) if signals::stopped() => Ok(signals::exit_code_or(ExitCode::SUCCESS)),
            Some(left) => {
                let why = match subscriber.is_connected() {
                    true => "",
                    false => "; the publisher is not connected",
                };
                let messages = match left {
                    1 => "1 message",
                    _ => &format!("{left} messages"),
                };
                Err(format!("{messages} of --count did not come in time{why}").into())
            }
        }
    }

    /// Connects to the publisher.
    fn connect(&self) -> Result<Connected, Box<dyn std::error::Error>> {
        let publisher = ChosenPublisher::find(&self.publisher, self.config.as_deref())?;
        publisher.connect(&self.scopes, &self.keys)
    }
}

/// Where messages go.
enum Output {
    Text,
    Json,
    Raw(Box<dyn Write>),
    Rate(Rate),
}

impl Output {
    fn new(options: &Subscribe) -> Result<Self, Box<dyn std::error::Error>> {
        Ok(match &options.raw {
            Some(path) if path.as_os_str() == "-" => {
                if io::stdout().is_terminal() {
                    return Err(
                        Misuse("--raw - writes bytes, and stdout is a terminal".into()).into(),
                    );
                }
                Self::Raw(Box::new(io::stdout()))
            }
            Some(path) => {
                let file = File::create(path);
                let file =
                    file.map_err(|error| format!("cannot write {}: {error}", path.display()))?;
                Self::Raw(Box::new(file))
            }
            None if options.json => Self::Json,
            None if options.rate => Self::Rate(Rate::new()),
            None => Self::Text,
        })
    }

    /// Shows a message. Returns whether it counts.
    fn show(&mut self, heard: &Heard) -> Result<bool, Box<dyn std::error::Error>> {
        match self {
            Self::Text => match heard.content() {
                Content::Value(value) => {
                    line(format_args!(
                        "{} {}",
                        flat(&heard.topic),
                        value.value().repr()
                    ));
                }
                Content::Text(text) => line(format_args!("{} {}", flat(&heard.topic), flat(text))),
                Content::Bytes(bytes) => {
                    line(format_args!("{} {} bytes", flat(&heard.topic), bytes.len()));
                }
                Content::Refused(error) => {
                    error_line(format_args!("ztl: {}: {error}", flat(&heard.topic)));
                    return Ok(false);
                }
            },
            Self::Json => line(heard.to_json()),
            Self::Raw(file) => {
                let content = heard.content();
                let bytes = match &content {
                    Content::Value(value) => data(value),
                    Content::Text(_) | Content::Bytes(_) => Some(heard.body.as_slice()),
                    Content::Refused(_) => None,
                };
                let Some(bytes) = bytes else {
                    let what = match &content {
                        Content::Refused(error) => error.to_string(),
                        _ => "its value has no bytes; use --json".to_owned(),
                    };
                    error_line(format_args!("ztl: {}: {what}", flat(&heard.topic)));
                    return Ok(false);
                };
                let written = file.write_all(bytes).and_then(|()| file.flush());
                written.map_err(|error| format!("cannot write the output: {error}"))?;
            }
            Self::Rate(rate) => rate.on_message(heard),
        }
        Ok(true)
    }

    /// Notes the time, and how many messages were missed.
    fn on_time(&mut self, missed: u64) {
        if let Self::Rate(rate) = self {
            rate.on_time(missed);
        }
    }
}

/// The bytes of a value that consists of bytes.
fn data(value: &Pickle) -> Option<&[u8]> {
    match value.value().kind() {
        Kind::Bytes(bytes) | Kind::ByteArray(bytes) => Some(bytes),
        Kind::Str(text) => Some(text.as_bytes()),
        Kind::Array(array) => Some(array.data()),
        _ => None,
    }
}

/// Counts of the current second.
struct Rate {
    since: Instant,
    messages: u64,
    bytes: usize,
    missed: u64,
    /// How old messages were when they came, in milliseconds.
    ages: Vec<f64>,
}

impl Rate {
    fn new() -> Self {
        Self {
            since: Instant::now(),
            messages: 0,
            bytes: 0,
            missed: 0,
            ages: Vec::new(),
        }
    }

    fn on_message(&mut self, heard: &Heard) {
        self.messages += 1;
        self.bytes += heard.body.len();
        // Reading large values would slow down what is measured.
        if heard.body.len() <= 4096
            && let Ok(value) = heard.value()
            && let Some(made) = TIMES
                .iter()
                .find_map(|name| value.value().get(name)?.as_f64())
            && let Ok(at) = heard.at.duration_since(UNIX_EPOCH)
        {
            let age = at.as_secs_f64() - made;
            // Otherwise it is no time of the wall clock in seconds.
            if age.abs() < A_DAY {
                self.ages.push(age * 1e3);
            }
        }
    }

    fn on_time(&mut self, missed: u64) {
        self.missed += missed;
        let passed = self.since.elapsed();
        if passed < PERIOD {
            return;
        }
        let seconds = passed.as_secs_f64();
        let messages = self.messages as f64 / seconds;
        let bytes = self.bytes as f64 / seconds;
        self.ages.sort_by(f64::total_cmp);
        let age = match self.ages.get(self.ages.len() / 2) {
            Some(age) => format!(", {age:.1} ms old"),
            None => String::new(),
        };
        let missed = self.missed;
        line(format_args!(
            "{messages:.1} messages/s, {bytes:.0} bytes/s, {missed} missed{age}"
        ));
        *self = Self::new();
    }
}
