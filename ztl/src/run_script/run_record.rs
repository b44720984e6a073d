//! The record of a run: a line for each event, or a recording that has what publishers publish beside them.

use std::path::Path;

use ztl_script::event::StampedEvent;
use ztl_script::record::Recorder;
use ztl_std::Remotes;

#[cfg(feature = "record")]
use in_recording::InRecording;

/// Topics with sound.
#[cfg(feature = "record")]
type Sounds<'a> = &'a [(String, ztl_record::SoundFormat)];
#[cfg(not(feature = "record"))]
type Sounds<'a> = ();

/// Writes the events of a run.
pub(crate) enum RunRecord {
    Lines(Recorder),
    #[cfg(feature = "record")]
    Recording(InRecording),
}

impl RunRecord {
    /// Creates the file: a recording if its name ends with `.mcap`, of the publishers in `remotes`. `wake` is
    /// called when there are warnings.
    pub(crate) fn create(
        path: &Path,
        (remotes, sounds): (&Remotes, Sounds<'_>),
        wake: impl Fn() + Send + Sync + 'static,
    ) -> Result<Self, Box<dyn std::error::Error>> {
        if !crate::report::is_called_recording(path) {
            return Ok(Self::Lines(Recorder::create(path)?));
        }
        #[cfg(feature = "record")]
        return InRecording::create(path, (remotes, sounds), wake).map(Self::Recording);
        #[cfg(not(feature = "record"))]
        {
            let _ = (remotes, sounds, wake);
            let path = path.display();
            Err(format!(
                "{path} would be a recording, which this build cannot write (docs/dist.md); give a name such as run.jsonl"
            )
            .into())
        }
    }

    /// Writes an event. An error is a warning for the operator; the run goes on.
    pub(crate) fn write(&mut self, event: &StampedEvent) -> Result<(), String> {
        match self {
            Self::Lines(lines) => lines.write(event).map_err(|error| error.to_string()),
            #[cfg(feature = "record")]
            Self::Recording(recording) => recording.write(event),
        }
    }

    /// What the operator should know of it since the last call.
    pub(crate) fn warnings(&self) -> Vec<String> {
        match self {
            Self::Lines(_) => Vec::new(),
            #[cfg(feature = "record")]
            Self::Recording(recording) => recording.warnings(),
        }
    }

    /// Ends it after the run. An error says what it lacks.
    pub(crate) fn finish(self) -> Result<(), String> {
        match self {
            Self::Lines(_) => Ok(()),
            #[cfg(feature = "record")]
            Self::Recording(recording) => recording.finish(),
        }
    }
}

#[cfg(feature = "record")]
mod in_recording {
    use std::path::Path;
    use std::sync::mpsc::{Receiver, Sender, channel};
    use std::sync::{Arc, Mutex, PoisonError};
    use std::thread::JoinHandle;
    use std::time::{Duration, Instant};

    use ztl_record::{Formats, Message, Source};
    use ztl_script::event::StampedEvent;
    use ztl_std::Remotes;

    use crate::chosen_publisher::ChosenPublisher;
    use crate::connect_options::KeyOptions;
    use crate::recorder::{Recorder, Session, Told, set_tellers};

    /// How long servers may take to publish what has become of the last tasks; a client hears of it earlier.
    const LAST_EVENTS: Duration = Duration::from_millis(300);

    /// Writes events into a recording. A thread does it, so that the run never waits for the disk.
    pub(crate) struct InRecording {
        recorder: Recorder,
        events: Sender<(Message, Instant)>,
        writer: JoinHandle<()>,
        warnings: Arc<Mutex<Vec<String>>>,
        /// When the run began.
        start: Option<Instant>,
    }

    impl InRecording {
        pub(super) fn create(
            path: &Path,
            (remotes, sounds): (&Remotes, super::Sounds<'_>),
            wake: impl Fn() + Send + Sync + 'static,
        ) -> Result<Self, Box<dyn std::error::Error>> {
            let mut formats = Formats::default();
            set_tellers(&mut formats, remotes);
            for (topic, format) in sounds {
                formats.set_sound(topic, *format);
            }
            let keys = KeyOptions::default();
            let publishers = remotes.publisher_names().map(|name| {
                let publisher = ChosenPublisher::named(name, remotes.publisher(name)?.clone());
                publisher.connect(&[], &keys)
            });
            let publishers = publishers.collect::<Result<_, _>>()?;
            let warnings = Arc::<Mutex<Vec<String>>>::default();
            let told = Arc::clone(&warnings);
            let tell = move |what: Told| {
                let text = match what {
                    Told::Note(_) => return,
                    Told::Warning(text) => format!("the recording: {text}"),
                    Told::Failed(text) => format!("{text}; the show goes on"),
                };
                told.lock()
                    .unwrap_or_else(PoisonError::into_inner)
                    .push(text);
                wake();
            };
            let recorder = Recorder::start(path, formats, publishers, Box::new(tell))?;
            let (events, inbox) = channel();
            let session = recorder.session();
            let writer = std::thread::Builder::new()
                .name("ztl-run-record".to_owned())
                .spawn(move || write_all(&session, &inbox))?;
            Ok(Self {
                recorder,
                events,
                writer,
                warnings,
                start: None,
            })
        }

        pub(super) fn write(&mut self, event: &StampedEvent) -> Result<(), String> {
            let now = Instant::now();
            // The run's clock is monotonic, too.
            let start = *self
                .start
                .get_or_insert(now.checked_sub(event.at).unwrap_or(now));
            let json = serde_json::to_vec(event).map_err(|error| error.to_string())?;
            // Fails only after a panic there, which is printed.
            let _ = self
                .events
                .send((Message::of_run(json, event.wall), start + event.at));
            Ok(())
        }

        pub(super) fn warnings(&self) -> Vec<String> {
            let mut warnings = self.warnings.lock().unwrap_or_else(PoisonError::into_inner);
            std::mem::take(&mut *warnings)
        }

        pub(super) fn finish(self) -> Result<(), String> {
            drop(self.events);
            let _ = self.writer.join();
            std::thread::sleep(LAST_EVENTS);
            let counts = self.recorder.finish()?;
            match counts.is_complete() {
                true => Ok(()),
                false => Err(format!("the recording is not complete: {counts}")),
            }
        }
    }

    /// Writes events until there are no more.
    fn write_all(session: &Session, inbox: &Receiver<(Message, Instant)>) {
        let source = Source::named("ztl run-script");
        for (message, at) in inbox {
            session.write(&source, message, at);
        }
    }
}
