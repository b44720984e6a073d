//! What moves: the part of a node that the firmware provides.

use core::time::Duration;

#[cfg(feature = "serde")]
mod value;

use heapless::string::StringView;
use ztl_core::Instant;
use ztl_core::link::Offer;
use ztl_core::sink::{Sink, SliceSink, put_fixed};
#[cfg(feature = "serde")]
use ztl_core::tasks::CUT;
use ztl_core::tasks::push_cut;

use crate::acting::OwnWork;
use crate::bus::BusState;
use crate::parameters::Tuning;

/// The state of a component's task.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Run {
    /// The task runs; the report is its progress.
    Running,
    /// The goal will not be reached; the report is the reason.
    Failed,
    /// The task stopped after [`Component::abort`]; the report says where.
    Aborted,
    /// The goal is reached; the report is the result.
    Completed,
}

/// The component refuses the goal; the report says why.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Refused;

/// A reading that [`Component::poll_reading`] wrote.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Reading {
    /// Index of the topic in the component's offer.
    pub topic: u8,
    /// Length of the reading in bytes.
    pub len: usize,
}

/// A part that carries out one task at a time.
///
/// The node calls `check` for each task that arrives and `start` for one that may begin. It then calls `poll`
/// when `poll_timeout` asks for it, until `poll` returns something other than [`Run::Running`]. Without a task
/// it calls `poll` only if [`next_tick`](Self::next_tick) asks for it, or after `make_safe`. It calls `abort`,
/// `make_safe` and `poll_reading` at any time. No call may block, because the main loop makes each of them
/// between two bytes of the link.
///
/// **A second task.** The node never runs two tasks on one component. The offer chooses what happens to the
/// second one ([`Busy`](ztl_core::link::Busy)):
/// - *Refuse*: the node refuses it with `busy with another task`.
/// - *Queue(n)*: the node checks and accepts it. It waits with at most n - 1 others, and its goal has at most
///   48 bytes. When the running task has ended, the task with the lowest id begins. If `start` then refuses
///   it, it ends as FAILED with that reason.
/// - *Replace*: the node checks and accepts it, and aborts the running task, which ends as ABORTED with
///   `replaced by a later task`. The new task begins when the old one has stopped. A third task replaces the
///   waiting one.
///
/// An abort ends a waiting task at once as ABORTED with `aborted before it began`.
///
/// **When the link is lost** ([`Loss`](ztl_core::link::Loss)), a component with *abort* or *hold* goes to its
/// safe state, with or without a task: a relay that an earlier task switched on goes off. The node calls
/// `make_safe`, then `poll` until it returns something other than [`Run::Running`], which means that the safe
/// state is reached. All tasks of the component end as FAILED with `link was lost`: a waiting one at once, the
/// running one when the component is safe. With *carry on* nothing changes, and waiting tasks still begin.
///
/// **In an emergency stop** every component goes to its safe state in the same way, and all tasks end as
/// ABORTED with `emergency stop`. A component takes no task until it has reached its safe state.
pub trait Component {
    /// Describes the component and its goals. The gateway asks once a session. Must not change.
    fn offer(&self) -> Offer<'_>;

