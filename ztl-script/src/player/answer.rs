//! What servers say, and that they say nothing.

use std::time::Duration;

use ztl_core::integer::Integer;
use ztl_core::{Instant, State};

use super::super::event::{Event, RequestNumber, ServerState, TaskNumber, TaskState, Why};
use super::stop::UNNAMED;
use super::{Answer, POLL, Phase, Player, Sent, Server, What};
use ztl_std::RemoteId;

/// An answer that was to be held and came sooner than this was not held.
const NOT_HELD: Duration = Duration::from_millis(20);

/// Pause between two questions about a task in the background whose server does not answer.
const PATIENT_POLL: Duration = Duration::from_secs(5);

impl Player {
    /// What came of a request. One that is not under way (any more) is ignored.
    pub fn handle_answer(&mut self, now: Instant, request: RequestNumber, answer: Answer) {
        let Some(sent) = self.under_way.remove(&request) else {
            return;
        };
        self.tell_answer(now, request, &sent, &answer);
        if matches!(self.phase, Phase::Over(_)) {
            return;
        }
        self.note_server(&sent, &answer);
        match (sent.what, sent.task) {
            (What::Init, Some(task)) => self.on_init(now, task, answer),
            (What::Status { held }, Some(task)) => {
                let waited = now.since(sent.at);
                self.on_status(now, task, (held && waited >= NOT_HELD, answer));
            }
            (What::Abort, Some(task)) => self.on_abort(now, task, answer),
            (What::Probe, _) => self.on_probe(now, &sent.remote),
            (What::Tasks, _) => self.on_tasks(now, &sent.remote, answer),
            _ => {}
        }
        self.watch(now);
        self.advance(now);
    }

    fn tell_answer(&mut self, now: Instant, request: RequestNumber, sent: &Sent, answer: &Answer) {
        let latency = now.since(sent.at);
        let Some(task) = sent.task else { return };
        let task_id = self.tasks.get(&task).and_then(|task| task.id.clone());
        let task_id = task_id.unwrap_or_else(|| Integer::MINUS_ONE.into());
        let (state, id, text) = match answer {
            Answer::Started { id, text, .. } => (State::Accepted, id.clone(), text),
            Answer::Refused { id, text } => (State::Failed, id.clone(), text),
            Answer::Task { state, text } => (*state, task_id, text),
            Answer::TaskUnknown { text, .. } => (State::Rejected, task_id, text),
            Answer::NotTold { text } | Answer::Unclear { text } => {
                return self.tell_nothing(now, request, sent, true, text);
            }
            Answer::NotStarted { text } => {
                return self.tell_nothing(now, request, sent, false, text);
            }
            Answer::Nothing {
                sent: was_sent,
                text,
            } => {
                return self.tell_nothing(now, request, sent, *was_sent, text);
            }
            // Not about a task.
            Answer::There { .. } | Answer::NoScope { .. } | Answer::Tasks { .. } => return,
        };
        let state = i64::from(state.code());
        let text = text.clone();
        self.events.push_back(Event::Answered {
            request,
            latency,
            state,
            id,
            text,
        });
    }

    fn tell_nothing(
        &mut self,
        now: Instant,
        request: RequestNumber,
        sent: &Sent,
        was_sent: bool,
        text: &str,
    ) {
        let (waited, text) = (now.since(sent.at), text.to_owned());
        self.events.push_back(Event::Unanswered {
            request,
            waited,
            sent: was_sent,
            text,
        });
    }

    /// What an answer says of the server.
    fn note_server(&mut self, sent: &Sent, answer: &Answer) {
        let remote = sent.remote.clone();
        let task = sent.task.and_then(|task| self.tasks.get(&task));
        let known = self.servers.get(&remote);
        let answering = || match known {
            Some(known @ ServerState::Answering { .. }) => known.clone(),
            _ => ServerState::Answering { version: None },
        };
        let state = match answer {
            Answer::Started { server, .. } | Answer::There { server } => ServerState::Answering {
                version: match server {
                    Server::Ours { version, .. } => Some(version.clone()),
                    Server::Original => None,
                },
            },
            Answer::Refused { .. }
            | Answer::Task { .. }
            | Answer::NotTold { .. }
            | Answer::Unclear { .. }
            | Answer::Tasks { .. } => answering(),
            Answer::TaskUnknown { boot, .. }
                if task.is_some_and(|task| task.is_of_an_older(*boot)) =>
            {
                ServerState::Restarted
            }
            Answer::TaskUnknown { .. } => answering(),
            Answer::NotStarted { text }
            | Answer::NoScope { text }
            | Answer::Nothing { sent: false, text } => ServerState::Absent { text: text.clone() },
            Answer::Nothing { .. } => ServerState::Silent,
        };
        if known != Some(&state) {
            self.servers.insert(remote.clone(), state.clone());
            self.events.push_back(Event::Server { remote, state });
        }
    }

