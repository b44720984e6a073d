//! What the gateway wants.

use heapless::String;
use ztl_core::Instant;
use ztl_core::link::{
    ADDR_ONLY_NODE, Command, CommandFrame, Hello, LinkId, NO_SEQ, NO_SESSION, VERSION, next_seq,
    session_key, session_number,
};
use ztl_core::tasks::NoRoom;

use super::text::push_bytes;
use super::{Components, Counters, Inner, count};

/// In place of a reason: the component has given one.
pub(super) const NOT_TAKEN: &str = "";
/// There is no place for another task; where some have ended, that is the reason.
pub(super) const NO_PLACE: &str = NoRoom.as_str();

/// The answer to the last command, kept to be repeated.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) enum Answer {
    /// There was no command.
    Nothing,
    Welcome,
    Component(u8),
    Started(LinkId),
    /// For this reason; if it is [`NOT_TAKEN`], for the component's.
    Refused(&'static str),
    Aborting(LinkId),
    Pong,
}

impl<C: Components, const TASKS: usize, const FRAME: usize> Inner<'_, C, TASKS, FRAME> {
    /// `frame` was checked against the session that runs, then against no session.
    pub(super) fn on_frame(
        &mut self,
        now: Instant,
        frame: &CommandFrame<'_>,
        counters: &mut Counters,
    ) {
        count(&mut counters.frames);
        if frame.addr != ADDR_ONLY_NODE {
            return;
        }
        let in_session = frame.place == 0 && self.session != NO_SESSION;
        match (in_session, frame.seq, frame.command) {
            (false, NO_SEQ, Command::Hello(hello)) => self.on_hello(now, hello),
            (true, NO_SEQ, Command::Ack { task }) => {
                // Known or not; a task that still runs is not let go.
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
            self.refusal = Some((hello.session, "this node speaks version 1 of the link"));
            return;
        }
        if hello.session != self.hello {
            let live = self.session != NO_SESSION && now < self.heard.after(self.link_timeout);
            if live && hello.gateway != self.gateway {
                self.refusal = Some((hello.session, "another gateway holds this device"));
                return;
            }
            if hello.gateway != self.gateway && self.hello != NO_SESSION {
                // The one before may have given the next number to a task that never came; it stays its.
                self.highest = LinkId(self.highest.0.saturating_add(1));
            }
            self.replaced = self.hello;
            self.hello = hello.session;
            self.session = session_key(hello.session, self.boot);
            self.gateway = hello.gateway;
            self.seq = NO_SEQ;
            // A new session proves nothing about the way back, so the link timer runs on.
            self.heard = now;
            for task in self.runner.tasks.held_mut() {
                task.due = now;
                task.news = true;
            }
        }
        if self.seq == NO_SEQ {
            self.answer = Answer::Welcome;
            self.answer_due = true;
        }
    }

    fn on_command(&mut self, now: Instant, seq: u8, command: Command<'_>, counters: &mut Counters) {
        if seq == self.seq {
            count(&mut counters.repeats);
            self.answer_due = true;
            return;
        }
        if seq != next_seq(self.seq) {
            count(&mut counters.out_of_sequence);
            return;
        }
        let mut text = String::<FRAME>::new();
        if let Command::Start { goal, .. } = command
            && push_bytes(&mut text, goal).is_none()
        {
            // Not even its encoding is right.
            return count(&mut counters.errors);
        }
        // A command that comes after the link timer has run out does not undo that.
        self.look_at_link(now);
        let (answer, followed) = match command {
            Command::Describe { index } => (
                Answer::Component(index),
                if usize::from(index) < self.runner.components.count() {
                    Ok(())
                } else {
                    Err("no such component")
                },
            ),
            Command::Start {
                task,
                component,
                before_ms,
                ..
            } => {
                let started = if now.as_millis() > before_ms {
                    Err("the command came too late")
                } else if task <= self.highest {
                    Err("a task of this or a later id was started already")
                } else {
                    self.runner.start(now, task, component, &text)
                };
                if started.is_ok() {
                    self.highest = task;
                }
                (Answer::Started(task), started)
            }
            Command::Abort { task } => (Answer::Aborting(task), self.runner.abort(task, now)),
            Command::Ping => (Answer::Pong, Ok(())),
            Command::Hello(_) | Command::Ack { .. } => return,
        };
        self.answer = match followed {
            Ok(()) => answer,
            // An end that is not acknowledged is never given up.
            Err(NO_PLACE) if self.runner.tasks.held().any(|task| task.end().is_some()) => {
                Answer::Refused("ends not yet acknowledged")
            }
            Err(reason) => Answer::Refused(reason),
        };
        self.seq = seq;
        self.answer_due = true;
        self.heard = now;
        self.lost_at = now.after(self.link_timeout);
    }

    /// Acts when the link timer has run out. Looked at before a command is carried out too: after
    /// a pause of the firmware the bytes that waited come first.
    #[cfg_attr(target_os = "none", inline(never))]
    pub(super) fn look_at_link(&mut self, now: Instant) {
        if now >= self.lost_at {
            self.lost_at = Instant::NEVER;
            self.runner.on_link_lost(now);
        }
    }
}