    /// Checks a goal without moving anything. Called before a task is accepted, also for one that will wait.
    ///
    /// # Errors
    /// [`Refused`]. `why` explains to the author of the goal what is wrong and which goals are valid. The
    /// gateway adds the goal itself.
    fn check(&self, goal: &str, why: &mut Report<'_>) -> Result<(), Refused>;

    /// Starts a task whose goal was checked. Called only while no task runs, and after `make_safe` only when
    /// the safe state is reached.
    ///
    /// # Errors
    /// [`Refused`], with the reason in `why`. Nothing has moved.
    fn start(&mut self, now: Instant, goal: &str, why: &mut Report<'_>) -> Result<(), Refused>;

    /// Advances the task and reports its progress. Any result but [`Run::Running`] ends the task.
    ///
    /// After `make_safe` the node also calls it without a task: [`Run::Running`] means that the safe state is
    /// not reached yet. It may be called again after that, and must leave the component safe. A component with
    /// a [tick](Self::next_tick) is called without a task too; the return value then says the same.
    fn poll(&mut self, now: Instant, report: &mut Report<'_>) -> Run;

    /// Stops the task as soon as it is safe. A later `poll` returns [`Run::Aborted`], or how else it ended.
    fn abort(&mut self, now: Instant);

    /// Goes to the safe state, with or without a task: the link was lost, or there is an emergency stop. For
    /// [`Loss::Hold`](ztl_core::link::Loss::Hold) that means to keep the position under power.
    ///
    /// What takes time, such as slowing down, continues in `poll` until it returns something other than
    /// [`Run::Running`]. Until then `poll_timeout` or `next_tick` must ask for the next one: a component that asks
    /// for none counts as safe. Do not continue the task: it ends with any return value of `poll`.
    fn make_safe(&mut self, now: Instant);

    /// When to call `poll` next; the node asks after each `poll` of a task. Also when to call `poll_reading`,
    /// if the offer names topics and there was no reading. With [`Instant::NEVER`] only an abort, the loss of
    /// the link, an emergency stop or a tick causes the next `poll`. Defaults to 10 ms from now.
    fn poll_timeout(&self, now: Instant) -> Instant {
        now + Duration::from_millis(10)
    }

    /// When to call `poll` next with or without a task: for a control loop, a status light, a motor that slows
    /// down after its task has ended. Defaults to [`Instant::NEVER`].
    ///
    /// Return a time that the component stores, and move it on in `poll`: `now` plus the interval. While the
    /// time has passed, every turn of the main loop calls `poll`. Each component has its own interval.
    fn next_tick(&self) -> Instant {
        Instant::NEVER
    }

    /// The result of the last completed task, if it is longer than a report of 48 bytes; empty, the default, if the
    /// report says all.
    ///
    /// The component keeps it unchanged until its next `start`, which the node delays until a gateway has the result: to
    /// the node the component is busy until then. A result longer than
    /// [`Node::LONGEST_RESULT`](crate::Node::LONGEST_RESULT) is cut and ends in `…`.
    ///
    /// ```
    /// # use ztl_mcu::Report;
    /// struct Scanner {
    ///     found: heapless::String<503>,
    /// }
    ///
    /// impl Scanner {
    ///     /// Called by `poll` before it returns `Run::Completed`; `Component::result` returns `&self.found`.
    ///     fn complete(&mut self, positions: &[f32]) {
    ///         let mut report = Report::new(&mut self.found);
    ///         # #[cfg(feature = "serde")]
    ///         let _ = report.value(positions, 1);
    ///         assert!(!report.is_cut());
    ///     }
    /// }
    /// # Scanner { found: heapless::String::new() }.complete(&[1.0]);
    /// ```
    fn result(&self) -> &str {
        ""
    }

    /// Writes the next reading into `buffer`, if one is due and fits. Defaults to `None`.
    ///
    /// Called when the line is free, at most once per
    /// [`reading_interval`](crate::Identity::reading_interval). The buffer has room for the longest reading
    /// that fits a frame, [`Node::LONGEST_READING`](crate::Node::LONGEST_READING). Drop a longer reading,
    /// because it can never be sent.
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

    fn next_tick(&self) -> Instant {
        T::next_tick(self)
    }

    fn result(&self) -> &str {
        T::result(self)
    }

    fn poll_reading(&mut self, now: Instant, buffer: &mut [u8]) -> Option<Reading> {
        T::poll_reading(self, now, buffer)
    }
}

/// The components of a node: an array of one type, a tuple of up to twelve types, or a mutable reference to
/// either or to a slice, such as `&mut [&mut dyn Component]`.
///
/// Their order gives their index on the link.
pub trait Components {
    /// Whether they [describe](Self::description) themselves. If not, the node has no code for it.
    const DESCRIBED: bool = false;

    /// Whether the firmware starts tasks itself and reports events. If not, the node contains no code for either.
    const ACTING: bool = false;

    /// Number of parameters that clients may set. With 0, the node contains no code for parameters.
    const PARAMETER_COUNT: u8 = 0;

    /// Number of components; the first 255 are used.
    fn count(&self) -> usize;

    /// The component with this index.
    fn component(&self, index: usize) -> Option<&dyn Component>;

    /// The component with this index, mutable.
    fn component_mut(&mut self, index: usize) -> Option<&mut dyn Component>;

    /// The state of a node on a shared line, from [`OnBus`](crate::bus::OnBus). Without it, the node has no code for that.
    fn bus(&self) -> Option<&BusState> {
        None
    }

    /// Like [`bus`](Self::bus), mutable.
    fn bus_mut(&mut self) -> Option<&mut BusState> {
        None
    }

    /// The [tick](Component::next_tick) of the component with this index, or [`Instant::NEVER`]. An implementation that
    /// knows the components' types calls them directly: firmware without ticks then has no code for them.
    fn next_tick(&self, index: usize) -> Instant {
        self.component(index)
            .map_or(Instant::NEVER, Component::next_tick)
    }

    /// The [long result](Component::result) of the component with this index, or nothing. An implementation that knows the
    /// components' types calls them directly: firmware without long results then has no code for them.
    fn result(&self, index: usize) -> &str {
        self.component(index).map_or("", Component::result)
    }

    /// What a component says of itself, in JSON (`docs/protocol.md` [11.7]); empty if it says nothing.
    /// [`Described`](crate::describe::Described) knows it from the components' types. All of them together must fit
    /// into 48 bytes for each index up to 255 that is not a component's; more is never sent.
    fn description(&self, index: usize) -> &str {
        let _ = index;
        ""
    }

    /// What the firmware does itself; only [`Acting`](crate::Acting) has it.
    fn own_work(&self) -> Option<&OwnWork> {
        None
    }

    /// The same, mutable.
    fn own_work_mut(&mut self) -> Option<&mut OwnWork> {
        None
    }

    /// Their parameters; [`Tuned`](crate::parameters::Tuned) has some.
    fn tuning(&self) -> Option<&dyn Tuning> {
        None
    }

    /// Their parameters, mutable.
    fn tuning_mut(&mut self) -> Option<&mut dyn Tuning> {
        None
    }
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

    fn next_tick(&self, index: usize) -> Instant {
        self.get(index).map_or(Instant::NEVER, T::next_tick)
    }

    fn result(&self, index: usize) -> &str {
        self.get(index).map_or("", T::result)
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

    fn next_tick(&self, index: usize) -> Instant {
        self.as_slice().next_tick(index)
    }

    fn result(&self, index: usize) -> &str {
        self.as_slice().result(index)
    }
}

impl<C: Components + ?Sized> Components for &mut C {
    const DESCRIBED: bool = C::DESCRIBED;
    const ACTING: bool = C::ACTING;
    const PARAMETER_COUNT: u8 = C::PARAMETER_COUNT;

    fn count(&self) -> usize {
        C::count(self)
    }

    fn component(&self, index: usize) -> Option<&dyn Component> {
        C::component(self, index)
    }

    fn component_mut(&mut self, index: usize) -> Option<&mut dyn Component> {
        C::component_mut(self, index)
    }

    fn next_tick(&self, index: usize) -> Instant {
        C::next_tick(self, index)
    }

    fn result(&self, index: usize) -> &str {
        C::result(self, index)
    }

    fn description(&self, index: usize) -> &str {
        C::description(self, index)
    }

    fn bus(&self) -> Option<&BusState> {
        C::bus(self)
    }

    fn bus_mut(&mut self) -> Option<&mut BusState> {
        C::bus_mut(self)
    }

    fn own_work(&self) -> Option<&OwnWork> {
        C::own_work(self)
    }

    fn own_work_mut(&mut self) -> Option<&mut OwnWork> {
        C::own_work_mut(self)
    }

    fn tuning(&self) -> Option<&dyn Tuning> {
        C::tuning(self)
    }

    fn tuning_mut(&mut self) -> Option<&mut dyn Tuning> {
        C::tuning_mut(self)
    }
}

/// Implements parts of [`Components`] for a wrapper by those of the components in this field.
macro_rules! forward {
    ($field:tt: $($part:ident)+) => {
        $(forward!(@$part $field);)+
    };
    (@parts $field:tt) => {
        fn count(&self) -> usize {
            self.$field.count()
        }

        fn component(&self, index: usize) -> Option<&dyn Component> {
            self.$field.component(index)
        }

        fn component_mut(
            &mut self,
            index: usize,
        ) -> Option<&mut dyn Component> {
            self.$field.component_mut(index)
        }

        fn next_tick(&self, index: usize) -> Instant {
            self.$field.next_tick(index)
        }

        fn result(&self, index: usize) -> &str {
            self.$field.result(index)
        }
    };
    (@descriptions $field:tt) => {
        const DESCRIBED: bool = C::DESCRIBED;

        fn description(&self, index: usize) -> &str {
            self.$field.description(index)
        }
    };
    (@bus $field:tt) => {
        fn bus(&self) -> Option<&BusState> {
            self.$field.bus()
        }

        fn bus_mut(&mut self) -> Option<&mut BusState> {
            self.$field.bus_mut()
        }
    };
    (@own_work $field:tt) => {
        const ACTING: bool = C::ACTING;

        fn own_work(&self) -> Option<&OwnWork> {
            self.$field.own_work()
        }

        fn own_work_mut(&mut self) -> Option<&mut OwnWork> {
            self.$field.own_work_mut()
        }
    };
    (@parameters $field:tt) => {
        const PARAMETER_COUNT: u8 = C::PARAMETER_COUNT;

        fn tuning(&self) -> Option<&dyn Tuning> {
            self.$field.tuning()
        }

        fn tuning_mut(&mut self) -> Option<&mut dyn Tuning> {
            self.$field.tuning_mut()
        }
    };
}
pub(crate) use forward;

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

            fn next_tick(&self, index: usize) -> Instant {
                match index {
                    $($index => self.$index.next_tick(),)+
                    _ => Instant::NEVER,
                }
            }

            fn result(&self, index: usize) -> &str {
                match index {
                    $($index => self.$index.result(),)+
                    _ => "",
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
    7: A 0, B 1, C 2, D 3, E 4, F 5, G 6;
    8: A 0, B 1, C 2, D 3, E 4, F 5, G 6, H 7;
    9: A 0, B 1, C 2, D 3, E 4, F 5, G 6, H 7, I 8;
    10: A 0, B 1, C 2, D 3, E 4, F 5, G 6, H 7, I 8, J 9;
    11: A 0, B 1, C 2, D 3, E 4, F 5, G 6, H 7, I 8, J 9, K 10;
    12: A 0, B 1, C 2, D 3, E 4, F 5, G 6, H 7, I 8, J 9, K 10, L 11;
}

/// A component's progress, result, or reason for a refusal, in a buffer of fixed length.
///
/// Text that does not fit is cut and ends in `…`; the last 3 bytes are reserved for that mark. Each call starts
/// with an empty report.
#[derive(Debug)]
pub struct Report<'a> {
    text: &'a mut StringView,
    cut: bool,
}

impl<'a> Report<'a> {
    /// An empty report, stored in `text`. The node creates them; tests of a component may.
    pub fn new(text: &'a mut StringView) -> Self {
        text.clear();
        Self { text, cut: false }
    }

    /// The text written so far.
    #[must_use]
    pub fn as_str(&self) -> &str {
        self.text
    }

    /// Bytes that fit in all, without the mark of a cut.
    #[cfg(feature = "serde")]
    fn room(&self) -> usize {
        self.text.capacity().saturating_sub(CUT.len())
    }

    /// Whether text was cut, because it did not fit.
    #[must_use]
    pub const fn is_cut(&self) -> bool {
        self.cut
    }

    /// Adds text.
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

    /// Adds a value as text that programs read: a struct as a mapping, numbers with this many decimals
    /// ([`ztl_core::goal`] describes the format).
    ///
    /// ```
    /// # let mut text = ztl_mcu::Reason::new();
    /// # let mut report = ztl_mcu::Report::new(&mut text);
    /// #[derive(serde::Serialize)]
    /// struct Grip { width: f32, held: bool }
    ///
    /// report.value(&Grip { width: 20.25, held: true }, 1)?;
    /// assert_eq!(report.as_str(), "{'width': 20.2, 'held': True}");
    /// # Ok::<(), ztl_mcu::WriteError>(())
    /// ```
    ///
    /// # Errors
    /// [`WriteError`](crate::WriteError) if the value has too many levels, its own code fails, the text does not fit, or a
    /// number is infinite or not a number, which programs cannot read. The report then stays as it was.
    #[cfg(feature = "serde")]
    pub fn value<T>(&mut self, value: &T, decimals: u8) -> Result<(), ztl_core::goal::WriteError>
    where
        T: serde::Serialize + ?Sized,
    {
        value::write(self, value, decimals)
    }
}

/// Each piece must be valid UTF-8.
impl Sink for Report<'_> {
    fn put(&mut self, bytes: &[u8]) {
        self.text(core::str::from_utf8(bytes).unwrap_or_default());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A component that only has a name.
    struct Named(&'static str);

    impl Component for Named {
        fn offer(&self) -> Offer<'_> {
            Offer::new(self.0)
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
    fn arrays_tuples_and_references_keep_their_component_order() {
        assert_eq!(names([Named("a"), Named("b")]), ["a", "b"]);
        assert_eq!(names((Named("a"),)), ["a"]);
        let [a, b, c] = ["a", "b", "c"].map(|name| move || Named(name));
        let twelve = (a(), b(), c(), a(), b(), c(), a(), b(), c(), a(), b(), c());
        assert_eq!(names(twelve), ["a", "b", "c"].repeat(4));
        let (mut one, mut other) = (Named("b"), Named("c"));
        assert_eq!(names((Named("a"), &mut one, &mut other)), ["a", "b", "c"]);
        let mut list: [&mut dyn Component; 2] = [&mut one, &mut other];
        assert_eq!(names(&mut list), ["b", "c"]);
        let slice: &mut [&mut dyn Component] = &mut list;
        assert_eq!(names(slice), ["b", "c"]);
    }

    #[cfg(feature = "serde")]
    #[test]
    fn a_value_that_programs_cannot_read_is_an_error_and_leaves_the_report() {
        use ztl_core::goal::WriteError;
        use ztl_core::sink::BufferTooSmall;

        let mut text = heapless::String::<15>::new();
        let mut report = Report::new(&mut text);
        report.text("at ");
        let too_long = Err(WriteError::BufferTooSmall(BufferTooSmall::new(15, 12)));
        for (value, result) in [
            ([1.0, f32::NAN], Err(WriteError::NotFinite)),
            ([f32::NEG_INFINITY, 1.0], Err(WriteError::NotFinite)),
            ([10.0, 12.5], too_long),
        ] {
            assert_eq!(report.value(&value, 1), result);
            assert_eq!(report.as_str(), "at ");
        }
        assert_eq!(report.value(&[1.0, 2.5], 0), Ok(()));
        assert_eq!(report.as_str(), "at [1, 2]");
        report.text(", or longer");
        assert!(matches!(
            report.value(&1.0, 0),
            Err(WriteError::BufferTooSmall(_))
        ));
    }

    #[test]
    fn an_oversized_report_is_truncated_and_marked() {
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
