//! Records what publishers publish into a file, on threads of its own: `ztl record`, and `ztl run-script --record`.

use std::fmt;
use std::fs::File;
use std::io;
use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use ztl_record::{Formats, Message, Recording, Source, Written};
use ztl_std::Remotes;

use crate::chosen_publisher::{Connected, Noticed, Presence};
use crate::terminal::flat;

/// How often the recording is brought to the disk. With the time that this takes, less than a second is lost when the
/// recorder is killed.
const FLUSH: Duration = Duration::from_millis(300);
/// How often threads look whether the recording has ended.
const TURN: Duration = Duration::from_millis(100);
/// Most messages of a publisher that are reported one by one as left out.
const TOLD: u64 = 10;

/// What people should know of a recording.
#[derive(Debug, Clone)]
pub(crate) enum Told {
    /// All is well.
    Note(String),
    /// Something is missing in it.
    Warning(String),
    /// It has ended early.
    Failed(String),
}

/// Tells people, from any thread.
pub(crate) type Tell = Box<dyn Fn(Told) + Send + Sync>;

/// A recording that is being made.
pub(crate) struct Recorder {
    session: Arc<Session>,
    threads: Vec<JoinHandle<()>>,
}

impl Recorder {
    /// Creates the file, and records these publishers into it.
    pub(crate) fn start(
        path: &Path,
        formats: Formats,
        publishers: Vec<Connected>,
        tell: Tell,
    ) -> Result<Self, String> {
        let cannot_write = |error: io::Error| format!("cannot write {}: {error}", path.display());
        let recording = Recording::create(path).map_err(cannot_write)?;
        let disk = recording.file().map_err(cannot_write)?;
        let session = Arc::new(Session {
            path: path.display().to_string(),
            formats,
            recording: Mutex::new(Some(recording)),
            state: Mutex::default(),
            tell,
        });
        let mut recorder = Self {
            session,
            threads: Vec::new(),
        };
        recorder.spawn("ztl-disk", move |session| session.keep_flushed(&disk))?;
        for publisher in publishers {
            let name = format!("ztl-{}", publisher.name);
            recorder.spawn(&name, move |session| session.hear(publisher))?;
        }
        Ok(recorder)
    }

    fn spawn(
        &mut self,
        name: &str,
        work: impl FnOnce(&Session) + Send + 'static,
    ) -> Result<(), String> {
        let session = Arc::clone(&self.session);
        let thread = std::thread::Builder::new().name(name.to_owned());
        let thread = thread.spawn(move || work(&session));
        self.threads
            .push(thread.map_err(|error| format!("no thread to record with: {error}"))?);
        Ok(())
    }

    /// What threads write into.
    pub(crate) fn session(&self) -> Arc<Session> {
        Arc::clone(&self.session)
    }

    /// Whether the recording has ended early.
    pub(crate) fn has_failed(&self) -> bool {
        self.session.state().failure.is_some()
    }

    /// Ends the recording. An error says why the file is not whole.
    pub(crate) fn finish(mut self) -> Result<Counts, String> {
        self.end();
        let session = &self.session;
        if let Some(failure) = session.state().failure.take() {
            return Err(failure);
        }
        let Some(recording) = session.recording().take() else {
            return Err(format!("{} has ended already", session.path));
        };
        let counts = Counts {
            topics: recording.topics(),
            ..session.state().counts
        };
        let finished = recording.finish();
        finished.map_err(|error| session.failure_text(&error))?;
        Ok(counts)
    }

    fn end(&mut self) {
        self.session.state().is_over = true;
        for thread in self.threads.drain(..) {
            // A panic there has been printed already.
            let _ = thread.join();
        }
    }
}

impl Drop for Recorder {
    fn drop(&mut self) {
        self.end();
    }
}

/// Believes events of tasks of a scope only from the publisher with that scope in the configuration file, on the host of
/// its server if that is there, too.
pub(crate) fn set_tellers(formats: &mut Formats, remotes: &Remotes) {
    let servers: Vec<_> = remotes
        .task_names()
        .filter_map(|name| remotes.task(name).ok())
        .collect();
    let publishers = remotes.publisher_names();
    for publisher in publishers.filter_map(|name| remotes.publisher(name).ok()) {
        let mut servers = servers
            .iter()
            .filter(|server| server.scope == publisher.scope)
            .peekable();
        if servers.peek().is_none() || servers.any(|server| server.host == publisher.host) {
            formats.set_teller(&publisher.scope, &publisher.endpoint());
        }
    }
}

/// Numbers of messages.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Counts {
    recorded: u64,
    missed: u64,
    left_out: u64,
    topics: usize,
}

impl Counts {
    /// Whether it has all messages.
    pub(crate) const fn is_complete(&self) -> bool {
        self.missed == 0 && self.left_out == 0
    }
}

impl fmt::Display for Counts {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            recorded,
            missed,
            left_out,
            topics,
        } = self;
        write!(f, "{recorded} messages of {topics} topics, {missed} missed")?;
        match left_out {
            0 => Ok(()),
            number => write!(f, ", {number} left out"),
        }
    }
}

