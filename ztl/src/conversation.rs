//! What the original's three clients do: ask for a task, wait for it, abort it when the time is over
//! (wire specification 7.2, 7.3, 7.5). Each says it in words of its own, or as JSON for programs.

mod json;
mod words;

use std::cell::{Cell, RefCell};
use std::net::ToSocketAddrs;
use std::process::ExitCode;
use std::time::{Duration, Instant};

use ztl_core::dispatcher::NOTHING_KNOWN;
use ztl_std::{RemoteId, RemoteTask, RequestError, State, Status, TriggerError, WaitError};

use crate::exit::Done;
use crate::signals;
pub(crate) use words::Words;

/// What is said at the end of a client's help.
pub(crate) const AFTER_HELP: &str = "\
With --exit-status: 0 completed, 1 refused, 3 failed, 4 aborted, 5 unknown, or no server was reached.
Ctrl-C aborts the task, a second one leaves at once; without --exit-status the code is then 130. SIGTERM
aborts it too, waits at most 2 s for the answer, and the code is 143.";

/// As long as the original waits after an abort that was refused. Whoever sends SIGTERM does not wait.
const AFTER_ABORT: Duration = Duration::from_secs(5);

/// Pause between two tries to abort a task whose server does not answer.
const PAUSE: Duration = Duration::from_millis(50);

/// How a task ended for its client.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Fate {
    Completed,
    Refused,
    Failed,
    Aborted,
    /// It may run, or have ended in any way.
    Unknown,
    /// It does not run, and was not refused: no server was reached, or the INIT never came to it.
    NotStarted,
}

impl Fate {
    /// Of a task that was taken.
    const fn of(state: State) -> Self {
        match state {
            State::Completed => Self::Completed,
            State::Rejected => Self::Refused,
            State::Failed => Self::Failed,
            State::Aborted => Self::Aborted,
            State::Initiated | State::Accepted => Self::Unknown,
        }
    }

    /// As an exit code.
    const fn code(self) -> u8 {
        match self {
            Self::Completed => 0,
            Self::Refused => 1,
            Self::Failed => 3,
            Self::Aborted => 4,
            Self::Unknown | Self::NotStarted => 5,
        }
    }
}

/// Something that a person or a program is told.
#[derive(Debug)]
enum News<'a> {
    /// The task is asked for.
    Asking,
    /// Ctrl-C, before the INIT was answered.
    Interrupted,
    Started {
        id: &'a RemoteId,
        reply: &'a str,
    },
    /// Where it is; told as often as the server is asked.
    Progress {
        id: &'a RemoteId,
        status: &'a Status,
    },
    /// The limit was reached, or Ctrl-C was pressed.
    Aborting {
        id: &'a RemoteId,
        interrupted: bool,
    },
    /// It goes on all the same.
    NotAborted {
        id: &'a RemoteId,
        reply: &'a str,
        /// Whether its end is waited for a little longer.
        waits: bool,
    },
    /// The last news.
    Over(Over<'a>),
}

/// How it is over.
#[derive(Debug)]
enum Over<'a> {
    /// The INIT led to no task, or nobody knows to which.
    NotTriggered {
        /// As the original tells it: the server's; `None` stands for -1.
        id: Option<RemoteId>,
        reason: &'a str,
        fate: Fate,
    },
    /// It ended while it was waited for.
    Ended {
        id: &'a RemoteId,
        status: &'a Status,
    },
    /// The server's answer does not tell where the task is.
    Lost {
        id: &'a RemoteId,
        reason: &'a str,
        answered: Option<Answered<'a>>,
    },
    /// The answer to the abort does not tell where the task is.
    StopUnclear { id: &'a RemoteId, reason: &'a str },
    /// It ended when it was aborted: as ABORTED, or otherwise just before.
    Stopped {
        id: &'a RemoteId,
        status: &'a Status,
        /// Its last words, for programs; the answer to an abort does not tell them.
        words: &'a str,
    },
    /// What is known of it some time after an abort that was refused or not answered.
    After {
        id: &'a RemoteId,
        /// The state, if the server told one.
        state: Option<State>,
        text: &'a str,
        /// What the abort was answered.
        reply: &'a str,
    },
    /// It was not stopped, and there is no time to wait for its end.
    Left { id: &'a RemoteId, reply: &'a str },
}

/// An answer that does not tell where the task is, as the original takes it for an end: the state, if
/// ZTL defines it, and the text.
type Answered<'a> = (Option<State>, &'a str);

fn answered(error: &RequestError) -> Option<Answered<'_>> {
    match error {
        RequestError::UnknownTask { text, .. } => Some((Some(State::Rejected), text)),
        RequestError::NotTold { state, text } => Some((Some(*state), text)),
        RequestError::UnknownEnd { text } => Some((Some(State::Failed), text)),
        RequestError::OtherTask { state, text, .. } => Some((*state, text)),
        RequestError::UndefinedState { text, .. } => Some((None, text)),
        _ => None,
    }
}

