//! What moves: the part of a node that its firmware provides.

use core::time::Duration;

use heapless::string::StringView;
use ztl_core::Instant;
use ztl_core::link::Offer;
use ztl_core::sink::{Sink, SliceSink, put_fixed};
use ztl_core::tasks::push_cut;

/// How a component's task goes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Run {
    /// Under way; the report is where it is now.
    Running,
    /// The goal will not be reached; the report says why.
    Failed,
    /// Stopped after [`Component::abort`]; the report is where.
    Aborted,
    /// The goal is reached; the report is the result.
    Completed,
}

/// The component does not take the goal; why stands in the report.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Refused;

/// What [`Component::poll_reading`] wrote.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Reading {
    /// Which of the topics in the component's offer, from 0.
    pub topic: u8,
    /// How many bytes of the buffer it takes.
    pub len: usize,
}

/// Something that carries out one task at a time.
///
/// The node calls `check` for each task that comes; `start` for one that may begin; then `poll`, whenever
/// `poll_timeout` asked for it, until it says other than [`Run::Running`]; `abort`, `make_safe` and
/// `poll_reading` at any time. No call may block: each is made from the main loop, between two bytes
/// of the link.
///
/// **A second task** is the node's affair; no two ever move one component. What becomes of it the
/// offer says ([`Busy`](ztl_core::link::Busy)):
/// - *Refuse*: it is refused, `busy with another task`.
/// - *Queue* of n: it is checked, accepted, and waits with at most n - 1 others; its goal has at most 48
///   bytes. When the one that runs has ended, the lowest id begins. If `start` refuses it then, it ends as
///   FAILED with that reason.
/// - *Replace*: it is checked, accepted, and waits until the one that runs has stopped after `abort`,
///   which then ends as ABORTED, `replaced by a later task`. A third one replaces the one that waits.
///
/// An abort of a task that waits ends it at once as ABORTED, `aborted before it began`.
///
/// **When the link is lost** ([`Loss`](ztl_core::link::Loss)), a component with *abort* or *hold* goes to its safe
/// state, whether it has a task or not: a relay that was switched on and whose task has ended goes off. The node calls
/// `make_safe`, then `poll` until it says other than [`Run::Running`], which means that the safe state is reached. All
/// tasks of the component end as FAILED, `link was lost`: one that waits at once, one that runs when the component
/// is safe. With *carry on* nothing happens: tasks go on, also those that wait. **In an emergency stop** every component
/// goes to its safe state in the same way, and all tasks end as ABORTED, `emergency stop`. A component that is not in its
/// safe state yet takes no task.
pub trait Component {
    /// What it is and which goals it takes; told to the gateway once a session. Must not change.
    fn offer(&self) -> Offer<'_>;