    fn on_init(&mut self, now: Instant, number: TaskNumber, answer: Answer) {
        let stopping = self.is_stopping(number);
        let Some(task) = self.tasks.get_mut(&number) else {
            return;
        };
        match answer {
            Answer::Started { id, text, server } => {
                task.id = Some(id.clone());
                let remote = task.remote.clone();
                task.ours = matches!(server, Server::Ours { .. });
                task.boot = match server {
                    Server::Ours { boot, .. } => Some(boot),
                    Server::Original => None,
                };
                task.next = now;
                let plan = task
                    .place
                    .and_then(|(scene, step, part)| self.script.step(scene, step)?.tasks.get(part));
                task.deadline = plan.and_then(|plan| plan.limit).map(|limit| now + limit);
                self.set_state(number, TaskState::Accepted, &text);
                self.forget_namesakes(now, number, &id, &remote);
                if stopping {
                    self.abort(now, number);
                }
            }
            Answer::Refused { text, .. } => self.set_state(number, TaskState::Refused, &text),
            Answer::NotStarted { text } | Answer::Nothing { sent: false, text } => {
                task.absent = true;
                self.set_state(number, TaskState::NotStarted, &text);
            }
            Answer::Nothing { text, .. } | Answer::Unclear { text } => {
                self.set_unknown(now, number, Why::StartUnknown, &text);
                self.unresolved.insert(number);
                if stopping {
                    self.tell_stop(number, false, UNNAMED);
                }
            }
            // Not an answer to an INIT.
            _ => {}
        }
    }

    /// A server that gives an id twice was started anew, as the original's, which counts from 1. What it says of
    /// the id from now on is about the new task: nobody will ever know of the one that had it.
    fn forget_namesakes(&mut self, now: Instant, number: TaskNumber, id: &RemoteId, remote: &str) {
        let is_namesake = |other: &TaskNumber| {
            let task = self.tasks.get(other);
            *other != number
                && task.is_some_and(|task| {
                    task.id.as_ref() == Some(id) && task.remote == remote && task.is_open()
                })
        };
        let namesakes: Vec<TaskNumber> = self.live.iter().copied().filter(is_namesake).collect();
        for other in namesakes {
            let remote = remote.to_owned();
            let text = format!("another task has its id {id} now");
            self.set_unknown(now, other, Why::ServerRestarted { remote }, &text);
            self.unresolved.insert(other);
        }
    }

    /// `was_held`: an answer that has taken its time.
    fn on_status(&mut self, now: Instant, number: TaskNumber, (was_held, answer): (bool, Answer)) {
        let Some(task) = self.tasks.get_mut(&number) else {
            return;
        };
        task.asked = None;
        // Of one that is forgotten, what was asked before that tells nothing.
        if task.state.is_over() || !task.can_be_asked() {
            return;
        }
        task.next = if was_held { now } else { now + POLL };
        // What nobody waits for is not asked after all the time while its server is silent.
        if task.unknown.is_some() && !task.is_open() {
            task.next = now + PATIENT_POLL;
        }
        self.on_known(now, number, answer);
    }

    /// What a server says of a task that it took.
    pub(super) fn on_known(&mut self, now: Instant, number: TaskNumber, answer: Answer) {
        let Some(task) = self.tasks.get(&number) else {
            return;
        };
        if task.state.is_over() {
            return;
        }
        let remote = task.remote.clone();
        match answer {
            Answer::Task { state, text } => self.set_state(number, state.into(), &text),
            Answer::TaskUnknown { boot, text } => {
                let why = match task.is_of_an_older(boot) {
                    true => Why::ServerRestarted { remote },
                    false => Why::TaskUnknown,
                };
                self.set_unknown(now, number, why, &text);
                self.unresolved.insert(number);
            }
            Answer::Unclear { text } => {
                self.set_unknown(now, number, Why::AnswerUnclear { remote }, &text);
                self.unresolved.insert(number);
            }
            Answer::NotTold { text } if task.can_be_asked() => {
                self.set_unknown(now, number, Why::NotTold { remote }, &text);
            }
            Answer::Nothing { text, .. } if task.can_be_asked() => {
                self.set_unknown(now, number, Why::ServerSilent { remote }, &text);
            }
            // Not an answer about a task.
            _ => {}
        }
    }
}
