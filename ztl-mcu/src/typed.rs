//! Components whose goals are typed values: structs, enums, numbers.

use serde::de::DeserializeOwned;
use ztl_core::link::Offer;
use ztl_core::{Instant, goal};

use crate::component::{Component, Reading, Refused, Report, Run};

/// Scratch for texts with escapes in a goal, in bytes.
const SCRATCH: usize = 64;

/// A component whose goal is a value of its own type; [`Typed`] parses it from the goal's text.
///
/// Each method has the contract of the [`Component`] method with the same name.
///
/// ```
/// use serde::Deserialize;
/// use ztl_mcu::link::{Busy, GoalShape, Loss, Offer};
/// use ztl_mcu::{Actuator, Component, Instant, Refused, Report, Run, Typed};
///
/// #[derive(Deserialize)]
/// #[serde(deny_unknown_fields)]
/// struct Pose { x: f32, y: f32, theta: f32 }
///
/// #[derive(Default)]
/// struct Base { speed: f32 }
///
/// impl Actuator for Base {
///     type Goal = Pose;
///
///     fn offer(&self) -> Offer<'_> {
///         let goal = GoalShape { range: None, unit: "[x, y, theta] in m and rad", words: "" };
///         Offer { name: "base", goal, busy: Busy::Replace, loss: Loss::Abort, topics: "" }
///     }
///     fn check(&self, pose: &Pose, why: &mut Report<'_>) -> Result<(), Refused> {
///         if pose.x.abs() > 2.0 || pose.y.abs() > 2.0 {
///             why.text("base moves at most 2 m");
///             return Err(Refused);
///         }
///         Ok(())
///     }
///     fn start(&mut self, _: Instant, pose: Pose, _: &mut Report<'_>) -> Result<(), Refused> {
///         self.speed = pose.x.hypot(pose.y) / 2.0 + pose.theta;
///         Ok(())
///     }
///     # fn poll(&mut self, _: Instant, _: &mut Report<'_>) -> Run { Run::Completed }
///     # fn abort(&mut self, _: Instant) { self.speed = 0.0; }
///     # fn make_safe(&mut self, _: Instant) { self.speed = 0.0; }
///     // poll, abort and make_safe are those of a component.
/// }
///
/// let base = Typed(Base::default());
/// # let mut text = ztl_mcu::Reason::new();
/// # let mut why = Report::new(&mut text);
/// for goal in ["[0, 0, 1.57]", "{'x': 0, 'y': 0, 'theta': 1.57}"] {
///     assert_eq!(base.check(goal, &mut why), Ok(()));
/// }
/// assert_eq!(base.check("[0, 0, north]", &mut why), Err(Refused));
/// assert_eq!(why.as_str(), "goal, byte 7: expected a number");
/// ```
pub trait Actuator {
    /// The type of a goal. It owns its texts, like `heapless::String`.
    type Goal: DeserializeOwned;

    /// Describes the component and the goals it takes.
    fn offer(&self) -> Offer<'_>;

    /// Checks a goal without moving anything. By default accepts every goal that parses.
    ///
    /// # Errors
    /// [`Refused`], with `why` saying what is wrong with the goal and what would be right.
    fn check(&self, goal: &Self::Goal, why: &mut Report<'_>) -> Result<(), Refused> {
        let _ = (goal, why);
        Ok(())
    }

    /// Starts a task whose goal has been checked.
    ///
    /// # Errors
    /// [`Refused`], with the reason in `why`; nothing has moved.
    fn start(
        &mut self,
        now: Instant,
        goal: Self::Goal,
        why: &mut Report<'_>,
    ) -> Result<(), Refused>;

    /// Advances the task and reports its progress.
    fn poll(&mut self, now: Instant, report: &mut Report<'_>) -> Run;

    /// Stops the task as soon as it is safe.
    fn abort(&mut self, now: Instant);

    /// Goes to the safe state; `poll` is called until it is reached.
    fn make_safe(&mut self, now: Instant);

    /// When to call `poll` and `poll_reading` next. Defaults to 10 ms from now.
    fn poll_timeout(&self, now: Instant) -> Instant {
        now + core::time::Duration::from_millis(10)
    }

    /// The next reading to publish, if any. Defaults to `None`.
    fn poll_reading(&mut self, now: Instant, buffer: &mut [u8]) -> Option<Reading> {
        let _ = (now, buffer);
        None
    }
}

/// Adapts an [`Actuator`] to a [`Component`].
///
/// Goals are parsed as [`ztl_core::goal`] describes: as Python's `str` and YAML write them, a struct as a
/// mapping or as a sequence of its fields. A goal that does not parse is refused, with the position and what
/// was expected there.
/// was expected there.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Default)]
pub struct Typed<A>(
    /// The actuator.
    pub A,
);

fn read<G: DeserializeOwned>(text: &str, why: &mut Report<'_>) -> Result<G, Refused> {
    goal::from_str_with(text, &mut [0; SCRATCH]).map_err(|error| {
        error.put(why);
        Refused
    })
}

impl<A: Actuator> Component for Typed<A> {
    fn offer(&self) -> Offer<'_> {
        self.0.offer()
    }

