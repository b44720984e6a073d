//! Tasks that are aborted when the client that started them is gone.
//!
//! A client is known to be gone only by its silence, and only if it kept in touch before: one of the
//! original's never says who it is, and one that asked for a task and nothing more may not care.
//!
//! A rule of the protocol (12.7) that is kept here and not in `ztl-core`: it needs a list of tasks for
//! each client, for which every small image would pay, and no firmware's tasks ask for it.

use std::collections::HashMap;
use std::time::Duration;

use ztl_core::envelope::ClientId;
use ztl_core::{Instant, TaskId};

/// How often it is looked who is silent.
const LOOK: Duration = Duration::from_millis(250);

/// The clients of such tasks.
#[derive(Default)]
pub(super) struct Touch {
    clients: HashMap<ClientId, Touched>,
    /// When it is looked next; `None` without any.
    next: Option<Instant>,
}

#[derive(Default)]
struct Touched {
    /// When it was last heard of, if it was since it asked for the first of the tasks.
    heard: Option<Instant>,
    /// Its tasks, and how long it may be silent for each.
    tasks: Vec<(TaskId, Duration)>,
}

impl Touch {
    /// A task is to be aborted when its client is silent for so long.
    pub(super) fn watch(&mut self, now: Instant, client: ClientId, id: TaskId, silence: Duration) {
        let touched = self.clients.entry(client).or_default();
        touched.tasks.retain(|(known, _)| *known != id);
        touched.tasks.push((id, silence));
        self.next.get_or_insert(now + LOOK);
    }

    /// A client has asked for something other than a new task.
    pub(super) fn on_heard(&mut self, now: Instant, client: ClientId) {
        if let Some(touched) = self.clients.get_mut(&client) {
            touched.heard = Some(now);
        }
    }

    /// When [`gone`](Self::gone) has something to do.
    pub(super) fn poll_timeout(&self) -> Option<Instant> {
        self.next
    }

    /// The tasks whose clients are gone, each once; `runs` tells which have not ended. Looks at all
    /// of them, at most four times a second.
    pub(super) fn gone(&mut self, now: Instant, runs: impl Fn(TaskId) -> bool) -> Vec<TaskId> {
        let mut gone = Vec::new();
        if self.next.is_none_or(|next| now < next) {
            return gone;
        }
        self.clients.retain(|_, touched| {
            let heard = touched.heard;
            touched.tasks.retain(|(id, silence)| {
                let silent = heard.is_some_and(|heard| now.since(heard) >= *silence);
                let runs = runs(*id);
                if silent && runs {
                    gone.push(*id);
                }
                runs && !silent
            });
            !touched.tasks.is_empty()
        });
        self.next = (!self.clients.is_empty()).then(|| now + LOOK);
        gone
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_who_kept_in_touch_and_fell_silent_is_gone() {
        let at = Instant::from_millis;
        let [a, b] = [1, 2].map(|byte| ClientId([byte; 16]));
        let [one, two, three] = [1, 2, 3].map(|id| TaskId::new(id).unwrap());
        let mut touch = Touch::default();
        assert_eq!(touch.poll_timeout(), None);
        touch.watch(at(0), a, one, Duration::from_secs(1));
        touch.watch(at(0), a, two, Duration::from_secs(3));
        touch.watch(at(0), b, three, Duration::from_secs(1));
        assert_eq!(touch.gone(at(5000), |_| true), []);
        touch.on_heard(at(5000), a);
        assert_eq!(touch.gone(at(5900), |_| true), []);
        assert_eq!(touch.gone(at(6000), |_| true), [], "it looked just before");
        assert_eq!(touch.gone(at(6150), |_| true), [one]);
        assert_eq!(touch.gone(at(8150), |id| id != two), [], "it has ended");
        assert_eq!(touch.gone(at(9000), |id| id != three), []);
        assert_eq!(touch.poll_timeout(), None, "nobody is left");
    }
}
