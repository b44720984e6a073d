//! `ztl replay`: publishes a recording again, and plays its tasks if a person has agreed.

mod tasks;

use std::path::PathBuf;
use std::process::ExitCode;
use std::time::{Duration, Instant};

use tracing::Level;
use ztl_record::{Content, Read, Reader};
use ztl_std::Publisher;

use crate::exit::{Done, Misuse};
use crate::listen_options::{AccessOptions, bind};
use crate::option_values::{duration, port};
use crate::terminal::{error_line, line};
use crate::{log, signals};
use tasks::{RunningTasks, TaskOptions};

/// A delay longer than this moves all later messages, if tasks are sent.
const LATE: Duration = Duration::from_millis(100);
/// How often it looks for subscribers and for room.
const TURN: Duration = Duration::from_millis(20);

const AFTER_HELP: &str = "\
Examples:
  ztl replay run.mcap -p 6000                       publishes the streams
  ztl replay run.mcap -p 6000 --topics /robot/arm --speed 4
  ztl replay run.mcap --tasks                       asks, and sends the tasks to the robots

Exit codes: 0 when all is published, 1 if the file cannot be read, no subscriber came in time or a task did not
complete, 2 for a wrong command line, or if the tasks were not agreed to.";

#[derive(Debug, clap::Args)]
#[command(after_help = AFTER_HELP)]
pub(crate) struct Replay {
    /// A recording of `ztl record`
    #[arg(value_name = "FILE.mcap")]
    file: PathBuf,

    /// The port to publish at
    #[arg(short, long, value_parser = port, required_unless_present = "tasks")]
    port: Option<u16>,

    /// The address to publish at; `*` is every interface of this machine
    #[arg(long, value_name = "ADDR", default_value = "127.0.0.1", value_parser = bind)]
    bind: String,

    #[command(flatten)]
    access: AccessOptions,

    /// So many times as fast as it was recorded; with --tasks, at most 1
    #[arg(long, value_name = "X", default_value_t = 1.0, value_parser = speed)]
    speed: f64,

    /// Only these scopes and what is below them
    #[arg(long, value_name = "SCOPE", num_args = 1..)]
    topics: Vec<String>,

    /// Wait for so many subscribers first
    #[arg(long, value_name = "NUMBER", default_value_t = 1)]
    subscribers: usize,

    /// Wait at most so long for subscribers [default: without end]
    #[arg(short, long, value_name = "DURATION", value_parser = duration)]
    timeout: Option<Duration>,

    #[command(flatten)]
    tasks: TaskOptions,
}

fn speed(text: &str) -> Result<f64, &'static str> {
    let speed = text.parse().ok();
    speed
        .filter(|speed| (0.001..=1000.0).contains(speed))
        .ok_or("expected a number from 0.001 to 1000")
}

/// How far the later messages move if one of time `after` is played at `now`.
fn delay(now: Duration, after: Duration) -> Duration {
    let late = now.saturating_sub(after);
    if late > LATE { late } else { Duration::ZERO }
}

impl Replay {
    pub(crate) fn run(self) -> Done {
        log::init(Level::WARN);
        signals::catch()?;
        if self.tasks.tasks && self.speed > 1.0 {
            let mistake =
                "--tasks does not play faster than recorded: robots move as fast as they do";
            return Err(Misuse(mistake.to_owned()).into());
        }
        self.check_messages()?;
        let mut messages = self.open()?;
        let access = self.access.of_publisher()?;
        let agreed = match self.tasks.tasks {
            true => Some(
                self.tasks
                    .agreed(self.open()?, |topic| self.is_chosen(topic))?,
            ),
            false => None,
        };
        let publisher = match self.port {
            None => None,
            Some(port) => {
                let endpoint = format!("tcp://{}:{port}", self.bind);
                let publisher = Publisher::builder().access(access).bind(&endpoint, "")?;
                if port == 0 {
                    error_line(format_args!("Publishing at {}.", publisher.endpoint()));
                }
                if !self.is_awaited(&publisher)? {
                    return Ok(signals::exit_code_or(ExitCode::SUCCESS));
                }
                Some(publisher)
            }
        };
        match agreed {
            None => {
                let played = self.play(messages.by_ref(), publisher.as_ref(), None);
                if messages.damage().is_any() {
                    let path = self.file.display();
                    error_line(format_args!("ztl: warning: {path} {}", messages.damage()));
                }
                played
            }
            Some(agreed) => std::thread::scope(|scope| {
                let messages = messages.take(agreed.messages);
                let mut running = RunningTasks::new(scope, agreed);
                let played = self.play(messages, publisher.as_ref(), Some(&mut running));
                let all_completed = running.wait();
                match played? {
                    code if code == ExitCode::SUCCESS && !all_completed => Ok(ExitCode::FAILURE),
                    code => Ok(code),
                }
            }),
        }
    }