    fn check(&self, goal: &str, why: &mut Report<'_>) -> Result<(), Refused> {
        self.0.check(&read(goal, why)?, why)
    }

    fn start(&mut self, now: Instant, goal: &str, why: &mut Report<'_>) -> Result<(), Refused> {
        self.0.start(now, read(goal, why)?, why)
    }

    fn poll(&mut self, now: Instant, report: &mut Report<'_>) -> Run {
        self.0.poll(now, report)
    }

    fn abort(&mut self, now: Instant) {
        self.0.abort(now);
    }

    fn make_safe(&mut self, now: Instant) {
        self.0.make_safe(now);
    }

    fn poll_timeout(&self, now: Instant) -> Instant {
        self.0.poll_timeout(now)
    }

    fn poll_reading(&mut self, now: Instant, buffer: &mut [u8]) -> Option<Reading> {
        self.0.poll_reading(now, buffer)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde::Deserialize;
    use std::string::{String, ToString};
    use ztl_core::link::{Busy, GoalShape, Loss};

    #[derive(Debug, Deserialize)]
    #[serde(deny_unknown_fields)]
    struct Pose {
        x: f32,
        y: f32,
        theta: f32,
    }

    #[derive(Default)]
    struct Base {
        went: [f32; 3],
    }

    impl Actuator for Base {
        type Goal = Pose;

        fn offer(&self) -> Offer<'_> {
            let goal = GoalShape {
                range: None,
                unit: "m m rad",
                words: "",
            };
            Offer {
                name: "base",
                goal,
                busy: Busy::Refuse,
                loss: Loss::Abort,
                topics: "",
            }
        }

        fn check(&self, pose: &Pose, why: &mut Report<'_>) -> Result<(), Refused> {
            if pose.x > 2.0 {
                why.text("x is at most 2");
                return Err(Refused);
            }
            Ok(())
        }

        fn start(&mut self, _: Instant, pose: Pose, _: &mut Report<'_>) -> Result<(), Refused> {
            self.went = [pose.x, pose.y, pose.theta];
            Ok(())
        }

        fn poll(&mut self, _: Instant, _: &mut Report<'_>) -> Run {
            Run::Completed
        }

        fn abort(&mut self, _: Instant) {}

        fn make_safe(&mut self, _: Instant) {}
    }

    fn refusal(goal: &str) -> Option<String> {
        let mut text = crate::Reason::new();
        let mut why = Report::new(&mut text);
        let refused = Typed(Base::default()).check(goal, &mut why).is_err();
        refused.then(|| why.as_str().to_string())
    }

    #[test]
    fn a_struct_is_read_from_a_list_or_a_mapping() {
        for goal in ["[0, -0.5, 1.57]", "{'x': 0, 'theta': 1.57, 'y': -0.5}"] {
            assert_eq!(refusal(goal), None);
            let mut base = Typed(Base::default());
            let mut text = crate::Reason::new();
            let started = base.start(Instant::ZERO, goal, &mut Report::new(&mut text));
            assert_eq!(started, Ok(()));
            assert_eq!(base.0.went, [0.0, -0.5, 1.57]);
        }
    }

    #[test]
    fn a_wrong_goal_is_refused_with_position_and_expectation() {
        for (goal, reason) in [
            ("[0, 0, north]", "goal, byte 7: expected a number"),
            ("[0, 0]", "goal, byte 0: too few or too many items"),
            (
                "{x: 0, y: 0, z: 1}",
                "goal, byte 13: unknown field, expected x or y or theta",
            ),
            ("{x: 0, y: 0}", "goal, byte 0: field theta is missing"),
            ("[0, 0, 1", "goal, byte 0: never closed"),
            ("", "goal, byte 0: expected [...] or {field: value}"),
            ("[3, 0, 0]", "x is at most 2"),
        ] {
            assert_eq!(refusal(goal).as_deref(), Some(reason), "{goal}");
        }
    }
}
