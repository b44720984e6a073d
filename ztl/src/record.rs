//! `ztl record`: records streams and tasks.

use std::fs::File;
use std::io;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use tracing::Level;
use ztl_record::{Formats, Recording, SoundFormat, Written};
use ztl_std::Subscriber;

use crate::chosen_publisher::{ChosenPublisher, configuration};
use crate::connect_options::KeyOptions;
use crate::exit::{Done, Misuse};
use crate::option_values::duration;
use crate::terminal::{error_line, flat, line};
use crate::{log, signals};

/// How often the recording is brought to the disk. With the time that this takes, less than a second is lost when the
/// recorder is killed.
const FLUSH: Duration = Duration::from_millis(300);
/// How often signals are noticed.
const TURN: Duration = Duration::from_millis(100);
/// After this time without a connection it is said.
const SOON: Duration = Duration::from_secs(2);
/// Most messages of a publisher that are reported one by one as left out.
const TOLD: u64 = 10;

const AFTER_HELP: &str = "\
Examples:
  ztl record run.mcap                               all publishers of the configuration file
  ztl record run.mcap camera tcp://robot:6000       these
  ztl record run.mcap microphone --sound /robot/microphone/=16000
  ztl report run.mcap                               a page of it

Exit codes: 0 at the end, 1 if the file cannot be written, 2 for a wrong command line.";

#[derive(Debug, clap::Args)]
#[command(after_help = AFTER_HELP)]
pub(crate) struct Record {
    /// The file to write; it must not exist
    #[arg(value_name = "FILE.mcap")]
    file: PathBuf,

    /// Publishers of the configuration file, or their addresses, such as tcp://robot:6000 [default: all of the
    /// configuration file]
    #[arg(value_name = "NAME|tcp://HOST:PORT")]
    publishers: Vec<String>,

    /// The configuration file [default: zmq-remotes.yaml in $XDG_CONFIG_HOME or ~/.config]
    #[arg(short, long, value_name = "FILE")]
    config: Option<PathBuf>,

    /// Record only this scope and what is below it (repeatable) [default: a publisher's scope in the configuration file,
    /// or all]
    #[arg(short, long, value_name = "SCOPE")]
    scope: Vec<String>,

    /// The bytes of this topic are sound: 16-bit samples, so many a second (repeatable)
    #[arg(long, value_name = "TOPIC=RATE[xCHANNELS]", value_parser = sound)]
    sound: Vec<(String, SoundFormat)>,

    /// End after this time
    #[arg(short, long, value_name = "DURATION", value_parser = duration)]
    timeout: Option<Duration>,

    #[command(flatten)]
    keys: KeyOptions,
}

/// Parses TOPIC=RATE or TOPIC=RATExCHANNELS.
fn sound(text: &str) -> Result<(String, SoundFormat), &'static str> {
    const FORM: &str =
        "expected TOPIC=RATE or TOPIC=RATExCHANNELS, such as /robot/microphone/=16000";
    let (topic, format) = text.rsplit_once('=').ok_or(FORM)?;
    let (rate, channels) = format.split_once('x').unwrap_or((format, "1"));
    let number = |text: &str| text.parse().ok().filter(|number| *number > 0).ok_or(FORM);
    let format = SoundFormat {
        rate: number(rate)?,
        channels: number(channels)?,
    };
    Ok((topic.to_owned(), format))
}

impl Record {
    pub(crate) fn run(self) -> Done {
        log::init(Level::WARN);
        signals::catch()?;
        let subscribers = self.subscribers()?;
        let mut formats = Formats::default();
        for (topic, format) in &self.sound {
            formats.set_sound(topic, *format);
        }
        let cannot_write =
            |error: io::Error| format!("cannot write {}: {error}", self.file.display());
        let recording = Recording::create(&self.file).map_err(cannot_write)?;
        let disk = recording.file().map_err(cannot_write)?;
        let session = Session {
            formats,
            recording: Mutex::new(recording),
            failure: Mutex::new(None),
            end: self.timeout.map(|limit| Instant::now() + limit),
            counts: Mutex::default(),
        };
        error_line(format_args!(
            "Recording into {}. Ctrl-C ends it.",
            self.file.display()
        ));
        std::thread::scope(|scope| -> io::Result<()> {
            for (name, subscriber) in subscribers {
                let session = &session;
                std::thread::Builder::new()
                    .name(format!("ztl-{name}"))
                    .spawn_scoped(scope, move || session.hear(&name, subscriber))
                    .inspect_err(|_| session.fail("no thread"))?;
            }
            session.keep_flushed(&disk);
            Ok(())
        })?;
        let failure = session.failure().take();
        if let Some(failure) = failure {
            return Err(format!(
                "cannot write {}: {failure}; the recording has ended, what was written before is readable",
                self.file.display()
            )
            .into());
        }
        let Counts {
            recorded,
            missed,
            left_out,
        } = *session.counts();
        let left_out = match left_out {
            0 => String::new(),
            number => format!(", {number} left out"),
        };
        let recording = session.recording.into_inner();
        let recording = recording.unwrap_or_else(PoisonError::into_inner);
        let topics = recording.topics();
        recording.finish().map_err(cannot_write)?;
        line(format_args!(
            "Recorded: {recorded} messages of {topics} topics, {missed} missed{left_out}: {}",
            self.file.display()
        ));
        Ok(signals::exit_code_or(ExitCode::SUCCESS))
    }

