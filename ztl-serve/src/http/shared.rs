//! What the threads of a task of `http` know in common: whether it is to be aborted, and the events that were heard.

use std::collections::VecDeque;
use std::sync::atomic::AtomicBool;
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

use super::events::Heard;
use crate::kind::StopReason;

/// The most bytes of events that wait. Then the oldest is dropped.
const MOST_HEARD: usize = 256 << 10;

/// What a task's threads and the supervisor's know of it.
#[derive(Debug, Default)]
pub(super) struct Shared {
    state: Mutex<State>,
    changed: Condvar,
    /// Whether the task's thread waits for an answer, so that it cannot abort.
    pub(super) is_asking: AtomicBool,
    /// Whether an abort was sent that may have ended what the robot does.
    pub(super) may_be_aborted: AtomicBool,
    /// Whether a thread aborts meanwhile. Clients may ask for an abort more often than a robot answers.
    pub(super) is_aborting: AtomicBool,
}

#[derive(Debug, Default)]
pub(super) struct State {
    /// Why it is to be aborted, if it is.
    pub(super) abort: Option<StopReason>,
    /// Events that the task's thread has not looked at.
    heard: VecDeque<Heard>,
    /// The bytes of these.
    bytes: usize,
}

impl Shared {
    pub(super) fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(super) fn abort(&self, why: StopReason) {
        self.lock().abort.get_or_insert(why);
        self.changed.notify_all();
    }

    /// An event was heard.
    pub(super) fn hear(&self, heard: Heard) {
        let mut state = self.lock();
        state.bytes += heard.len();
        state.heard.push_back(heard);
        while state.bytes > MOST_HEARD
            && let Some(oldest) = state.heard.pop_front()
        {
            state.bytes -= oldest.len();
        }
        drop(state);
        self.changed.notify_all();
    }

    /// Drops the events that were heard so far.
    pub(super) fn forget_events(&self) {
        let mut state = self.lock();
        let is_end = |heard: &Heard| matches!(heard, Heard::Closed(_));
        state.heard.retain(is_end);
        state.bytes = state.heard.iter().map(Heard::len).sum();
    }

    /// Waits until this time, or until the task is to be aborted. Returns whether it is.
    pub(super) fn wait_until(&self, until: Instant) -> bool {
        self.wait(until, |state| state.abort.is_some())
            .abort
            .is_some()
    }

    /// Waits until this time, until the task is to be aborted, or until an event comes. Returns why it is to be
    /// aborted, and the event.
    pub(super) fn wait_for_event(&self, until: Instant) -> (Option<StopReason>, Option<Heard>) {
        let mut state = self.wait(until, |state| {
            state.abort.is_some() || !state.heard.is_empty()
        });
        let heard = state.heard.pop_front();
        state.bytes -= heard.as_ref().map_or(0, Heard::len);
        (state.abort, heard)
    }

    fn wait(&self, until: Instant, is_it: impl Fn(&State) -> bool) -> MutexGuard<'_, State> {
        let mut state = self.lock();
        while !is_it(&state) {
            let left = until.saturating_duration_since(Instant::now());
            if left.is_zero() {
                break;
            }
            let waited = self.changed.wait_timeout(state, left);
            state = waited.unwrap_or_else(PoisonError::into_inner).0;
        }
        state
    }
}

#[cfg(test)]
mod tests {
    use super::super::exchange::Answer;
    use super::*;

    #[test]
    fn events_without_a_text_are_bounded_too() {
        let shared = Shared::default();
        for name in [None, Some("n".repeat(1000))] {
            for _ in 0..10_000 {
                shared.hear(Heard::Event(Answer::of_event(name.clone(), b"")));
            }
            let waiting = shared.lock().heard.len();
            assert!(waiting > 100 && waiting < 5000, "{waiting} events wait");
        }
        while !shared.lock().heard.is_empty() {
            shared.wait_for_event(Instant::now());
        }
        assert_eq!(shared.lock().bytes, 0);
    }
}