    /// Whether it takes this goal; moves nothing. Called for every task before it is accepted, also
    /// for one that has to wait.
    ///
    /// # Errors
    /// [`Refused`], and in `why` what is wrong with the goal and what would be right, for the person
    /// who wrote it. The gateway adds the goal itself.
    fn check(&self, goal: &str, why: &mut Report<'_>) -> Result<(), Refused>;

    /// Begins a task, whose goal was checked. Called only while none runs, and after `make_safe` only once the safe
    /// state is reached.
    ///
    /// # Errors
    /// [`Refused`], and in `why` the reason; nothing has moved then.
    fn start(&mut self, now: Instant, goal: &str, why: &mut Report<'_>) -> Result<(), Refused>;

    /// Moves the task on and reports. After anything but [`Run::Running`] the task is over.
    ///
    /// After `make_safe` also called without a task: [`Run::Running`] says that the safe state is not reached yet, anything
    /// else that it is. It may then be called some more times, and must leave the component safe.
    fn poll(&mut self, now: Instant, report: &mut Report<'_>) -> Run;

    /// Stops the task as soon as it is safe; a later `poll` says [`Run::Aborted`] (or how else it
    /// ended).
    fn abort(&mut self, now: Instant);

    /// Goes to the safe state, with or without a task: the link was lost, or an emergency stop. For
    /// [`Loss::Hold`](ztl_core::link::Loss::Hold) that is to keep the position under power. What cannot be done at once, such
    /// as slowing down, goes on in `poll`, which is called until it says other than [`Run::Running`]. Do not go on with
    /// the task: it ends then, whatever `poll` says.
    fn make_safe(&mut self, now: Instant);

    /// When `poll` is to be called next, asked after each `poll` of a task; and when `poll_reading` is, if the offer
    /// names topics and there was no reading. With [`Instant::NEVER`] only an abort, the loss of the link or an emergency
    /// stop brings the next `poll`. Default: after 10 ms.
    fn poll_timeout(&self, now: Instant) -> Instant {
        now + Duration::from_millis(10)
    }

    /// The next reading to be published, if one is due and fits: writes it into `buffer`.
    ///
    /// Called when the line has room, after a reading not before the
    /// [least time between two](crate::Identity::reading_interval) has passed. The buffer is always as long as the longest
    /// reading that fits into a frame, [`Node::LONGEST_READING`](crate::Node::LONGEST_READING): drop a longer one, which can
    /// never be sent. Default: none.
    fn poll_reading(&mut self, now: Instant, buffer: &mut [u8]) -> Option<Reading> {
        let _ = (now, buffer);
        None
    }
}

impl<T: Component + ?Sized> Component for &mut T {
    fn offer(&self) -> Offer<'_> {
        T::offer(self)
    }

    fn check(&self, goal: &str, why: &mut Report<'_>) -> Result<(), Refused> {
        T::check(self, goal, why)
    }

    fn start(&mut self, now: Instant, goal: &str, why: &mut Report<'_>) -> Result<(), Refused> {
        T::start(self, now, goal, why)
    }

    fn poll(&mut self, now: Instant, report: &mut Report<'_>) -> Run {
        T::poll(self, now, report)
    }

    fn abort(&mut self, now: Instant) {
        T::abort(self, now);
    }

    fn make_safe(&mut self, now: Instant) {
        T::make_safe(self, now);
    }

    fn poll_timeout(&self, now: Instant) -> Instant {
        T::poll_timeout(self, now)
    }

    fn poll_reading(&mut self, now: Instant, buffer: &mut [u8]) -> Option<Reading> {
        T::poll_reading(self, now, buffer)
    }
}

/// All that a node moves: an array of components of one type, a tuple of up to six types, or a
/// mutable reference to either or to a slice, as `&mut [&mut dyn Component]`.
///
/// Their order is their number on the link.
pub trait Components {
    /// How many; at most 255 can be used.
    fn count(&self) -> usize;

    /// The component of this number.
    fn component(&self, index: usize) -> Option<&dyn Component>;

    /// The component of this number, to be moved.
    fn component_mut(&mut self, index: usize) -> Option<&mut dyn Component>;
}

impl<T: Component> Components for [T] {
    fn count(&self) -> usize {
        self.len()
    }

    fn component(&self, index: usize) -> Option<&dyn Component> {
        self.get(index).map(|one| one as &dyn Component)
    }

    fn component_mut(&mut self, index: usize) -> Option<&mut dyn Component> {
        self.get_mut(index).map(|one| one as &mut dyn Component)
    }
}

impl<T: Component, const N: usize> Components for [T; N] {
    fn count(&self) -> usize {
        N
    }

    fn component(&self, index: usize) -> Option<&dyn Component> {
        self.as_slice().component(index)
    }

    fn component_mut(&mut self, index: usize) -> Option<&mut dyn Component> {
        self.as_mut_slice().component_mut(index)
    }
}

impl<C: Components + ?Sized> Components for &mut C {
    fn count(&self) -> usize {
        C::count(self)
    }

    fn component(&self, index: usize) -> Option<&dyn Component> {
        C::component(self, index)
    }

    fn component_mut(&mut self, index: usize) -> Option<&mut dyn Component> {
        C::component_mut(self, index)
    }
}

macro_rules! tuples {
    ($($count:literal: $($name:ident $index:tt),+;)+) => {
        $(impl<$($name: Component),+> Components for ($($name,)+) {
            fn count(&self) -> usize {
                $count
            }

            fn component(&self, index: usize) -> Option<&dyn Component> {
                match index {
                    $($index => Some(&self.$index),)+
                    _ => None,
                }
            }

            fn component_mut(&mut self, index: usize) -> Option<&mut dyn Component> {
                match index {
                    $($index => Some(&mut self.$index),)+
                    _ => None,
                }
            }
        })+
    };
}

tuples! {
    1: A 0;
    2: A 0, B 1;
    3: A 0, B 1, C 2;
    4: A 0, B 1, C 2, D 3;
    5: A 0, B 1, C 2, D 3, E 4;
    6: A 0, B 1, C 2, D 3, E 4, F 5;
}

/// Where a component writes its progress, result, or reason to refuse; of fixed length.
///
/// What does not fit is cut, and `…` marks the cut; for the mark the last 3 bytes are kept free. It starts empty at each
/// call.
#[derive(Debug)]
pub struct Report<'a> {
    text: &'a mut StringView,
    cut: bool,
}

impl<'a> Report<'a> {
    /// An empty report, kept in `text`. The node makes them; tests of a component may.
    pub fn new(text: &'a mut StringView) -> Self {
        text.clear();
        Self { text, cut: false }
    }

