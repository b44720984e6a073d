//! A robot: its server with the real rules, and its agent with a journal.

use std::collections::BTreeMap;

use ztl_core::dispatcher::{Action, Body, Config, Dispatcher, TaskEvent};
use ztl_core::envelope::Envelope;
use ztl_core::memory::Fixed;
use ztl_core::reply::Reply;
use ztl_core::{Instant, State, TaskId};

use super::super::ends::fleet::agent::{Agent, Entry};
use super::Return;

/// Scopes of each robot.
pub(super) const SCOPES: [&str; 2] = ["/arm", "/lab"];

type Room = Fixed<u64, 2, 160, 64, 128>;

/// A server's process.
pub(super) struct Server {
    pub(super) rules: Dispatcher<Room>,
    pub(super) boot: u32,
    /// Whether it is one of the original: without envelopes, and without answers about itself.
    pub(super) original: bool,
    /// Answers to send: the request, and the body.
    pub(super) out: Vec<(u64, Vec<u8>)>,
}

/// What a server's handler has to do.
pub(super) enum Job {
    Start { id: TaskId, payload: String },
    Abort { id: TaskId },
}

impl Server {
    pub(super) fn new(boot: u32, original: bool) -> Self {
        let first = TaskId::new(boot * 1000).expect("boots count from 1");
        Self {
            rules: Dispatcher::new(Fixed::new(SCOPES), Config::new(first, boot)),
            boot,
            original,
            out: Vec::new(),
        }
    }

    pub(super) fn request(
        &mut self,
        now: Instant,
        token: u64,
        envelope: Option<Envelope>,
        body: &[u8],
    ) -> Option<Job> {
        if self.original && body.starts_with(b"$ztl;") {
            let answer = b"$ztl;2;-1;No controller for scope: $ztl";
            self.out.push((token, answer.to_vec()));
            return None;
        }
        let envelope = envelope.filter(|_| !self.original);
        let out = &mut self.out;
        let mut put = |peer, reply: &Reply<'_>| out.push((peer, written(reply)));
        let rules = &mut self.rules;
        match rules.handle_request(now, token, envelope, Body::One(body), &mut put)? {
            Action::Start { id, payload, .. } => Some(Job::Start {
                id,
                payload: payload.to_owned(),
            }),
            Action::Abort { id, .. } => Some(Job::Abort { id }),
        }
    }

    pub(super) fn event(&mut self, now: Instant, id: TaskId, event: TaskEvent<'_>) {
        let out = &mut self.out;
        let mut put = |peer, reply: &Reply<'_>| out.push((peer, written(reply)));
        self.rules.handle_event(now, id, event, &mut put);
    }

    pub(super) fn timeout(&mut self, now: Instant) {
        let out = &mut self.out;
        let mut put = |peer, reply: &Reply<'_>| out.push((peer, written(reply)));
        self.rules.handle_timeout(now, &mut put);
    }
}

fn written(reply: &Reply<'_>) -> Vec<u8> {
    let mut out = Vec::new();
    reply.put(&mut |bytes: &[u8]| out.extend_from_slice(bytes));
    out
}

/// The event that ends a task in this state.
pub(super) const fn ending(state: State) -> TaskEvent<'static> {
    match state {
        State::Completed => TaskEvent::Completed { result: "done" },
        State::Aborted => TaskEvent::Aborted { result: "stopped" },
        _ => TaskEvent::Failed { reason: "jammed" },
    }
}

/// An agent's process.
pub(super) struct Running {
    pub(super) rules: Agent,
    pub(super) started: Instant,
    /// Who waits for which query.
    pub(super) queries: BTreeMap<u64, Return>,
    pub(super) next: u64,
}

impl Running {
    pub(super) fn clock(&self, now: Instant) -> Instant {
        Instant::ZERO + now.since(self.started)
    }
}

/// What is on the robot's disk.
#[derive(Default)]
pub(super) struct Disk {
    pub(super) entries: Vec<Entry>,
    /// How many survive a power cut.
    pub(super) synced: usize,
    /// In which run of the machine it was written anew.
    pub(super) machine: u32,
    /// Nothing can be written.
    pub(super) full: bool,
    /// Entries are missing, and the journal says so.
    pub(super) marked: bool,
}

/// A robot.
#[derive(Default)]
pub(super) struct Robot {
    /// Runs of the machine.
    pub(super) machine: u32,
    pub(super) disk: Disk,
    pub(super) agent: Option<Running>,
    pub(super) server: Option<Server>,
    /// Whether its server is one of the original.
    pub(super) original: bool,
    /// After so many effects the agent is killed.
    pub(super) fuse: Option<u32>,
}
