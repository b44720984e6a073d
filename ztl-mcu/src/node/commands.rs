//! What the gateway wants.

use ztl_core::Instant;
use ztl_core::link::{
    ADDR_ONLY_NODE, Body, Frame, Hello, LinkId, NO_SEQ, NO_SESSION, OTHER_GATEWAY, VERSION,
    next_seq, session_key, session_number,
};
use ztl_core::tasks::TaskRules;

use super::tasks::Wanted;
use super::{Components, Counters, Inner};

/// The answer to the last command, kept to be repeated.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) enum Answer {
    Welcome,
    Component(u8),
    Started(LinkId),
    Refused(&'static str),
    /// For the reason that the component gave.
    NotTaken,
    Aborting(LinkId),
    Pong,
}

impl<C: Components, const TASKS: usize, const FRAME: usize> Inner<'_, C, TASKS, FRAME> {
    /// `frame` was checked against the session that runs, then against no session; `place` says
    /// which it is of.
    pub(super) fn on_frame(
        &mut self,
        now: Instant,
        place: usize,
        frame: Frame<'_>,
        counters: &mut Counters,
    ) {
        let in_session = place == 0 && self.session != NO_SESSION;
        if frame.addr != ADDR_ONLY_NODE {
            return;
        }
        match (in_session, frame.seq, frame.body) {
            (false, NO_SEQ, Body::Hello(hello)) => self.on_hello(now, hello),
            (true, NO_SEQ, Body::Ack { task }) => {
                // Known or not; a task that still runs is not let go.
                self.tasks.acknowledge(task);
            }
            (true, seq, body) if seq != NO_SEQ => self.on_command(now, seq, body, counters),
            _ => {}
        }
    }

    fn on_hello(&mut self, now: Instant, hello: Hello) {
        if hello.session != session_number(hello.session) {
            return;
        }
        if hello.version != VERSION {
            self.refusal = Some((hello.session, "this node speaks version 1 of the link"));
            return;
        }
        if hello.session != self.hello {
            let live = self.session != NO_SESSION && now < self.heard + self.identity.link_timeout;
            if live && hello.gateway != self.gateway {
                self.refusal = Some((hello.session, "another gateway holds this device"));
                return;
            }
            if hello.gateway != self.gateway && self.hello != NO_SESSION {
                // The one before may have given numbers to tasks that never came; they stay its.
                self.highest = LinkId(self.highest.0.saturating_add(OTHER_GATEWAY));
            }
            self.replaced = self.hello;
            self.hello = hello.session;
            self.session = session_key(hello.session, self.identity.boot);
            self.gateway = hello.gateway;
            self.seq = NO_SEQ;
            // A new session proves nothing about the way back, so the link timer runs on.
            self.heard = now;
            for (_, task) in self.tasks.iter_mut() {
                task.extra.due = now;
                task.extra.news = true;
            }
        }
        if self.seq == NO_SEQ {
            self.answer = Some(Answer::Welcome);
            self.answer_due = true;
        }
    }

    fn on_command(&mut self, now: Instant, seq: u8, body: Body<'_>, counters: &mut Counters) {
        if seq == self.seq {
            counters.repeats = counters.repeats.wrapping_add(1);
            self.answer_due = self.answer.is_some();
            return;
        }
        if seq != next_seq(self.seq) {
            counters.out_of_sequence = counters.out_of_sequence.wrapping_add(1);
            return;
        }
        // A command that comes after the link timer has run out does not undo that.
        self.look_at_link(now);
        let answer = match body {
            Body::Describe { index } if usize::from(index) < self.components.count() => {
                Answer::Component(index)
            }
            Body::Describe { .. } => Answer::Refused("no such component"),
            Body::Start {
                task,
                component,
                goal,
                before_ms,
            } => {
                let wanted = Wanted {
                    task,
                    component,
                    goal,
                    before_ms,
                };
                match self.start(now, wanted) {
                    Ok(()) => Answer::Started(task),
                    Err(answer) => answer,
                }
            }
            Body::Abort { task } => self.abort(now, task),
            Body::Ping => Answer::Pong,
            // The node's own messages, come back as an echo.
            _ => return,
        };
        self.seq = seq;
        self.answer = Some(answer);
        self.answer_due = true;
        self.heard = now;
        self.commanded = Some(now);
    }
}