#[derive(Debug, Default)]
struct State {
    is_over: bool,
    /// Why it ended early.
    failure: Option<String>,
    counts: Counts,
}

/// What the threads of a recording share.
pub(crate) struct Session {
    path: String,
    formats: Formats,
    /// `None` when it has ended.
    recording: Mutex<Option<Recording>>,
    state: Mutex<State>,
    tell: Tell,
}

impl Session {
    fn recording(&self) -> MutexGuard<'_, Option<Recording>> {
        self.recording
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn is_over(&self) -> bool {
        let state = self.state();
        state.is_over || state.failure.is_some()
    }

    fn failure_text(&self, why: &dyn fmt::Display) -> String {
        let path = &self.path;
        format!(
            "cannot write {path}: {why}; the recording has ended, what was written before is readable"
        )
    }

    fn fail(&self, why: &dyn fmt::Display) {
        let text = self.failure_text(why);
        let mut state = self.state();
        // The first failure is the cause of the others.
        if state.failure.is_none() {
            state.failure = Some(text.clone());
            drop(state);
            (self.tell)(Told::Failed(text));
        }
    }

    /// Writes a message that was received at this time. `None` after a failure.
    pub(crate) fn write(&self, source: &Source, message: Message, at: Instant) -> Option<Written> {
        let written = match self.recording().as_mut()?.write(source, message, at) {
            Ok(written) => written,
            Err(error) => {
                self.fail(&error);
                return None;
            }
        };
        let counts = &mut self.state().counts;
        match written {
            Written::Yes => counts.recorded += 1,
            Written::TooManyTopics => counts.left_out += 1,
        }
        Some(written)
    }

    /// Brings what was recorded to the disk, until the end.
    fn keep_flushed(&self, disk: &File) {
        let mut next = Instant::now() + FLUSH;
        while !self.is_over() {
            std::thread::sleep(TURN);
            if Instant::now() < next {
                continue;
            }
            next = Instant::now() + FLUSH;
            let flushed = self.recording().as_mut().map_or(Ok(()), Recording::flush);
            // Others may write while the disk works.
            if let Err(error) = flushed.and_then(|()| disk.sync_data()) {
                self.fail(&error);
            }
        }
    }

    /// Records what a publisher publishes, until the end.
    fn hear(&self, publisher: Connected) {
        let source = Source {
            name: publisher.name,
            endpoint: publisher.endpoint,
            key: publisher.key.map(|key| key.to_string()).unwrap_or_default(),
        };
        let mut subscriber = publisher.subscriber;
        let mut said = Said::new(&source.name, &self.tell);
        let (mut missed, mut damaged) = (0, 0);
        while !self.is_over() {
            let heard = match subscriber.next_within(TURN) {
                Ok(heard) => heard,
                Err(error) => return self.fail(&error),
            };
            let at = Instant::now();
            said.on_connection(subscriber.is_connected());
            if subscriber.missed() > missed {
                self.state().counts.missed += subscriber.missed() - missed;
                missed = subscriber.missed();
            }
            if subscriber.damaged() > damaged {
                self.state().counts.left_out += subscriber.damaged() - damaged;
                damaged = subscriber.damaged();
            }
            let Some(heard) = heard else { continue };
            let message = match self.formats.prepare(&source, &heard.topic, &heard.body) {
                Ok(message) => message,
                Err(error) => {
                    said.left_out(&heard.topic, format_args!("left out: {error}"));
                    self.state().counts.left_out += 1;
                    continue;
                }
            };
            if message.is_foreign_event() {
                let why = "recorded as a value, not as an event of a task: another publisher tells of the tasks of this scope";
                said.left_out(&heard.topic, why);
            }
            if self.write(&source, message, at) == Some(Written::TooManyTopics) {
                said.left_out(&heard.topic, "left out: there are too many topics");
            }
        }
    }
}

/// What was said about a publisher.
struct Said<'a> {
    name: &'a str,
    tell: &'a Tell,
    presence: Presence,
    left_out: u64,
}

impl<'a> Said<'a> {
    fn new(name: &'a str, tell: &'a Tell) -> Self {
        Self {
            name,
            tell,
            presence: Presence::new(),
            left_out: 0,
        }
    }

    fn on_connection(&mut self, is_connected: bool) {
        let Some(noticed) = self.presence.notice(is_connected) else {
            return;
        };
        let name = flat(self.name);
        (self.tell)(match noticed {
            Noticed::Connected => Told::Note(format!("{name}: connected")),
            Noticed::Lost => Told::Warning(format!(
                "{name}: connection lost; it is recorded again when it is back"
            )),
            Noticed::Absent => Told::Warning(format!(
                "{name}: not connected; it is recorded as soon as it is there"
            )),
        });
    }

    fn left_out(&mut self, topic: &str, why: impl fmt::Display) {
        self.left_out += 1;
        let (name, topic) = (flat(self.name), flat(topic));
        if self.left_out <= TOLD {
            (self.tell)(Told::Warning(format!("{name}: {topic} is {why}")));
        }
    }
}
