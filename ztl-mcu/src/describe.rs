//! What components say of themselves: constants beside them, which the gateway asks for piece by piece
//! (`docs/link.md` [4.6]) and shows to people and programs. Firmware without [`Described`] has no code and no
//! constants for it.
//!
//! ```
//! use serde::Deserialize;
//! use ztl_mcu::describe::{ComponentDescription, Describe, Described, GoalType};
//! use ztl_mcu::{description, goal_fields};
//!
//! #[derive(Deserialize)]
//! struct Pose { x: f32, y: f32, theta: f32 }
//!
//! goal_fields!(Pose { x: f32, y: f32, theta: f32 });
//!
//! /// Implements [`Component`](crate::Component) with [`parse_goal`](crate::parse_goal).
//! struct Base;
//!
//! impl Describe for Base {
//!     const DESCRIPTION: &str = description!(ComponentDescription {
//!         about: Some("drives to a place on the desk"),
//!         examples: &["[0, 0, 1.57]"],
//!         ..ComponentDescription::new(Pose::GOAL)
//!     });
//! }
//!
//! // Instead of `(Base,)`, for `Node::new`.
//! let components = Described((Base,));
//! # drop(components);
//! ```

use ztl_core::link::DESCRIPTION_PART;
use ztl_core::link::parameter::NO_COMPONENT;
use ztl_core::link::update::TAKES_UPDATES;

use crate::acting::Acting;
use crate::component::{Components, forward};

pub use ztl_core::describe::{ComponentDescription, ConstPart, Field, GoalRule, GoalType};

/// A type of component that says what it does and which goals it takes.
pub trait Describe {
    /// In JSON (`docs/protocol.md` [11.7]), from [`description!`](crate::description). A number without bounds or
    /// unit has those of the component's [`Offer`](crate::link::Offer). Empty by default: it says nothing.
    const DESCRIPTION: &'static str = "";
}

impl<T: Describe + ?Sized> Describe for &mut T {
    const DESCRIPTION: &'static str = T::DESCRIPTION;
}

/// Components of types that describe themselves: an array of one type, or a tuple of up to twelve.
pub trait DescribeAll {
    /// In the order of the components.
    const DESCRIPTIONS: &'static [&'static str];
}

impl<T: Describe, const N: usize> DescribeAll for [T; N] {
    const DESCRIPTIONS: &'static [&'static str] = &[T::DESCRIPTION; N];
}

impl<C: DescribeAll> DescribeAll for Acting<C> {
    const DESCRIPTIONS: &'static [&'static str] = C::DESCRIPTIONS;
}

impl<C: DescribeAll + ?Sized> DescribeAll for &mut C {
    const DESCRIPTIONS: &'static [&'static str] = C::DESCRIPTIONS;
}

macro_rules! tuples {
    ($($($name:ident)+;)+) => {
        $(impl<$($name: Describe),+> DescribeAll for ($($name,)+) {
            const DESCRIPTIONS: &'static [&'static str] = &[$($name::DESCRIPTION),+];
        })+
    };
}

tuples! {
    A;
    A B;
    A B C;
    A B C D;
    A B C D E;
    A B C D E F;
    A B C D E F G;
    A B C D E F G H;
    A B C D E F G H I;
    A B C D E F G H I J;
    A B C D E F G H I J K;
    A B C D E F G H I J K L;
}

/// Components whose descriptions the node sends, if the gateway asks for them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub struct Described<C>(pub C);

impl<C: Components + DescribeAll> Components for Described<C> {
    const DESCRIBED: bool = {
        assert!(
            parts(C::DESCRIPTIONS)
                + C::DESCRIPTIONS.len()
                + (C::PARAMETER_COUNT > 0 || C::UPDATES) as usize
                <= 256,
            "the descriptions are too long: 48 bytes for each index that is not a component's"
        );
        true
    };

    forward!(0: parts bus own_work parameters updates);

    fn description(&self, index: usize) -> &str {
        C::DESCRIPTIONS.get(index).copied().unwrap_or_default()
    }
}

/// Number of messages that these descriptions take.
const fn parts(descriptions: &[&str]) -> usize {
    let (mut rest, mut parts) = (descriptions, 0);
    while let [first, behind @ ..] = rest {
        parts += first.len().div_ceil(DESCRIPTION_PART);
        rest = behind;
    }
    parts
}

/// Whether there is anything for an index beyond the components.
pub(crate) const fn has_parts<C: Components>() -> bool {
    C::DESCRIBED || C::PARAMETER_COUNT > 0 || C::UPDATES
}

/// The part of the descriptions for an index beyond the components: the component, and the next bytes of its
/// description. The last one announces parameters ([13.1]) and updates ([16.1]).
pub(crate) fn part<C: Components>(components: &C, index: u8) -> Option<(u8, &[u8])> {
    let count = components.count();
    let mut before = usize::from(index).checked_sub(count)?;
    for component in 0..count {
        let text = components.description(component).as_bytes();
        for bytes in text.chunks(DESCRIPTION_PART) {
            if before == 0 {
                return Some((component as u8, bytes));
            }
            before -= 1;
        }
    }
    if C::UPDATES && before == 0 {
        let announced = const { &[C::PARAMETER_COUNT, TAKES_UPDATES] };
        return Some((NO_COMPONENT, announced));
    }
    (C::PARAMETER_COUNT > 0 && before == 0)
        .then_some((NO_COMPONENT, const { &[C::PARAMETER_COUNT] }))
}
