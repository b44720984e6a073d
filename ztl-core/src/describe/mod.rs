//! What a component says of itself: which goals it takes, what they mean, and what comes of them.
//!
//! The same model is a `const` in firmware ([`Const`]) and grows on a host, which chooses another [`Storage`].
//! [`ComponentDescription::json`] writes it in one line, as JSON, which is also YAML in flow style; [`GoalRule::schema`]
//! writes the goal as JSON Schema. `docs/protocol.md` [11.7] describes the keys. For firmware,
//! [`description!`](crate::description) lets the compiler write the JSON, and [`goal_fields!`](crate::goal_fields)
//! describes a struct.
//!
//! ```
//! use ztl_core::describe::{ComponentDescription, GoalRule};
//!
//! const GRIPPER: ComponentDescription = ComponentDescription {
//!     about: Some("opens the gripper"),
//!     examples: &["40"],
//!     ..ComponentDescription::new(GoalRule::range(0.0, 80.0, "mm"))
//! };
//! assert_eq!(GRIPPER.goal.to_string(), "a number from 0 to 80 mm");
//! assert_eq!(
//!     GRIPPER.json().to_string(),
//!     r#"{"goal": {"type": "number", "least": 0, "most": 80, "unit": "mm"}, "about": "opens the gripper", "examples": ["40"]}"#
//! );
//! assert_eq!(
//!     GRIPPER.goal.schema().to_string(),
//!     r#"{"type": "number", "minimum": 0, "maximum": 80, "description": "mm"}"#
//! );
//! ```

mod display;
mod json;
mod schema;
mod text;
mod typed;

use core::fmt;

pub use text::{text, text_len};
pub use typed::{GoalType, field};

/// How a description stores its texts and lists.
pub trait Storage: Clone + 'static {
    /// A text.
    type Text: AsRef<str> + Clone;
    /// Items in order.
    type List<T: 'static>: AsRef<[T]> + Clone;
    /// One value elsewhere, so that a goal can contain goals.
    type Part<T: 'static>: AsRef<T> + Clone;
}

/// Stores everything in the program's constants.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Const;

impl Storage for Const {
    type Text = &'static str;
    type List<T: 'static> = &'static [T];
    type Part<T: 'static> = ConstPart<T>;
}

/// A constant elsewhere: `ConstPart(&GoalRule::Bool)`.
#[derive(Debug)]
pub struct ConstPart<T: 'static>(pub &'static T);

impl<T> Clone for ConstPart<T> {
    fn clone(&self) -> Self {
        Self(self.0)
    }
}

impl<T> AsRef<T> for ConstPart<T> {
    fn as_ref(&self) -> &T {
        self.0
    }
}

/// What a component says of itself.
#[derive(Clone)]
pub struct ComponentDescription<S: Storage = Const> {
    /// What goals must be.
    pub goal: GoalRule<S>,
    /// What it does, in one line.
    pub about: Option<S::Text>,
    /// Goals that it takes.
    pub examples: S::List<S::Text>,
    /// What the result of a completed task is, in one line.
    pub result: Option<S::Text>,
    /// Topics of the streams that it publishes.
    pub streams: S::List<S::Text>,
    /// Whether clients can abort its tasks.
    pub can_abort: bool,
    /// How long a task usually takes, in milliseconds.
    pub usually_ms: Option<u32>,
}

impl ComponentDescription {
    /// A component that says no more than its goal.
    #[must_use]
    pub const fn new(goal: GoalRule) -> Self {
        Self {
            goal,
            about: None,
            examples: &[],
            result: None,
            streams: &[],
            can_abort: true,
            usually_ms: None,
        }
    }
}

/// What a goal must be.
#[derive(Clone, Default)]
pub enum GoalRule<S: Storage = Const> {
    /// Any goal.
    #[default]
    Any,
    /// Nothing: an empty goal.
    Nothing,
    /// A text, with at most this many characters.
    Text {
        /// Most characters.
        longest: Option<usize>,
    },
    /// A finite number within bounds.
    Number {
        /// Only integers.
        whole: bool,
        /// The least.
        least: Option<f64>,
        /// The greatest.
        most: Option<f64>,
        /// A useful difference between two goals, as of a slider. Goals between steps are allowed.
        step: Option<f64>,
        /// The unit, such as `mm`.
        unit: Option<S::Text>,
    },
    /// True or False.
    Bool,
    /// One of these words.
    OneOf(S::List<S::Text>),
    /// Any number of these.
    ListOf(S::Part<GoalRule<S>>),
    /// These fields and no others: a mapping, or a list of all in their order.
    Fields(S::List<Field<S>>),
}

/// A field of a structured goal.
#[derive(Clone)]
pub struct Field<S: Storage = Const> {
    /// Its name.
    pub name: S::Text,
    /// What its value must be.
    pub rule: GoalRule<S>,
    /// Whether a client may leave it out.
    pub optional: bool,
    /// What is used when it is left out.
    pub default: Option<S::Text>,
}

impl GoalRule {
    /// Any finite number. For the component of a device: any within the range of its offer, in its unit.
    pub const NUMBER: Self = Self::Number {
        whole: false,
        least: None,
        most: None,
        step: None,
        unit: None,
    };

    /// A number within these bounds.
    #[must_use]
    pub const fn range(least: f64, most: f64, unit: &'static str) -> Self {
        Self::Number {
            whole: false,
            least: Some(least),
            most: Some(most),
            step: None,
            unit: Some(unit),
        }
    }

    /// One of these words.
    #[must_use]
    pub const fn words(words: &'static [&'static str]) -> Self {
        Self::OneOf(words)
    }

    /// Any number of these.
    #[must_use]
    pub const fn list(item: &'static Self) -> Self {
        Self::ListOf(ConstPart(item))
    }

    /// These fields and no others.
    #[must_use]
    pub const fn fields(fields: &'static [Field]) -> Self {
        Self::Fields(fields)
    }
}

impl<S: Storage> GoalRule<S> {
    /// Whether the goals are numbers or words of the description, so that no client can choose a text.
    pub const fn is_closed(&self) -> bool {
        matches!(
            self,
            Self::Nothing | Self::Number { .. } | Self::Bool | Self::OneOf(_)
        )
    }

    /// The rule for a part of the goal; `None` if no goal has that part.
    pub fn part<T: AsRef<str>>(&self, path: &[T]) -> Option<&Self> {
        let Some((first, rest)) = path.split_first() else {
            return Some(self);
        };
        match self {
            // Every part of anything is anything.
            Self::Any => Some(self),
            Self::Fields(fields) => {
                let mut fields = fields.as_ref().iter();
                let field = fields.find(|field| field.name.as_ref() == first.as_ref())?;
                field.rule.part(rest)
            }
            _ => None,
        }
    }
}

impl<S: Storage> fmt::Debug for ComponentDescription<S> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.json())
    }
}

impl<S: Storage> fmt::Debug for GoalRule<S> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{self}")
    }
}

impl<S: Storage> fmt::Debug for Field<S> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {}", self.name.as_ref(), self.rule)
    }
}
