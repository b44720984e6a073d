//! `ztl record`: records streams and tasks.

use std::path::PathBuf;
use std::process::ExitCode;
use std::time::{Duration, Instant};

use tracing::Level;
use ztl_record::{Formats, SoundFormat};

use crate::chosen_publisher::{ChosenPublisher, Connected, configuration};
use crate::connect_options::KeyOptions;
use crate::exit::{Done, Misuse};
use crate::option_values::duration;
use crate::recorder::{Recorder, Told, set_tellers};
use crate::terminal::{error_line, line};
use crate::{log, signals};

/// How often signals are noticed.
const TURN: Duration = Duration::from_millis(100);

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
pub(crate) fn sound(text: &str) -> Result<(String, SoundFormat), &'static str> {
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
        let mut formats = Formats::default();
        for (topic, format) in &self.sound {
            formats.set_sound(topic, *format);
        }
        let publishers = self.publishers(&mut formats)?;
        let end = self.timeout.map(|limit| Instant::now() + limit);
        let tell = |told: Told| match told {
            Told::Note(text) => error_line(text),
            Told::Warning(text) => error_line(format_args!("ztl: warning: {text}")),
            // It is the error of the command.
            Told::Failed(_) => {}
        };
        let recorder = Recorder::start(&self.file, formats, publishers, Box::new(tell))?;
        let path = self.file.display();
        error_line(format_args!("Recording into {path}. Ctrl-C ends it."));
        let is_late = || end.is_some_and(|end| end <= Instant::now());
        while !is_late() && !recorder.has_failed() && !signals::wait_for(TURN) {}
        let counts = recorder.finish()?;
        line(format_args!("Recorded: {counts}: {path}"));
        Ok(signals::exit_code_or(ExitCode::SUCCESS))
    }

    /// The publishers to record.
    fn publishers(
        &self,
        formats: &mut Formats,
    ) -> Result<Vec<Connected>, Box<dyn std::error::Error>> {
        let config = self.config.as_deref();
        let mut names = self.publishers.clone();
        let is_named = |name: &String| !name.contains("://");
        if names.is_empty() || config.is_some() || names.iter().any(is_named) {
            let remotes = configuration(config)?;
            set_tellers(formats, &remotes);
            if names.is_empty() {
                names.extend(remotes.publisher_names().map(str::to_owned));
            }
            if names.is_empty() {
                let mistake = format!("no publishers in {}; name some", remotes.name());
                return Err(Misuse(mistake).into());
            }
        }
        names.sort();
        names.dedup();
        let connected = names
            .iter()
            .map(|name| ChosenPublisher::find(name, config)?.connect(&self.scope, &self.keys));
        connected.collect()
    }
}
