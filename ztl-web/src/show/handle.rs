//! How other threads reach the show: what they wish, and the answer.

use std::sync::mpsc::SyncSender;

use serde::Deserialize;
use serde_json::Value;
use tokio::sync::oneshot;
use ztl_script::event::RunCommand;
use ztl_script::{RunnerHandle, SeenStops};

use crate::clock::now_ms;
use crate::goal::LATEST_MS;
use crate::stop::Stops;

/// Longest note, in bytes.
const NOTE: usize = 1000;

/// Reaches the show from any thread.
pub(crate) struct ShowHandle {
    pub(super) runner: RunnerHandle,
    pub(super) presses: SyncSender<Press>,
}

/// What a client wants of the show.
#[derive(Debug)]
pub(crate) enum Wish {
    Command(RunCommand, Option<u64>),
    Cue(usize),
    Note(String),
}

/// The answer to a press.
pub(crate) type Told = Result<Value, String>;

pub(super) struct Press {
    pub(super) wish: Wish,
    pub(super) by: String,
    /// Until when it counts, by the console's clock.
    pub(super) not_after_ms: u64,
    /// What was stopped before.
    pub(super) seen: SeenStops,
    pub(super) told: oneshot::Sender<Told>,
}

impl ShowHandle {
    /// Stops everything. When this returns, nothing is sent any more that the show has decided before.
    pub(crate) fn stop_all(&self) {
        self.runner.stop_all();
    }

    /// Passes a press to the show.
    ///
    /// # Errors
    /// If it is not passed.
    pub(crate) fn press(
        &self,
        wish: Wish,
        by: &str,
        not_after_ms: u64,
        stops: &Stops,
    ) -> Result<oneshot::Receiver<Told>, String> {
        // Before the look at Stop: one that begins in between is noticed by the show.
        let seen = self.runner.seen();
        if wish.starts() && stops.are_under_way() {
            return Err("a Stop is under way: press again when it has ended".to_owned());
        }
        let (told, telling) = oneshot::channel();
        let press = Press {
            wish,
            by: by.to_owned(),
            not_after_ms: not_after_ms.min(now_ms() + LATEST_MS),
            seen,
            told,
        };
        self.presses
            .try_send(press)
            .map_err(|_| "the show does not answer: nothing was done".to_owned())?;
        self.runner.wake();
        Ok(telling)
    }
}

impl Wish {
    /// What `/ztl/show/command` asks for.
    ///
    /// # Errors
    /// If it is not a command of the page.
    pub(crate) fn command(args: Value) -> Result<Self, String> {
        #[derive(Deserialize)]
        struct Question {
            question: Option<u64>,
        }
        let wrong = |error| {
            format!(
                "expected {{\"do\": command, \"question\": number of the open question}}: {error}"
            )
        };
        let Question { question } = serde_json::from_value(args.clone()).map_err(wrong)?;
        let command: RunCommand = serde_json::from_value(args).map_err(wrong)?;
        match command {
            RunCommand::Leave | RunCommand::Stop | RunCommand::StopAll => {
                Err("the show ends with the console; /ztl/stop stops everything".to_owned())
            }
            command => Ok(Self::Command(command, question)),
        }
    }

    /// Stops the scene that plays.
    pub(crate) fn stop_scene() -> Self {
        Self::Command(RunCommand::StopScene, None)
    }

    /// What `/ztl/show/note` asks for.
    ///
    /// # Errors
    /// If there is no text.
    pub(crate) fn note(args: Value) -> Result<Self, String> {
        let text = args.get("text").and_then(Value::as_str).map(str::trim);
        match text {
            None | Some("") => Err("expected {\"text\": the note}".to_owned()),
            Some(text) if text.len() > NOTE => Err(format!("a note has at most {NOTE} bytes")),
            Some(text) => Ok(Self::Note(text.to_owned())),
        }
    }

    /// What `/ztl/show/cue` asks for.
    ///
    /// # Errors
    /// If it is no cue.
    pub(crate) fn cue(args: Value) -> Result<Self, String> {
        let cue = args.get("cue").and_then(Value::as_u64);
        let cue = cue.ok_or("expected {\"cue\": number of the cue, from 0}")?;
        usize::try_from(cue)
            .map(Self::Cue)
            .map_err(|error| error.to_string())
    }

    /// Whether it may start something.
    pub(super) fn starts(&self) -> bool {
        !matches!(self, Self::Note(_)) && !self.stops()
    }

    /// Whether it only stops something.
    pub(crate) fn stops(&self) -> bool {
        matches!(self, Self::Command(RunCommand::StopScene, _))
    }
}
