//! Answers of servers, and what they mean for tasks.

use std::time::Duration;

use ztl_core::integer::Integer;
use ztl_core::{Instant, State};
use ztl_std::RemoteId;

use super::state::{POLL, Pending, Phase, Player, RunTask};
use super::stop::UNNAMED;
use crate::event::{RequestNumber, RunEvent, ServerState, TaskNumber, TaskState, WaitReason};
use crate::server::{Server, ServerAnswer, ServerRequest};

/// Said about a task whose INIT was not sent.
const WITHDRAWN: &str = "not sent: it was stopped before, or it was too late";

/// A STATUS answered sooner than this was not held.
const NOT_HELD: Duration = Duration::from_millis(20);

/// Pause between two STATUS requests about a task in the background whose server does not answer.
const PATIENT_POLL: Duration = Duration::from_secs(5);

impl Player {
    /// Takes the answer to a request; ignores one whose request is not under way.
    pub(crate) fn handle_answer(
        &mut self,
        now: Instant,
        request: RequestNumber,
        answer: ServerAnswer,
    ) {
        let Some(sent) = self.under_way.remove(&request) else {
            return;
        };
        if let Some(event) = self.answer_event(now, request, &sent, &answer) {
            self.emit(event);
        }
        if matches!(self.phase, Phase::Over) {
            return;
        }
        self.note_server(&sent, &answer);
        let is_heard = !matches!(
            answer,
            ServerAnswer::Nothing { .. }
                | ServerAnswer::NotStarted { .. }
                | ServerAnswer::Withdrawn
        );
        match (sent.body, sent.task) {
            (ServerRequest::Init { .. }, Some(task)) => self.on_init(now, task, answer),
            (ServerRequest::Status { hold, .. }, Some(task)) => {
                let was_held = !hold.is_zero() && now.since(sent.at) >= NOT_HELD;
                self.on_status(now, task, was_held, answer);
            }
            (ServerRequest::Abort { .. }, Some(task)) => self.on_abort(now, task, answer),
            (ServerRequest::Probe, _) => self.on_probe(now, &sent.remote),
            (ServerRequest::Tasks, _) => self.on_tasks(now, &sent.remote, answer),
            _ => {}
        }
        if is_heard {
            self.repeat_lost_aborts(now, &sent.remote);
        }
        self.watch(now);
        self.advance(now);
    }

    /// The event for an answer about a task.
    fn answer_event(
        &self,
        now: Instant,
        request: RequestNumber,
        sent: &Pending,
        answer: &ServerAnswer,
    ) -> Option<RunEvent> {
        let latency = now.since(sent.at);
        let task = self.tasks.get(&sent.task?);
        let task_id = || {
            task.and_then(|task| task.id.clone())
                .unwrap_or_else(|| Integer::MINUS_ONE.into())
        };
        let unanswered = |sent, text: &str| {
            Some(RunEvent::Unanswered {
                request,
                waited: latency,
                sent,
                text: text.to_owned(),
            })
        };
        let (state, id, text) = match answer {
            ServerAnswer::Started { id, text, .. } => (State::Accepted, id.clone(), text),
            ServerAnswer::Rejected { id, text } => (State::Failed, id.clone(), text),
            ServerAnswer::Task { state, text } | ServerAnswer::CannotStop { state, text } => {
                (*state, task_id(), text)
            }
            ServerAnswer::TaskUnknown { text, .. } => (State::Rejected, task_id(), text),
            ServerAnswer::NotTold { text } | ServerAnswer::Unclear { text } => {
                return unanswered(true, text);
            }
            ServerAnswer::NotStarted { text } => return unanswered(false, text),
            ServerAnswer::Withdrawn => return unanswered(false, WITHDRAWN),
            ServerAnswer::Nothing { sent, text } => return unanswered(*sent, text),
            ServerAnswer::There { .. }
            | ServerAnswer::NoScope { .. }
            | ServerAnswer::Tasks { .. } => return None,
        };
        Some(RunEvent::Answered {
            request,
            latency,
            state: i64::from(state.code()),
            id,
            text: text.clone(),
        })
    }

    /// Updates the state of the server.
    fn note_server(&mut self, sent: &Pending, answer: &ServerAnswer) {
        let known = self.servers.get(&sent.remote);
        let is_restarted = |boot| {
            let task = sent.task.and_then(|task| self.tasks.get(&task));
            task.is_some_and(|task| task.is_of_an_earlier(boot))
        };
        let state = match answer {
            ServerAnswer::Started { server, .. } | ServerAnswer::There { server } => {
                ServerState::Answering {
                    version: match server {
                        Server::Ours { version, .. } => Some(version.clone()),
                        Server::Original => None,
                    },
                }
            }
            ServerAnswer::TaskUnknown { boot, .. } if is_restarted(*boot) => ServerState::Restarted,
            ServerAnswer::NotStarted { text }
            | ServerAnswer::NoScope { text }
            | ServerAnswer::Nothing { sent: false, text } => {
                ServerState::Absent { text: text.clone() }
            }
            ServerAnswer::Nothing { .. } => ServerState::Silent,
            // The server was not asked.
            ServerAnswer::Withdrawn => return,
            // A server lists its tasks also if it lacks the scope; a probe tells whether it is there again.
            ServerAnswer::Tasks { .. } if matches!(known, Some(ServerState::Absent { .. })) => {
                return;
            }
            _ => match known {
                Some(known @ ServerState::Answering { .. }) => known.clone(),
                _ => ServerState::Answering { version: None },
            },
        };
        if known != Some(&state) {
            let remote = sent.remote.clone();
            self.servers.insert(remote.clone(), state.clone());
            self.emit(RunEvent::Server { remote, state });
        }
    }