impl Over<'_> {
    fn fate(&self) -> Fate {
        match self {
            Self::NotTriggered { fate, .. } => *fate,
            Self::Ended { status, .. } | Self::Stopped { status, .. } => Fate::of(status.state),
            Self::Lost { .. } | Self::StopUnclear { .. } | Self::Left { .. } => Fate::Unknown,
            Self::After { state, .. } => state.map_or(Fate::Unknown, Fate::of),
        }
    }
}

/// How a client tells what happens.
#[derive(Debug, clap::Args)]
pub(crate) struct Telling {
    /// Tell the task's fate by the exit code (the original's is always 0)
    #[arg(long)]
    exit_status: bool,

    /// Tell what happens as JSON, one object a line (docs/tools.md)
    #[arg(long)]
    json: bool,
}

/// Which server is meant, as a person has named it.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Target<'a> {
    pub(crate) host: &'a str,
    /// Of the original's tools any number.
    pub(crate) port: i64,
    pub(crate) scope: &'a str,
}

impl Target<'_> {
    /// A client of it.
    pub(crate) fn connect(&self) -> Result<RemoteTask, Box<dyn std::error::Error>> {
        let Self { host, port, scope } = self;
        let port = u16::try_from(*port)
            .map_err(|_| format!("invalid port '{port}': expected 0 to 65535"))?;
        let remote = RemoteTask::connect(&format!("tcp://{host}:{port}"), scope);
        Ok(remote.map_err(|error| no_client(host, error))?)
    }
}

/// Why there is no client of this host.
pub(crate) fn no_client(host: &str, error: RequestError) -> String {
    match error {
        RequestError::Transport(_) => format!("'{host}' is no name or address of a host"),
        error => error.to_string(),
    }
}

/// A task to be asked for.
pub(crate) struct Conversation<'a> {
    pub(crate) target: Target<'a>,
    /// The payload of the INIT.
    pub(crate) request: &'a str,
    pub(crate) words: Words,
    /// Called by the original's name: the lines are the original's, also where they say less.
    pub(crate) as_original: bool,
    pub(crate) telling: &'a Telling,
}

