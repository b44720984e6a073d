//! The components of a scope, as the configuration file names them.

use std::collections::BTreeMap;
use std::sync::Arc;

use ztl_core::{TaskId, TaskSpec};
use ztl_std::describe::{CheckGoal as _, shown};
use ztl_std::server::offered;

use crate::call::Call;
use crate::component_config::ComponentConfig;

/// Stands for each handler or component that the file does not name.
pub(crate) const WILDCARD: &str = "*";

/// A task id for checks without a task.
const NO_TASK: TaskId = match TaskId::new(1) {
    Some(id) => id,
    None => unreachable!(),
};

/// The components of a scope.
#[derive(Debug, Default)]
pub(crate) struct Components {
    all: Vec<Arc<ComponentConfig>>,
    /// Indices in `all` by handler and component.
    by_name: BTreeMap<String, BTreeMap<String, usize>>,
}

impl Components {
    pub(crate) fn new<'e>(
        configs: impl Iterator<Item = (&'e str, &'e str, &'e Arc<ComponentConfig>)>,
    ) -> Self {
        let mut components = Self::default();
        for (handler, name, component) in configs {
            let names = components.by_name.entry(handler.to_owned()).or_default();
            names.insert(name.to_owned(), components.all.len());
            components.all.push(Arc::clone(component));
        }
        components
    }

    /// All components; [`find`](Self::find) returns an index here.
    pub(crate) fn all(&self) -> &[Arc<ComponentConfig>] {
        &self.all
    }

    /// What the scope offers, as a mapping in YAML flow style.
    pub(crate) fn offered(&self) -> String {
        let handlers = self.by_name.iter();
        offered(
            handlers.map(|(handler, components)| {
                (handler.as_str(), components.keys().map(String::as_str))
            }),
        )
    }

    /// All components, with handler and name.
    pub(crate) fn iter(&self) -> impl Iterator<Item = (&str, &str, &ComponentConfig)> {
        self.by_name.iter().flat_map(|(handler, components)| {
            components.iter().filter_map(|(name, index)| {
                let config = self.all.get(*index)?;
                Some((handler.as_str(), name.as_str(), &**config))
            })
        })
    }

    /// Whether the file names this handler.
    pub(crate) fn has_handler(&self, handler: &str) -> bool {
        self.by_name.contains_key(handler)
    }

    /// Whether the file names this component of a handler that it names.
    pub(crate) fn has(&self, handler: &str, component: &str) -> bool {
        let components = self.by_name.get(handler);
        components.is_some_and(|components| components.contains_key(component))
    }

    /// The index of the component for a task, or why there is none.
    pub(crate) fn find(&self, spec: &TaskSpec<'_>) -> Result<usize, String> {
        let (handler, component) = (spec.handler, spec.component);
        let named = |names: Vec<&String>| {
            let names: Vec<&str> = names.into_iter().map(String::as_str).collect();
            names.join(", ")
        };
        let handlers = &self.by_name;
        let components = handlers.get(handler).or_else(|| handlers.get(WILDCARD));
        let components = components.ok_or_else(|| {
            let handler = shown(handler);
            let there = named(handlers.keys().collect());
            format!("no handler '{handler}'; there are: {there}")
        })?;
        let index = components
            .get(component)
            .or_else(|| components.get(WILDCARD));
        index.copied().ok_or_else(|| {
            let (handler, component) = (shown(handler), shown(component));
            let there = named(components.keys().collect());
            format!("no component '{component}' on '{handler}'; it has: {there}")
        })
    }

    /// Returns, without starting anything, whether a task would be rejected.
    pub(crate) fn check(&self, scope: &str, spec: &TaskSpec<'_>) -> Result<(), String> {
        let Some(component) = self.all.get(self.find(spec)?) else {
            return Ok(());
        };
        let goal = component
            .description
            .goal
            .check(spec.goal, component.kind.needs_fields())?;
        component.kind.check(&Call {
            id: NO_TASK,
            scope: scope.to_owned(),
            handler: spec.handler.to_owned(),
            component: spec.component.to_owned(),
            goal,
            answer: None,
        })
    }
}