    fn open(&self) -> Result<Reader, String> {
        let path = self.file.display();
        Reader::open(&self.file).map_err(|error| format!("cannot read {path}: {error}"))
    }

    /// Whether there is something to replay, before anything is published or asked.
    fn check_messages(&self) -> Result<(), String> {
        let mut reader = self.open()?;
        if reader.any(|read| self.is_played(&read)) {
            return Ok(());
        }
        let nothing = format!("{} has no messages to replay", self.file.display());
        Err(match &reader.damage().end {
            Some(why) => format!("{nothing}: it {why}"),
            None => nothing,
        })
    }

    /// The events of a run were not published.
    fn is_played(&self, read: &Read) -> bool {
        !matches!(read.content, Content::Run(_)) && self.is_chosen(&read.topic)
    }

    fn is_chosen(&self, topic: &str) -> bool {
        let is_below =
            |scope: &String| ztl_core::topic::is_below(topic.as_bytes(), scope.as_bytes());
        self.topics.is_empty() || self.topics.iter().any(is_below)
    }

    /// Waits for subscribers. Returns whether they came; `false` after a signal.
    fn is_awaited(&self, publisher: &Publisher) -> Result<bool, String> {
        let end = self.timeout.map(|limit| Instant::now() + limit);
        while publisher.subscribers() < self.subscribers {
            if signals::wait_for(TURN) {
                return Ok(false);
            }
            if end.is_some_and(|end| end <= Instant::now()) {
                let (found, all) = (publisher.subscribers(), self.subscribers);
                return Err(format!("{found} of {all} subscribers came in time"));
            }
        }
        Ok(true)
    }

    /// Plays the messages at their times. With tasks, a delay moves what follows: overdue tasks never start together.
    fn play(
        &self,
        messages: impl Iterator<Item = Read>,
        publisher: Option<&Publisher>,
        mut tasks: Option<&mut RunningTasks<'_, '_>>,
    ) -> Done {
        let mut start = Instant::now();
        let mut first = None;
        let mut published: u64 = 0;
        for read in messages {
            if !self.is_played(&read) {
                continue;
            }
            let first = *first.get_or_insert(read.log_time);
            let after = Duration::from_nanos(read.log_time.saturating_sub(first));
            let after = Duration::try_from_secs_f64(after.as_secs_f64() / self.speed);
            let after = after.unwrap_or(Duration::MAX);
            let until_then = after.saturating_sub(start.elapsed());
            if signals::stopped() || (!until_then.is_zero() && signals::wait_for(until_then)) {
                break;
            }
            if tasks.is_some() {
                start += delay(start.elapsed(), after);
            }
            if let (Some(tasks), Content::Task(event, _)) = (&mut tasks, &read.content) {
                tasks.on_event(event, read.publish_time);
            }
            if let Some(publisher) = publisher {
                let body = read.body();
                while !publisher.publish_bytes(&read.topic, &body, false)
                    && !signals::wait_for(TURN)
                {}
                published += 1;
            }
        }
        if publisher.is_some() {
            let path = self.file.display();
            line(format_args!("Published: {published} messages of {path}"));
        }
        Ok(signals::exit_code_or(ExitCode::SUCCESS))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_long_delay_moves_later_messages() {
        let ms = Duration::from_millis;
        assert_eq!(delay(ms(1000), ms(1000)), Duration::ZERO);
        assert_eq!(delay(ms(1100), ms(1000)), Duration::ZERO);
        assert_eq!(delay(ms(9000), ms(1000)), ms(8000));
        assert_eq!(delay(ms(0), Duration::MAX), Duration::ZERO);
    }
}
