//! Goals as typed values: structs, enums, numbers.

use serde::de::DeserializeOwned;
use ztl_core::goal;

use crate::component::{Refused, Report};

/// Scratch for texts with escapes in a goal, in bytes.
const SCRATCH: usize = 64;

/// Parses a goal into a value of the component's own type, for [`check`](crate::Component::check) and
/// [`start`](crate::Component::start).
///
/// [`ztl_core::goal`] describes the format: what Python's `str` and YAML write, a struct as a mapping or as a
/// sequence of its fields. The value owns its texts, like `heapless::String`.
///
/// ```
/// use serde::Deserialize;
/// use ztl_mcu::link::{Busy, Offer};
/// use ztl_mcu::{Component, Instant, Refused, Report, Run, parse_goal};
///
/// #[derive(Deserialize)]
/// #[serde(deny_unknown_fields)]
/// struct Pose { x: f32, y: f32, theta: f32 }
///
/// #[derive(Default)]
/// struct Base { speed: f32 }
///
/// impl Component for Base {
///     fn offer(&self) -> Offer<'_> {
///         Offer::new("base").with_unit("[x, y, theta] in m and rad").with_busy(Busy::Replace)
///     }
///     fn check(&self, goal: &str, why: &mut Report<'_>) -> Result<(), Refused> {
///         let pose: Pose = parse_goal(goal, why)?;
///         if pose.x.abs() > 2.0 || pose.y.abs() > 2.0 {
///             why.text("base moves at most 2 m");
///             return Err(Refused);
///         }
///         Ok(())
///     }
///     fn start(&mut self, _: Instant, goal: &str, why: &mut Report<'_>) -> Result<(), Refused> {
///         let pose: Pose = parse_goal(goal, why)?;
///         self.speed = pose.x.hypot(pose.y) / 2.0 + pose.theta;
///         Ok(())
///     }
///     # fn poll(&mut self, _: Instant, _: &mut Report<'_>) -> Run { Run::Completed }
///     # fn abort(&mut self, _: Instant) { self.speed = 0.0; }
///     # fn make_safe(&mut self, _: Instant) { self.speed = 0.0; }
///     // poll, abort and make_safe as for any component.
/// }
///
/// let base = Base::default();
/// # let mut text = ztl_mcu::Reason::new();
/// # let mut why = Report::new(&mut text);
/// for goal in ["[0, 0, 1.57]", "{'x': 0, 'y': 0, 'theta': 1.57}"] {
///     assert_eq!(base.check(goal, &mut why), Ok(()));
/// }
/// assert_eq!(base.check("[0, 0, north]", &mut why), Err(Refused));
/// assert_eq!(why.as_str(), "goal, byte 7: expected a number");
/// ```
///
/// # Errors
/// [`Refused`] if the goal does not parse. `why` then says at which byte, and what was expected there.
pub fn parse_goal<G: DeserializeOwned>(goal: &str, why: &mut Report<'_>) -> Result<G, Refused> {
    goal::from_str_with(goal, &mut [0; SCRATCH]).map_err(|error| {
        error.put(why);
        Refused
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde::Deserialize;
    use std::string::{String, ToString};

    #[derive(Debug, PartialEq, Deserialize)]
    #[serde(deny_unknown_fields)]
    struct Pose {
        x: f32,
        y: f32,
        theta: f32,
    }

    fn parsed(goal: &str) -> Result<Pose, String> {
        let mut text = crate::Reason::new();
        let mut why = Report::new(&mut text);
        parse_goal(goal, &mut why).map_err(|Refused| why.as_str().to_string())
    }

    #[test]
    fn a_struct_is_parsed_from_a_list_or_a_mapping() {
        let (x, y, theta) = (0.0, -0.5, 1.57);
        for goal in ["[0, -0.5, 1.57]", "{'x': 0, 'theta': 1.57, 'y': -0.5}"] {
            assert_eq!(parsed(goal), Ok(Pose { x, y, theta }));
        }
    }

    #[test]
    fn an_invalid_goal_is_rejected_with_position_and_expectation() {
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
        ] {
            assert_eq!(parsed(goal), Err(reason.to_string()), "{goal}");
        }
    }
}
