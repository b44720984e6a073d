//! What components say of themselves, on a host: the model of [`ztl_core::describe`] with a heap, its reader,
//! and the check of goals against it.

mod goal_check;
mod goal_value;
mod read;
#[cfg(feature = "schemars")]
mod schema;

use std::collections::BTreeMap;
use std::sync::Arc;

use ztl_core::describe::Storage;

pub use goal_check::{CheckGoal, CheckedGoal, shown};
pub use goal_value::GoalValue;
pub use read::{MAX_DEPTH, MAX_LENGTH, component, parse};
#[cfg(feature = "schemars")]
pub use schema::{SchemaError, of_schema, of_type};

/// Stores descriptions on the heap.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Owned;

impl Storage for Owned {
    type Text = Arc<str>;
    type List<T: 'static> = Arc<[T]>;
    type Part<T: 'static> = Arc<T>;
}

/// What a component says of itself.
pub type ComponentDescription = ztl_core::describe::ComponentDescription<Owned>;
/// What a goal must be.
pub type GoalRule = ztl_core::describe::GoalRule<Owned>;
/// A field of a structured goal.
pub type GoalField = ztl_core::describe::Field<Owned>;

/// What the components of a scope say of themselves, by handler and component. The name `*` stands for every
/// other name.
pub type ScopeDescriptions = BTreeMap<String, BTreeMap<String, ComponentDescription>>;

/// What describes the components of a scope at this moment. It is called on the server's thread, so it must be quick.
pub type Descriptions = Box<dyn Fn() -> Arc<ScopeDescriptions> + Send>;

/// What a component of a scope says of itself, if anything.
#[must_use]
pub fn find<'a>(
    scope: &'a ScopeDescriptions,
    handler: &str,
    component: &str,
) -> Option<&'a ComponentDescription> {
    let components = scope.get(handler).or_else(|| scope.get("*"))?;
    components.get(component).or_else(|| components.get("*"))
}

/// Longest part of the answer to `describe`, in bytes, unless a single component is longer.
pub(crate) const PART: usize = 64 << 10;

/// A component that says no more than its goal.
#[must_use]
pub fn described(goal: GoalRule) -> ComponentDescription {
    ComponentDescription {
        goal,
        about: None,
        examples: Arc::default(),
        result: None,
        streams: Arc::default(),
        can_abort: true,
        usually_ms: None,
    }
}