impl Conversation<'_> {
    /// Says where it connects to, connects, and does the rest.
    pub(crate) fn run(
        &self,
        identify: impl FnOnce(RemoteTask) -> Result<RemoteTask, Box<dyn std::error::Error>>,
    ) -> Done {
        // Whoever is in a hurry leaves, and the task goes on.
        signals::leave_at_the_second();
        if !self.telling.json {
            words::connecting(self);
        }
        let fate = if self.target.port > i64::from(u16::MAX) {
            self.not_connected()
        } else {
            let mut remote = identify(self.target.connect()?)?;
            self.play(&mut remote)
        };
        Ok(match self.telling.exit_status {
            true => ExitCode::from(fate.code()),
            false => signals::exit_code().unwrap_or(ExitCode::SUCCESS),
        })
    }

    /// The original's tools go on with such a port, and find nobody there.
    fn not_connected(&self) -> Fate {
        let mut tell = self.teller();
        tell(News::Asking);
        let port = self.target.port;
        let reason = &format!("invalid port '{port}': expected 0 to 65535; nothing was sent");
        let fate = Fate::NotStarted;
        over(
            tell,
            Over::NotTriggered {
                id: None,
                reason,
                fate,
            },
        )
    }

    fn play(&self, remote: &mut RemoteTask) -> Fate {
        let teller = RefCell::new(self.teller());
        let tell = |news: News<'_>| teller.borrow_mut()(news);
        tell(News::Asking);
        let told = Cell::new(false);
        let triggered = remote.trigger_while(self.request, || {
            let stopped = signals::stopped();
            if stopped && !told.replace(true) {
                teller.borrow_mut()(News::Interrupted);
            }
            !stopped
        });
        let (id, reply) = match triggered {
            Ok(task) => (task.id, task.reply),
            Err(error) => return self.not_triggered(error, tell),
        };
        let (id, reply) = (&id, &reply);
        tell(News::Started { id, reply });
        if signals::stopped() {
            return self.abort(remote, id, tell);
        }
        let ended = remote.wait_with(id, self.words.limit(), |answer| {
            if let Ok(status) = answer
                && !status.state.is_final()
            {
                tell(News::Progress { id, status });
            }
            !signals::stopped()
        });
        match ended {
            Ok(status) => over(
                tell,
                Over::Ended {
                    id,
                    status: &status,
                },
            ),
            Err(WaitError { last: Err(cause) }) if cause.was_answered() => {
                let reason = &format!("unknown: {cause}");
                let answered = answered(&cause);
                let lost = Over::Lost {
                    id,
                    reason,
                    answered,
                };
                over(tell, lost)
            }
            Err(_) => self.abort(remote, id, tell),
        }
    }

    fn teller(&self) -> Box<dyn FnMut(News<'_>) + '_> {
        if self.telling.json {
            let mut teller = json::Teller::new(self);
            Box::new(move |news| teller.tell(&news))
        } else {
            let mut teller = words::Teller::new(self);
            Box::new(move |news| teller.tell(&news))
        }
    }

    fn not_triggered(&self, error: TriggerError, tell: impl FnMut(News<'_>)) -> Fate {
        let fate = match &error {
            TriggerError::Refused { .. } => Fate::Refused,
            TriggerError::NeverCame | TriggerError::GivenUp => Fate::NotStarted,
            TriggerError::Request(cause) if cause.nothing_was_sent() => Fate::NotStarted,
            _ => Fate::Unknown,
        };
        let (id, reason) = match error {
            TriggerError::Refused { id, reason } => (Some(id), reason),
            other => (None, format!("{other}{}", self.nameless())),
        };
        let reason = &reason;
        over(tell, Over::NotTriggered { id, reason, fate })
    }

    /// What is wrong with the host's name, if it has no address.
    fn nameless(&self) -> String {
        let Target { host, port, .. } = self.target;
        let port = u16::try_from(port).unwrap_or_default();
        match (host, port).to_socket_addrs() {
            Ok(_) => String::new(),
            Err(_) => format!("; no host '{host}' is known"),
        }
    }

    /// The limit was reached, or Ctrl-C was pressed.
    fn abort(
        &self,
        remote: &mut RemoteTask,
        id: &RemoteId,
        mut tell: impl FnMut(News<'_>),
    ) -> Fate {
        let interrupted = signals::stopped();
        tell(News::Aborting { id, interrupted });
        let (reply, answered) = match insist(remote, id) {
            Ok(status) if status.state.is_final() => {
                match self.last_words(remote, id, status.state) {
                    Ok(words) => {
                        let (status, words) = (&status, words.as_str());
                        return over(tell, Over::Stopped { id, status, words });
                    }
                    Err(error) => {
                        let reason = &error.to_string();
                        return over(tell, Over::StopUnclear { id, reason });
                    }
                }
            }
            Ok(status) => (status.text, true),
            Err(error) if error.was_answered() => {
                let reason = &error.to_string();
                return over(tell, Over::StopUnclear { id, reason });
            }
            Err(error) => (error.to_string(), false),
        };
        let reply = &reply;
        let patient = || !signals::in_a_hurry();
        // A server that has been silent for so long is not waited for again.
        let waits = answered && patient();
        tell(News::NotAborted { id, reply, waits });
        let wait = || remote.wait_with(id, Some(AFTER_ABORT), |_| patient());
        let Some(waited) = waits.then(wait) else {
            return over(tell, Over::Left { id, reply });
        };
        let (state, text) = match waited {
            Ok(Status { state, text }) => (Some(state), text),
            Err(_) if !patient() => return over(tell, Over::Left { id, reply }),
            Err(WaitError {
                last: Ok(Status { state, text }),
            }) => (Some(state), text),
            Err(WaitError { last: Err(cause) }) => match self::answered(&cause) {
                Some((state, text)) if self.as_original => (state, text.to_owned()),
                _ => (None, cause.to_string()),
            },
        };
        let text = &text;
        let after = Over::After {
            id,
            state,
            text,
            reply,
        };
        over(tell, after)
    }

    /// What a task said that was aborted, if a program is to hear it. People see what the original's
    /// tools say, which do not ask.
    ///
    /// # Errors
    /// A failed task's server could not learn its end, or does not answer: the task may still run.
    fn last_words(
        &self,
        remote: &mut RemoteTask,
        id: &RemoteId,
        state: State,
    ) -> Result<String, RequestError> {
        let failed = state == State::Failed;
        if !self.telling.json && !failed {
            return Ok(String::new());
        }
        match remote.status(id) {
            Err(error) if failed || matches!(error, RequestError::UnknownEnd { .. }) => Err(error),
            Ok(last) if last.state == state && last.text != NOTHING_KNOWN => Ok(last.text),
            _ => Ok(String::new()),
        }
    }
}

/// Asks a server to stop a task, again while it does not answer: for 5 s, or once for whoever is in a hurry.
fn insist(remote: &mut RemoteTask, id: &RemoteId) -> Result<Status, RequestError> {
    let start = Instant::now();
    loop {
        match remote.send_abort(id) {
            Err(error)
                if !error.was_answered()
                    && start.elapsed() < AFTER_ABORT
                    && !signals::in_a_hurry() =>
            {
                // Some errors come at once.
                std::thread::sleep(PAUSE);
            }
            answer => return answer,
        }
    }
}

/// Tells the last news.
fn over(mut tell: impl FnMut(News<'_>), over: Over<'_>) -> Fate {
    let fate = over.fate();
    tell(News::Over(over));
    fate
}
