//! How many tasks of one kind are done at once, and what becomes of the next: decided without I/O.

use std::collections::VecDeque;

use ztl_core::TaskId;

/// What becomes of a task when as many as allowed are being done.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Busy {
    /// It is refused.
    Refuse,
    /// Up to so many wait.
    Queue(usize),
    /// The oldest is stopped; the new one begins when that has ended.
    Replace,
}

/// The tasks of one kind.
#[derive(Debug)]
pub(super) struct Desk {
    at_once: usize,
    busy: Busy,
    doing: Vec<TaskId>,
    waiting: VecDeque<TaskId>,
}

/// What is decided about a task.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Admitted {
    /// It begins now.
    Now,
    /// It waits, behind so many others.
    Waits(usize),
    /// It waits for this one, which is to be stopped; one that waited for that as well is not
    /// wanted any more.
    Replaces(TaskId, Option<TaskId>),
    /// There is no room; this is the one that began last.
    Refused(TaskId),
}

impl Desk {
    pub(super) const fn new(at_once: usize, busy: Busy) -> Self {
        Self {
            at_once,
            busy,
            doing: Vec::new(),
            waiting: VecDeque::new(),
        }
    }

    /// A task comes.
    pub(super) fn admit(&mut self, id: TaskId) -> Admitted {
        let (Some(first), Some(last)) = (self.doing.first(), self.doing.last()) else {
            self.doing.push(id);
            return Admitted::Now;
        };
        let (first, last) = (*first, *last);
        if self.doing.len() < self.at_once {
            self.doing.push(id);
            return Admitted::Now;
        }
        match self.busy {
            Busy::Refuse => Admitted::Refused(last),
            Busy::Queue(most) if self.waiting.len() >= most => Admitted::Refused(last),
            Busy::Queue(_) => {
                self.waiting.push_back(id);
                Admitted::Waits(self.waiting.len() - 1)
            }
            Busy::Replace => {
                let unwanted = self.waiting.pop_front();
                self.waiting.push_back(id);
                Admitted::Replaces(first, unwanted)
            }
        }
    }

    /// A task has ended, begun or not. The one that begins now, if any.
    pub(super) fn ended(&mut self, id: TaskId) -> Option<TaskId> {
        self.waiting.retain(|waiting| *waiting != id);
        let place = self.doing.iter().position(|doing| *doing == id)?;
        self.doing.remove(place);
        let next = self.waiting.pop_front()?;
        self.doing.push(next);
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
    fn as_many_as_allowed_are_done_and_the_next_is_refused() {
        let mut desk = Desk::new(2, Busy::Refuse);
        assert_eq!(desk.admit(id(1)), Admitted::Now);
        assert_eq!(desk.admit(id(2)), Admitted::Now);
        assert_eq!(desk.admit(id(3)), Admitted::Refused(id(2)));
        assert_eq!(desk.ended(id(3)), None);
        assert_eq!(desk.ended(id(1)), None);
        assert_eq!(desk.admit(id(4)), Admitted::Now);
    }

    #[test]
    fn those_who_wait_begin_in_their_order_and_one_that_is_aborted_gives_up_its_place() {
        let mut desk = Desk::new(1, Busy::Queue(2));
        assert_eq!(desk.admit(id(1)), Admitted::Now);
        assert_eq!(desk.admit(id(2)), Admitted::Waits(0));
        assert_eq!(desk.admit(id(3)), Admitted::Waits(1));
        assert_eq!(desk.admit(id(4)), Admitted::Refused(id(1)));
        assert_eq!(desk.ended(id(2)), None);
        assert_eq!(desk.admit(id(5)), Admitted::Waits(1));
        assert_eq!(desk.ended(id(1)), Some(id(3)));
        assert_eq!(desk.ended(id(3)), Some(id(5)));
        assert_eq!(desk.ended(id(5)), None);
    }

    #[test]
    fn the_latest_replaces_the_one_that_is_done_and_the_one_that_waited_for_that() {
        let mut desk = Desk::new(1, Busy::Replace);
        assert_eq!(desk.admit(id(1)), Admitted::Now);
        assert_eq!(desk.admit(id(2)), Admitted::Replaces(id(1), None));
        assert_eq!(desk.admit(id(3)), Admitted::Replaces(id(1), Some(id(2))));
        assert_eq!(desk.ended(id(1)), Some(id(3)));
        assert_eq!(desk.ended(id(3)), None);
    }
}
