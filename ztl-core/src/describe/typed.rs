//! Rules for goals that are parsed into types.

use super::{Field, GoalRule};

/// A type that goals are parsed into, and what such a goal must be. [`goal_fields!`](crate::goal_fields) implements it
/// for structs; for an enum of words it is one line:
///
/// ```
/// use ztl_core::describe::{GoalRule, GoalType};
///
/// enum Side { Left, Right }
///
/// impl GoalType for Side {
///     const GOAL: GoalRule = GoalRule::words(&["left", "right"]);
/// }
/// ```
pub trait GoalType {
    /// What the goal must be.
    const GOAL: GoalRule;
    /// Whether a struct may lack a field of this type.
    const OPTIONAL: bool = false;
}

macro_rules! integers {
    ($($type:ident)+) => {
        $(impl GoalType for $type {
            const GOAL: GoalRule = GoalRule::Number {
                whole: true,
                least: Some($type::MIN as f64),
                most: Some($type::MAX as f64),
                step: None,
                unit: None,
            };
        })+
    };
}

integers!(u8 u16 u32 i8 i16 i32);

impl GoalType for f32 {
    const GOAL: GoalRule = GoalRule::NUMBER;
}

impl GoalType for f64 {
    const GOAL: GoalRule = GoalRule::NUMBER;
}

impl GoalType for bool {
    const GOAL: GoalRule = GoalRule::Bool;
}

impl GoalType for () {
    const GOAL: GoalRule = GoalRule::Nothing;
}

/// A text of `N` bytes has at most `N` characters.
impl<const N: usize> GoalType for heapless::String<N> {
    const GOAL: GoalRule = GoalRule::Text { longest: Some(N) };
}

impl<T: GoalType + 'static, const N: usize> GoalType for [T; N] {
    const GOAL: GoalRule = GoalRule::list(&T::GOAL);
}

impl<T: GoalType> GoalType for Option<T> {
    const GOAL: GoalRule = T::GOAL;
    const OPTIONAL: bool = true;
}

/// A field for [`goal_fields!`](crate::goal_fields).
#[must_use]
pub const fn field<T: GoalType>(name: &'static str, rule: GoalRule) -> Field {
    Field {
        name,
        rule,
        optional: T::OPTIONAL,
        default: None,
    }
}

/// Implements [`GoalType`](crate::describe::GoalType) for a struct: its fields in their order, each with its type and, if
/// that says too little, its rule. The compiler rejects a list of other fields.
///
/// ```
/// use ztl_core::describe::{ComponentDescription, GoalRule, GoalType};
/// use ztl_core::{description, goal_fields};
///
/// struct Drive { metres: f32, fast: Option<bool> }
///
/// goal_fields!(Drive {
///     metres: f32 = GoalRule::range(0.0, 2.0, "m"),
///     fast: Option<bool>,
/// });
///
/// const BASE: &str = description!(ComponentDescription::new(Drive::GOAL));
/// assert_eq!(BASE, concat!(
///     r#"{"goal":{"fields":[{"name":"metres","type":"number","least":0,"most":2,"unit":"m"},"#,
///     r#"{"name":"fast","type":"truth","optional":true}]}}"#,
/// ));
/// ```
///
/// A field is missing:
///
/// ```compile_fail,E0027
/// struct Drive { metres: f32, fast: bool }
///
/// ztl_core::goal_fields!(Drive { metres: f32 });
/// ```
#[macro_export]
macro_rules! goal_fields {
    ($goal:ident { $($name:ident: $type:ty $(= $rule:expr)?),+ $(,)? }) => {
        impl $crate::describe::GoalType for $goal {
            const GOAL: $crate::describe::GoalRule = $crate::describe::GoalRule::fields(&[
                $($crate::describe::field::<$type>(
                    ::core::stringify!($name),
                    $crate::goal_fields!(@ $type $(, $rule)?),
                )),+
            ]);
        }

        const _: fn($goal) = |$goal { $($name),+ }| {
            $(let _: $type = $name;)+
        };
    };
    (@ $type:ty) => {
        <$type as $crate::describe::GoalType>::GOAL
    };
    (@ $type:ty, $rule:expr) => {
        $rule
    };
}
