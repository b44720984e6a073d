//! A server's rules under any sequence of requests, events and times, compared with a [`model`].
//!
//! A scenario is text with one step per line. A handler's event is followed by the number of a task, counted
//! from 0 in order of their starts, and a text:
//!
//! | line | step |
//! |---|---|
//! | `?/lab;1;-1;open` | a request without an envelope |
//! | `A5?/lab;1;-1;open` | request 5 of our client A (or B, C, D); with `!` it asks for an early end |
//! | `A5.1?/lab;1;-1;open` | the same over connection 1; without a number, A and B share one connection, and C and D another |
//! | `&` | a request of several frames |
//! | `a0 ok` | accepted; likewise `r` rejected, `x` threw, `p` progress, `c` completed, `f` failed, `o` aborted, `n` cannot be aborted |
//! | `t1500` | this many milliseconds pass |
//! | `T1500` | the same, but the server wakes only at the end |
//! | `i7` | the first task gets id 7, if nothing has happened yet |

mod model;

use core::time::Duration;

use ztl_core::dispatcher::{Action, Body, Config, Dispatcher, TaskEvent};
use ztl_core::envelope::{ClientId, Envelope};
use ztl_core::memory::Fixed;
use ztl_core::reply::Reply;
use ztl_core::{Instant, TaskId};

use crate::script::{number, pick, steps, text};
use model::state::{BOOT, Limits, Model, SCOPES, TEXT};

/// Longest step in milliseconds: longer than every time in the dispatcher.
const LONGEST_STEP: u64 = 4_000_000;

/// Where a request came from: its number, to tell replies apart, and its connection.
#[derive(Debug, Clone, Copy)]
struct Peer {
    ask: usize,
    place: u64,
}

impl PartialEq for Peer {
    fn eq(&self, other: &Self) -> bool {
        self.place == other.place
    }
}

/// Plays a scenario on a server that is often full, and on one that rarely is.
pub fn check(script: &[u8]) {
    Stage::<3, 2>::play(script);
    Stage::<8, 12>::play(script);
}

struct Stage<const TASKS: usize, const HELD: usize> {
    dispatcher: Dispatcher<Fixed<Peer, 2, TASKS, TEXT, HELD>>,
    now: Instant,
    model: Model,
}

impl<const TASKS: usize, const HELD: usize> Stage<TASKS, HELD> {
    fn new(first: TaskId) -> Self {
        Self {
            dispatcher: Dispatcher::new(Fixed::new(SCOPES), Config::new(first, BOOT)),
            now: Instant::ZERO,
            model: Model::new(Limits {
                tasks: TASKS,
                held: HELD,
                first,
            }),
        }
    }

    fn play(script: &[u8]) {
        let mut steps = steps(script).peekable();
        let first = steps
            .next_if(|(verb, _)| *verb == b'i')
            .and_then(|(_, mut rest)| {
                let first = u32::try_from(number(&mut rest)).ok()?;
                TaskId::new(first)
            });
        let mut stage = Self::new(first.unwrap_or(TaskId::new(1).expect("not 0")));
        for (verb, mut rest) in steps {
            match verb {
                b'?' => stage.request(None, Body::One(rest)),
                b'&' => stage.request(None, Body::Several),
                b'A'..=b'D' => {
                    let client = ClientId([verb; 16]);
                    // Limited to the bits of an envelope.
                    let asked = number(&mut rest) & (u64::MAX >> 1);
                    let mut place = u64::from(verb - b'A') / 2;
                    if let Some(after) = rest.strip_prefix(b".") {
                        rest = after;
                        place = number(&mut rest);
                    }
                    let Some((mark @ (b'?' | b'!'), body)) = rest.split_first() else {
                        continue;
                    };
                    let early_end = *mark == b'!';
                    let envelope = Envelope {
                        client,
                        number: asked,
                        early_end,
                    };
                    stage.request(Some((envelope, place)), Body::One(body));
                }
                b't' | b'T' => {
                    let time = Duration::from_millis(number(&mut rest).min(LONGEST_STEP));
                    stage.pass(time, verb == b't');
                }
                _ => stage.event(verb, rest),
            }
        }
        // Held replies are sent in time.
        stage.pass(Duration::from_secs(10), true);
        stage.model.assert_all_answered();
    }

    fn request(&mut self, ours: Option<(Envelope, u64)>, body: Body<'_>) {
        let Self {
            dispatcher,
            now,
            model,
        } = self;
        if ours.is_some_and(|ours| model.is_impossible(ours, body)) {
            return;
        }
        let (envelope, place) = ours.unzip();
        let ask = model.ask(*now, ours, body);
        let place = place.unwrap_or_default();
        let peer = Peer { ask, place };
        let mut out = |peer: Peer, reply: &Reply<'_>| model.on_answer(*now, peer.ask, reply);
        let action = dispatcher.handle_request(*now, peer, envelope, body, &mut out);
        match action {
            Some(Action::Start { id, scope, payload }) => {
                model.on_start(ask, id, SCOPES[usize::from(scope.0)], payload);
            }
            Some(Action::Abort { id, scope }) => {
                model.on_abort(ask, id, SCOPES[usize::from(scope.0)]);
            }
            None => model.on_no_action(*now, ask),
        }
        // A STATUS that asks to wait for 0 ms.
        if dispatcher.poll_timeout().is_some_and(|wake| wake <= *now) {
            self.wake(self.now);
        }
    }

    fn event(&mut self, verb: u8, mut rest: &[u8]) {
        let Self {
            dispatcher,
            now,
            model,
        } = self;
        let wanted = number(&mut rest);
        let Some(id) = pick(model.tasks(), wanted).map(|task| task.id) else {
            return;
        };
        let text = text(rest);
        let event = match verb {
            b'a' => TaskEvent::Accepted { reply: &text },
            b'r' => TaskEvent::Rejected { reason: &text },
            b'x' => TaskEvent::Threw { message: &text },
            b'p' => TaskEvent::Progress { text: &text },
            b'c' => TaskEvent::Completed { result: &text },
            b'f' => TaskEvent::Failed { reason: &text },
            b'o' => TaskEvent::Aborted { result: &text },
            b'n' => TaskEvent::AbortRejected,
            _ => return,
        };
        model.on_event(*now, id, event);
        let mut out = |peer: Peer, reply: &Reply<'_>| model.on_answer(*now, peer.ask, reply);
        dispatcher.handle_event(*now, id, event, &mut out);
        model.after_event();
    }

    /// Lets time pass, with or without the wake-ups that the dispatcher asks for.
    fn pass(&mut self, time: Duration, awake: bool) {
        let end = self.now + time;
        while awake && let Some(wake) = self.dispatcher.poll_timeout().filter(|wake| *wake <= end) {
            self.wake(wake.max(self.now));
        }
        if !awake {
            self.model.oversleep(end);
        }
        self.wake(end);
    }

    fn wake(&mut self, now: Instant) {
        let Self {
            dispatcher, model, ..
        } = self;
        self.now = now;
        model.forget(now);
        let mut out = |peer: Peer, reply: &Reply<'_>| model.on_answer(now, peer.ask, reply);
        dispatcher.handle_timeout(now, &mut out);
        model.assert_in_time(now);
        let next = dispatcher.poll_timeout();
        assert!(
            next.is_none_or(|next| next > now),
            "endless wake-ups without progress"
        );
    }
}