    /// The publishers to record, by name.
    fn subscribers(&self) -> Result<Vec<(String, Subscriber)>, Box<dyn std::error::Error>> {
        let config = self.config.as_deref();
        let mut names = self.publishers.clone();
        if names.is_empty() {
            let remotes = configuration(config)?;
            names.extend(remotes.publisher_names().map(str::to_owned));
            if names.is_empty() {
                let mistake = format!("no publishers in {}; name some", remotes.name());
                return Err(Misuse(mistake).into());
            }
        }
        names.sort();
        names.dedup();
        let connected = names.into_iter().map(|name| {
            let publisher = ChosenPublisher::find(&name, config)?;
            Ok((name, publisher.connect(&self.scope, &self.keys)?))
        });
        connected.collect()
    }
}

/// What the threads of a recording share.
struct Session {
    formats: Formats,
    recording: Mutex<Recording>,
    /// Why the recording ended early.
    failure: Mutex<Option<String>>,
    end: Option<Instant>,
    counts: Mutex<Counts>,
}

/// Numbers of messages.
#[derive(Debug, Clone, Copy, Default)]
struct Counts {
    recorded: u64,
    missed: u64,
    left_out: u64,
}

impl Session {
    fn failure(&self) -> MutexGuard<'_, Option<String>> {
        self.failure.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn fail(&self, why: impl ToString) {
        // The first failure is the cause of the others.
        self.failure().get_or_insert(why.to_string());
    }

    fn recording(&self) -> MutexGuard<'_, Recording> {
        self.recording
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
    }

    fn counts(&self) -> MutexGuard<'_, Counts> {
        self.counts.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn is_over(&self) -> bool {
        let is_late = self.end.is_some_and(|end| end <= Instant::now());
        is_late || signals::stopped() || self.failure().is_some()
    }

    /// Brings what was recorded to the disk, until the end.
    fn keep_flushed(&self, disk: &File) {
        let mut next = Instant::now() + FLUSH;
        while !self.is_over() {
            signals::wait_for(TURN);
            if Instant::now() < next {
                continue;
            }
            next = Instant::now() + FLUSH;
            // Others may write while the disk works.
            let flushed = self.recording().flush();
            if let Err(error) = flushed.and_then(|()| disk.sync_data()) {
                self.fail(error);
            }
        }
    }

    /// Records what a publisher publishes, until the end.
    fn hear(&self, name: &str, mut subscriber: Subscriber) {
        let mut said = Said::new(name);
        let mut missed = 0;
        let mut damaged = 0;
        while !self.is_over() {
            let heard = match subscriber.next_within(TURN) {
                Ok(heard) => heard,
                Err(error) => return self.fail(error),
            };
            let at = Instant::now();
            said.on_connection(subscriber.is_connected(), at);
            if subscriber.missed() > missed {
                self.counts().missed += subscriber.missed() - missed;
                missed = subscriber.missed();
            }
            if subscriber.damaged() > damaged {
                self.counts().left_out += subscriber.damaged() - damaged;
                damaged = subscriber.damaged();
            }
            let Some(heard) = heard else { continue };
            let message = match self.formats.prepare(&heard.topic, &heard.body) {
                Ok(message) => message,
                Err(error) => {
                    said.left_out(&heard.topic, error);
                    self.counts().left_out += 1;
                    continue;
                }
            };
            let written = self.recording().write(name, message, at);
            match written {
                Ok(Written::Yes) => self.counts().recorded += 1,
                Ok(Written::TooManyTopics) => {
                    said.left_out(&heard.topic, "there are too many topics");
                    self.counts().left_out += 1;
                }
                Err(error) => return self.fail(error),
            }
        }
    }
}

/// What was said about a publisher.
struct Said<'a> {
    name: &'a str,
    since: Instant,
    connected: bool,
    waiting: bool,
    left_out: u64,
}

impl<'a> Said<'a> {
    fn new(name: &'a str) -> Self {
        Self {
            name,
            since: Instant::now(),
            connected: false,
            waiting: false,
            left_out: 0,
        }
    }

    fn on_connection(&mut self, connected: bool, now: Instant) {
        let name = flat(self.name);
        if connected != self.connected {
            self.connected = connected;
            error_line(match connected {
                true => format!("{name}: connected"),
                false => format!("{name}: connection lost; it is recorded again when it is back"),
            });
        } else if !connected && !self.waiting && now.duration_since(self.since) >= SOON {
            error_line(format_args!(
                "{name}: not connected; it is recorded as soon as it is there"
            ));
        } else {
            return;
        }
        self.waiting = !connected;
    }

    fn left_out(&mut self, topic: &str, why: impl std::fmt::Display) {
        self.left_out += 1;
        let (name, topic) = (flat(self.name), flat(topic));
        if self.left_out <= TOLD {
            error_line(format_args!(
                "ztl: warning: {name}: {topic} is left out: {why}"
            ));
        }
    }
}
