//! Handles the frames of the gateway.

use heapless::String;
use ztl_core::Instant;
use ztl_core::link::{
    CommandFrame, Hello, LinkCommand, LinkId, NO_SEQ, NO_SESSION, VERSION, next_seq, session_key,
    session_number,
};

use super::link_state::{Answer, Counters, LinkState, count};
use super::refusal::Refusal;
use super::utf8::push_utf8;
use crate::component::Components;
use crate::describe::{has_parts, part};

impl<C: Components, const TASKS: usize, const FRAME: usize> LinkState<'_, C, TASKS, FRAME> {
    /// Handles a frame that was verified under the current session (index 0) or under no session.
    pub(super) fn on_frame(
        &mut self,
        now: Instant,
        frame: &CommandFrame<'_>,
        counters: &mut Counters,
    ) {
        count(&mut counters.frames);
        if frame.addr != self.address() {
            return;
        }
        let in_session = frame.session_index == 0 && self.session != NO_SESSION;
        match (in_session, frame.seq, frame.command) {
            (false, NO_SEQ, LinkCommand::Hello(hello)) => {
                self.ask(now);
                self.on_hello(now, hello);
            }
            (true, NO_SEQ, LinkCommand::Ack { task }) => {
                self.runner.tasks.acknowledge(task);
            }
            (true, seq, command) if seq != NO_SEQ => {
                self.on_command(now, seq, command, counters);
            }
            _ => {}
        }
    }

    fn on_hello(&mut self, now: Instant, hello: Hello) {
        if hello.session != session_number(hello.session) {
            return;
        }
        if hello.version != VERSION {
            self.refusal = Some((hello.session, Refusal::OtherVersion));
            return;
        }
        if hello.session != self.hello {
            let live = self.session != NO_SESSION && now < self.heard.after(self.link_timeout);
            if live && hello.gateway != self.gateway {
                self.refusal = Some((hello.session, Refusal::OtherGateway));
                return;
            }
            if hello.gateway != self.gateway && self.hello != NO_SESSION {
                // The previous gateway may have sent a `Start` with the next id that still arrives.
                self.highest = LinkId(self.highest.0.saturating_add(1));
            }
            self.replaced = self.hello;
            self.hello = hello.session;
            self.session = session_key(hello.session, self.boot);
            self.gateway = hello.gateway;
            self.seq = NO_SEQ;
            // A new session does not prove that the gateway hears the node, so the link timer keeps running.
            self.heard = now;
            self.runner.readings_wake = Instant::ZERO;
            for task in self.runner.tasks.held_mut() {
                task.due = now;
                task.changed = true;
            }
            if let Some(own) = self.runner.components.own_work_mut() {
                own.on_session(now);
            }
        }
        if self.seq == NO_SEQ {
            self.answer = Answer::Welcome;
            self.answer_due = true;
        }
    }

    fn on_command(
        &mut self,
        now: Instant,
        seq: u8,
        command: LinkCommand<'_>,
        counters: &mut Counters,
    ) {
        self.in_sequence(now, seq, counters, |state, counters| {
            state.execute(now, command, counters)
        });
    }

    /// Executes a command; returns its answer, or `None` if it is not one.
    #[inline]
    fn execute(
        &mut self,
        now: Instant,
        command: LinkCommand<'_>,
        counters: &mut Counters,
    ) -> Option<Answer> {
        let mut text = String::<FRAME>::new();
        if let LinkCommand::Start { goal, .. } = command
            && push_utf8(&mut text, goal).is_none()
        {
            count(&mut counters.errors);
            return None;
        }
        // A command that arrives after the link timer expired does not undo the loss.
        self.check_link_timer(now);
        let (answer, executed) = match command {
            LinkCommand::Describe { index } => (
                Answer::Component(index),
                if usize::from(index) < self.runner.components.count()
                    || has_parts::<C>() && part(&self.runner.components, index).is_some()
                {
                    Ok(())
                } else {
                    Err(Refusal::NoSuchComponent)
                },
            ),
            LinkCommand::Start {
                task,
                component,
                before_ms,
                ..
            } => {
                let started = if now.as_millis() > before_ms {
                    Err(Refusal::TooLate)
                } else if task <= self.highest || C::ACTING && task.is_local() {
                    Err(Refusal::StaleTask)
                } else {
                    self.runner.start(now, task, component, &text)
                };
                if started.is_ok() {
                    self.highest = task;
                }
                (Answer::Started(task), started)
            }
            LinkCommand::Abort { task } => (Answer::Aborting(task), self.runner.abort(task, now)),
            LinkCommand::Ping => (Answer::Pong, Ok(())),
            LinkCommand::Hello(_) | LinkCommand::Ack { .. } => return None,
        };
        Some(match executed {
            Ok(()) => answer,
            // The node never drops an ended task that is not acknowledged.
            Err(Refusal::TableFull)
                if self.runner.tasks.held().any(|task| task.end().is_some()) =>
            {
                Answer::Refused(Refusal::TableFullOfEnded)
            }
            Err(refusal) => Answer::Refused(refusal),
        })
    }

    /// Executes a command that follows the last one, and keeps its answer. A command that repeats the last one only gets its
    /// answer again; any other is dropped.
    #[inline]
    pub(super) fn in_sequence(
        &mut self,
        now: Instant,
        seq: u8,
        counters: &mut Counters,
        execute: impl FnOnce(&mut Self, &mut Counters) -> Option<Answer>,
    ) {
        self.ask(now);
        if seq == self.seq {
            count(&mut counters.repeats);
            self.answer_due = true;
            return;
        }
        if seq != next_seq(self.seq) {
            count(&mut counters.out_of_sequence);
            return;
        }
        let Some(answer) = execute(self, counters) else {
            return;
        };
        self.answer = answer;
        self.seq = seq;
        self.answer_due = true;
        self.heard = now;
        if self.lost_at == Instant::NEVER {
            counters.up_since = now;
        }
        self.lost_at = now.after(self.link_timeout);
    }

    /// Acts if the link timer has expired. Also called before a command is executed, because after a pause of
    /// the firmware the received bytes are handled first.
    pub(super) fn check_link_timer(&mut self, now: Instant) {
        if now >= self.lost_at {
            self.lost_at = Instant::NEVER;
            self.runner.on_link_lost(now);
        }
    }
}
