//! The gateway's process: the real dispatcher, sessions and journal, connected like the threads of the gateway.

use std::cell::Cell;
use std::collections::HashMap;
use std::sync::{Arc, Mutex};
use std::time::{Duration, UNIX_EPOCH};

use ztl_core::dispatcher::{Action, Body, Config, Dispatcher, TaskEvent};
use ztl_core::envelope::Envelope;
use ztl_core::memory::{Fixed, Scope};
use ztl_core::reply::Reply;
use ztl_core::tasks::{StoredText, Task};
use ztl_core::time::earliest;
use ztl_core::{Instant, State, TaskId, TaskSpec};
use ztl_link::bus::LastSearch;
use ztl_link::{LinkEvent, Session};
use ztl_sim::Disk;
use ztl_std::gateway::{DeviceJournal, JournalRecords, Moment};

use super::boards::SomeBoards;

pub(super) const SCOPE: &str = "/lab";

/// The rate of all lines.
pub(super) const BAUD: u32 = 115_200;
/// Room for more tasks than any plan starts.
type Room = Fixed<Envelope, 1, 128, 160, 24>;
pub(super) type LabSession = Session<Option<DeviceJournal<Disk>>>;

thread_local! {
    static NOW: Cell<Instant> = const { Cell::new(Instant::ZERO) };
    static NUMBER: Cell<u32> = const { Cell::new(0) };
}

/// Sets where the numbers of sessions start.
pub(super) fn set_first_number(number: u32) {
    NUMBER.set(number);
}

/// The next session number; deterministic.
fn number() -> u32 {
    NUMBER.set(NUMBER.get().wrapping_add(0x9E37_79B9));
    NUMBER.get()
}

/// Sets all clocks, including those of the journals.
pub(super) fn set_clocks(now: Instant) {
    NOW.set(now);
}

fn moment() -> Moment {
    let running = Duration::from_micros(NOW.get().as_micros());
    Moment {
        wall: UNIX_EPOCH + running,
        running,
    }
}

/// A message and its envelope.
pub(super) type Letter = (Envelope, Vec<u8>);

/// A running gateway.
pub(super) struct Gateway {
    pub(super) dispatcher: Dispatcher<Room>,
    pub(super) sessions: Vec<LabSession>,
    /// The reply to the INIT of each pending task.
    replies: HashMap<TaskId, String>,
    /// Replies to send.
    pub(super) out: Vec<Letter>,
    /// Events of the sessions with their device, for the trace and the checks.
    pub(super) told: Vec<(usize, LinkEvent)>,
    /// Tasks of devices that were taken up, with their goals.
    pub(super) taken: Vec<(TaskId, String)>,
    /// On a shared line: what is known of the boards, and what the last search has found.
    pub(super) boards: Vec<(SomeBoards, LastSearch)>,
}

impl Gateway {
    /// Starts for the `boot`-th time. The lines of the devices are not open yet.
    pub(super) fn new(
        now: Instant,
        (devices, shared): (usize, bool),
        disk: Option<&Disk>,
        boot: u32,
    ) -> Self {
        // No id is reused, as with a random number between 1 and 2^30.
        let first = TaskId::new(boot * 100_000).expect("boots count from 1");
        let log =
            disk.map(|disk| JournalRecords::open(disk.clone(), &disk.written(), moment(), 77));
        let id = log
            .as_ref()
            .map_or(u64::from(boot), JournalRecords::gateway);
        let (unended, ended) = log.as_ref().map_or_else(Default::default, |log| {
            let ended = log.ended(moment()).into_iter().map(|(_, task)| task);
            (log.unended(), ended.collect::<Vec<_>>())
        });
        let log = log.map(|log| Arc::new(Mutex::new(log)));
        let sessions = (0..devices).map(|device| {
            let book = log
                .clone()
                .map(|log| DeviceJournal::new(log, &name(device), moment));
            let session = Session::with_journal(book, id, Some(BAUD), number);
            if shared {
                session.with_address(address(device))
            } else {
                session
            }
        });
        let mut gateway = Self {
            dispatcher: Dispatcher::new(Fixed::new([SCOPE]), Config::new(first, boot)),
            sessions: sessions.collect(),
            replies: HashMap::new(),
            out: Vec::new(),
            told: Vec::new(),
            taken: Vec::new(),
            boards: Vec::new(),
        };
        gateway.know_boards();
        for task in ended {
            gateway.restore(now, task.id, task.state, &task.text);
        }
        for (device, task) in unended {
            gateway.restore(now, task.id, State::Accepted, "device is not answering yet");
            gateway.replies.insert(task.id, String::new());
            let device = (0..devices).find(|number| name(*number) == device);
            if let Some(session) = device.and_then(|device| gateway.sessions.get_mut(device)) {
                session.restore(now, task);
            }
        }
        gateway
    }

