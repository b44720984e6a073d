//! Admission: how many tasks of one component run at once, and what happens to the next. No I/O.

use std::collections::VecDeque;

use ztl_core::TaskId;

/// What happens to a task when as many as allowed are running. Unlike that of a device's component, the queue may
/// be longer than 255.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum BusyPolicy {
    /// It is rejected.
    Reject,
    /// It waits, unless as many as this wait already.
    Queue(usize),
    /// The oldest is stopped. The new one starts when that has ended.
    Replace,
}

/// The tasks of one component.
#[derive(Debug)]
pub(crate) struct Admission {
    at_once: usize,
    busy: BusyPolicy,
    running: Vec<TaskId>,
    waiting: VecDeque<TaskId>,
}

/// What happens to a new task.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Admitted {
    /// It starts now.
    Now,
    /// It waits behind this many others.
    Waits(usize),
    /// It waits for `running`, which is to be stopped, and replaces `waiting`, which waited for that.
    Replaces {
        running: TaskId,
        waiting: Option<TaskId>,
    },
    /// It is rejected, since this one runs. It is the last that has started.
    Rejected(TaskId),
}

impl Admission {
    pub(crate) const fn new(at_once: usize, busy: BusyPolicy) -> Self {
        Self {
            at_once,
            busy,
            running: Vec::new(),
            waiting: VecDeque::new(),
        }
    }

    /// Admits a new task, or not.
    pub(crate) fn admit(&mut self, id: TaskId) -> Admitted {
        let (Some(&first), Some(&last)) = (self.running.first(), self.running.last()) else {
            self.running.push(id);
            return Admitted::Now;
        };
        if self.running.len() < self.at_once {
            self.running.push(id);
            return Admitted::Now;
        }
        match self.busy {
            BusyPolicy::Queue(most) if self.waiting.len() < most => {
                self.waiting.push_back(id);
                Admitted::Waits(self.waiting.len() - 1)
            }
            BusyPolicy::Reject | BusyPolicy::Queue(_) => Admitted::Rejected(last),
            BusyPolicy::Replace => {
                let waiting = self.waiting.pop_front();
                self.waiting.push_back(id);
                Admitted::Replaces {
                    running: first,
                    waiting,
                }
            }
        }
    }

    /// A task has ended, started or not. Returns the one that starts now, if any.
    pub(crate) fn ended(&mut self, id: TaskId) -> Option<TaskId> {
        self.waiting.retain(|waiting| *waiting != id);
        let place = self.running.iter().position(|running| *running == id)?;
        self.running.remove(place);
        let next = self.waiting.pop_front()?;
        self.running.push(next);
        Some(next)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn id(number: u32) -> TaskId {
        TaskId::new(number).expect("an id")
    }

    #[test]
    fn the_next_task_is_rejected_when_as_many_as_allowed_run() {
        let mut admission = Admission::new(2, BusyPolicy::Reject);
        assert_eq!(admission.admit(id(1)), Admitted::Now);
        assert_eq!(admission.admit(id(2)), Admitted::Now);
        assert_eq!(admission.admit(id(3)), Admitted::Rejected(id(2)));
        assert_eq!(admission.ended(id(3)), None);
        assert_eq!(admission.ended(id(1)), None);
        assert_eq!(admission.admit(id(4)), Admitted::Now);
    }

    #[test]
    fn waiting_tasks_start_in_order_and_an_aborted_one_leaves_the_queue() {
        let mut admission = Admission::new(1, BusyPolicy::Queue(2));
        assert_eq!(admission.admit(id(1)), Admitted::Now);
        assert_eq!(admission.admit(id(2)), Admitted::Waits(0));
        assert_eq!(admission.admit(id(3)), Admitted::Waits(1));
        assert_eq!(admission.admit(id(4)), Admitted::Rejected(id(1)));
        assert_eq!(admission.ended(id(2)), None);
        assert_eq!(admission.admit(id(5)), Admitted::Waits(1));
        assert_eq!(admission.ended(id(1)), Some(id(3)));
        assert_eq!(admission.ended(id(3)), Some(id(5)));
        assert_eq!(admission.ended(id(5)), None);
    }

    #[test]
    fn the_newest_task_replaces_the_running_and_the_waiting_one() {
        let mut admission = Admission::new(1, BusyPolicy::Replace);
        let replaces = |waiting| Admitted::Replaces {
            running: id(1),
            waiting,
        };
        assert_eq!(admission.admit(id(1)), Admitted::Now);
        assert_eq!(admission.admit(id(2)), replaces(None));
        assert_eq!(admission.admit(id(3)), replaces(Some(id(2))));
        assert_eq!(admission.ended(id(1)), Some(id(3)));
        assert_eq!(admission.ended(id(3)), None);
    }
}