    fn on_init(&mut self, now: Instant, number: TaskNumber, answer: ServerAnswer) {
        let stopping = self.is_stopping(number);
        let Some(task) = self.tasks.get_mut(&number) else {
            return;
        };
        match answer {
            ServerAnswer::Started { id, text, server } => {
                task.id = Some(id.clone());
                let remote = task.remote.clone();
                if let Server::Ours { boot, .. } = server {
                    task.ours = true;
                    task.boot = Some(boot);
                }
                task.next = now;
                let of_step = task
                    .place
                    .and_then(|(scene, step, part)| self.script.step(scene, step)?.tasks.get(part));
                let of_cue = task
                    .cue
                    .and_then(|(cue, part)| self.script.cues.get(cue)?.step.tasks.get(part));
                let plan = of_step.or(of_cue);
                task.deadline = plan.and_then(|plan| plan.limit).map(|limit| now + limit);
                self.set_state(number, TaskState::Accepted, &text);
                self.forget_namesakes(now, number, &id, &remote);
                if stopping {
                    self.abort(now, number);
                }
            }
            ServerAnswer::Rejected { text, .. } => {
                self.set_state(number, TaskState::Refused, &text)
            }
            ServerAnswer::Withdrawn => self.set_state(number, TaskState::NotStarted, WITHDRAWN),
            ServerAnswer::NotStarted { text } | ServerAnswer::Nothing { sent: false, text } => {
                task.absent = true;
                self.set_state(number, TaskState::NotStarted, &text);
            }
            ServerAnswer::Nothing { text, .. } | ServerAnswer::Unclear { text } => {
                self.lose(now, number, WaitReason::StartUnknown, &text);
                if stopping {
                    self.tell_stop(number, false, UNNAMED);
                }
            }
            // Not an answer to an INIT.
            _ => {}
        }
    }

    /// A server that gives an id twice has restarted: the original's counts from 1 each time. From now on
    /// its answers about this id are about the new task, so the outcome of the earlier one is lost.
    fn forget_namesakes(&mut self, now: Instant, number: TaskNumber, id: &RemoteId, remote: &str) {
        let is_namesake = |other: &TaskNumber| {
            let same = |task: &RunTask| {
                task.id.as_ref() == Some(id) && task.remote == remote && task.is_open()
            };
            *other != number && self.tasks.get(other).is_some_and(same)
        };
        let namesakes: Vec<TaskNumber> = self.live.iter().copied().filter(is_namesake).collect();
        for other in namesakes {
            let remote = remote.to_owned();
            let text = format!("another task has its id {id} now");
            self.lose(now, other, WaitReason::ServerRestarted { remote }, &text);
        }
    }

    /// `was_held`: the answer took its time, so the next STATUS need not wait.
    fn on_status(
        &mut self,
        now: Instant,
        number: TaskNumber,
        was_held: bool,
        answer: ServerAnswer,
    ) {
        let Some(task) = self.tasks.get_mut(&number) else {
            return;
        };
        task.asked = None;
        // A reply that arrives after the outcome was lost is ignored.
        if task.state.is_over() || !task.can_be_asked() {
            return;
        }
        task.next = match (task.unknown.is_some() && !task.is_open(), was_held) {
            (true, _) => now + PATIENT_POLL,
            (false, true) => now,
            (false, false) => now + POLL,
        };
        self.on_known(now, number, answer);
    }

    /// Applies what a server says about a task that it accepted.
    pub(super) fn on_known(&mut self, now: Instant, number: TaskNumber, answer: ServerAnswer) {
        let Some(task) = self.tasks.get(&number) else {
            return;
        };
        if task.state.is_over() {
            return;
        }
        let remote = task.remote.clone();
        match answer {
            ServerAnswer::Task { state, text } => self.set_state(number, state.into(), &text),
            ServerAnswer::TaskUnknown { boot, text } => {
                let why = match task.is_of_an_earlier(boot) {
                    true => WaitReason::ServerRestarted { remote },
                    false => WaitReason::TaskUnknown,
                };
                self.lose(now, number, why, &text);
            }
            ServerAnswer::Unclear { text } => {
                self.lose(now, number, WaitReason::AnswerUnclear { remote }, &text);
            }
            ServerAnswer::NotTold { text } if task.can_be_asked() => {
                self.set_unknown(now, number, WaitReason::NotTold { remote }, &text);
            }
            ServerAnswer::Nothing { text, .. } if task.can_be_asked() => {
                self.set_unknown(now, number, WaitReason::ServerSilent { remote }, &text);
            }
            // Not an answer about a task.
            _ => {}
        }
    }

    /// The outcome of a task is unknown and cannot become known.
    fn lose(&mut self, now: Instant, number: TaskNumber, why: WaitReason, text: &str) {
        self.set_unknown(now, number, why, text);
        self.unresolved.insert(number);
    }
}