    fn restore(&mut self, now: Instant, id: TaskId, state: State, text: &str) {
        let mut task = Task::new(Scope(0));
        task.state = state;
        StoredText::set(&mut task.text, text);
        if state.is_final() {
            task.ended = now;
        }
        assert!(self.dispatcher.restore(id, task), "there is room");
    }

    /// Handles a client's message.
    pub(super) fn handle_request(&mut self, now: Instant, (envelope, body): Letter) {
        let out = &mut self.out;
        let mut put = |peer, reply: &Reply<'_>| out.push((peer, written(reply)));
        let body = Body::One(&body);
        let action = self
            .dispatcher
            .handle_request(now, envelope, Some(envelope), body, &mut put);
        match action {
            Some(Action::Start { id, payload, .. }) => self.start(now, id, payload),
            Some(Action::Abort { id, .. }) => {
                for session in &mut self.sessions {
                    session.abort(now, id);
                }
            }
            None => {}
        }
    }

    fn start(&mut self, now: Instant, id: TaskId, payload: &str) {
        let mut buffer = vec![0; payload.len()];
        let spec = match TaskSpec::decode(payload, &mut buffer) {
            Ok(spec) => spec,
            Err(error) => {
                let message = &error.to_string();
                return self.report(now, id, TaskEvent::Threw { message });
            }
        };
        let device = (0..self.sessions.len()).find(|device| name(*device) == spec.handler);
        match device {
            Some(device) => {
                let mut reply = Vec::new();
                spec.put_initiated(id, &mut |bytes: &[u8]| reply.extend_from_slice(bytes));
                let reply = String::from_utf8_lossy(&reply).into_owned();
                self.replies.insert(id, reply);
                self.sessions[device].start(now, id, spec.component, spec.goal);
            }
            None => {
                let reason = "no such device";
                self.report(now, id, TaskEvent::Rejected { reason });
            }
        }
    }

    fn report(&mut self, now: Instant, id: TaskId, event: TaskEvent<'_>) {
        let out = &mut self.out;
        let mut put = |peer, reply: &Reply<'_>| out.push((peer, written(reply)));
        self.dispatcher.handle_event(now, id, event, &mut put);
    }

    /// Handles timeouts and the events of the sessions.
    pub(super) fn handle_timeout(&mut self, now: Instant) {
        for device in 0..self.sessions.len() {
            let session = &mut self.sessions[device];
            if session.poll_timeout().is_some_and(|at| at <= now) {
                session.handle_timeout(now);
            }
            while let Some(event) = self.sessions[device].poll_event() {
                if event == LinkEvent::Begun {
                    self.take_up(now, device);
                }
                self.on_event(now, &event);
                self.told.push((device, event));
            }
        }
        let out = &mut self.out;
        let mut put = |peer, reply: &Reply<'_>| out.push((peer, written(reply)));
        self.dispatcher.handle_timeout(now, &mut put);
    }

    fn on_event(&mut self, now: Instant, event: &LinkEvent) {
        match event {
            LinkEvent::Accepted(id) => {
                let reply = self.replies.get(id).cloned().unwrap_or_default();
                self.report(now, *id, TaskEvent::Accepted { reply: &reply });
            }
            LinkEvent::TaskRejected(id, reason) => {
                self.replies.remove(id);
                self.report(now, *id, TaskEvent::Rejected { reason });
            }
            LinkEvent::Progress(id, text) => self.report(now, *id, TaskEvent::Progress { text }),
            LinkEvent::Ended(id, state, text) => {
                self.replies.remove(id);
                let event = match state {
                    State::Completed => TaskEvent::Completed { result: text },
                    State::Aborted => TaskEvent::Aborted { result: text },
                    _ => TaskEvent::Failed { reason: text },
                };
                self.report(now, *id, event);
            }
            _ => {}
        }
    }

    pub(super) fn poll_timeout(&self) -> Option<Instant> {
        let sessions = self.sessions.iter().map(LabSession::poll_timeout);
        sessions.fold(self.dispatcher.poll_timeout(), earliest)
    }
}

/// Address of a device on a shared line.
pub(super) const fn address(device: usize) -> u8 {
    device as u8 + 1
}

/// Name of a device.
pub(super) fn name(device: usize) -> String {
    format!("device{device}")
}

fn written(reply: &Reply<'_>) -> Vec<u8> {
    let mut out = Vec::new();
    reply.put(&mut |bytes: &[u8]| out.extend_from_slice(bytes));
    out
}