    /// What has been written.
    #[must_use]
    pub fn as_str(&self) -> &str {
        self.text
    }

    /// Adds text.
    #[cfg_attr(target_os = "none", inline(never))]
    pub fn text(&mut self, text: &str) {
        if self.cut {
            return;
        }
        self.cut = push_cut(self.text, text);
    }

    /// Adds a number with this many decimals (at most 6).
    pub fn number(&mut self, value: f32, decimals: u8) {
        let mut buffer = [0; 32];
        let mut sink = SliceSink::new(&mut buffer);
        put_fixed(&mut sink, value, decimals);
        let digits = sink.finish().unwrap_or_default();
        self.text(core::str::from_utf8(digits).unwrap_or_default());
    }
}

/// Each piece is a text of its own.
impl Sink for Report<'_> {
    fn put(&mut self, bytes: &[u8]) {
        self.text(core::str::from_utf8(bytes).unwrap_or_default());
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ztl_core::link::{Busy, GoalShape, Loss};

    /// Its name is all there is.
    struct Named(&'static str);

    impl Component for Named {
        fn offer(&self) -> Offer<'_> {
            let goal = GoalShape {
                range: None,
                unit: "",
                words: "",
            };
            Offer {
                name: self.0,
                goal,
                busy: Busy::Refuse,
                loss: Loss::Abort,
                topics: "",
            }
        }

        fn check(&self, _: &str, _: &mut Report<'_>) -> Result<(), Refused> {
            Err(Refused)
        }

        fn start(&mut self, _: Instant, _: &str, _: &mut Report<'_>) -> Result<(), Refused> {
            Err(Refused)
        }

        fn poll(&mut self, _: Instant, _: &mut Report<'_>) -> Run {
            Run::Failed
        }

        fn abort(&mut self, _: Instant) {}

        fn make_safe(&mut self, _: Instant) {}
    }

    fn names(mut components: impl Components) -> std::vec::Vec<std::string::String> {
        assert!(components.component(components.count()).is_none());
        assert!(components.component_mut(components.count()).is_none());
        let mut names = std::vec::Vec::new();
        for index in 0..components.count() {
            let name = components.component(index).unwrap().offer().name.into();
            names.push(name);
            let again = components.component_mut(index).unwrap();
            assert_eq!(names[index], again.offer().name);
        }
        names
    }

    #[test]
    fn arrays_tuples_and_references_are_components_in_their_order() {
        assert_eq!(names([Named("a"), Named("b")]), ["a", "b"]);
        assert_eq!(names((Named("a"),)), ["a"]);
        let (mut one, mut other) = (Named("b"), Named("c"));
        assert_eq!(names((Named("a"), &mut one, &mut other)), ["a", "b", "c"]);
        let mut list: [&mut dyn Component; 2] = [&mut one, &mut other];
        assert_eq!(names(&mut list), ["b", "c"]);
        let slice: &mut [&mut dyn Component] = &mut list;
        assert_eq!(names(slice), ["b", "c"]);
    }

    #[test]
    fn a_report_that_does_not_fit_is_cut_and_marked() {
        for (parts, expected) in [
            (&["12345678"][..], "12345678"),
            (&["123456789"], "12345678…"),
            (&["1234567", "89", "10"], "12345678…"),
            (&["1234567", "ä", "x"], "1234567…"),
            (&["ääää", "x", "y"], "ääää…"),
        ] {
            let mut text = heapless::String::<11>::new();
            let mut report = Report::new(&mut text);
            for part in parts {
                report.text(part);
            }
            assert_eq!(text.as_str(), expected);
        }
    }
}
