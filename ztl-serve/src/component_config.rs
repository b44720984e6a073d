//! What a file says of a component, and the limit on tasks of all components together.

use std::any::Any;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use ztl_std::describe::ComponentDescription;

use crate::admission::BusyPolicy;
use crate::forward::Forward;
use crate::kind::Kind;

/// A component: what does its tasks, and under which rules.
#[derive(Debug)]
pub(crate) struct ComponentConfig {
    pub(crate) kind: Arc<dyn Kind>,
    /// What it says of itself; its goal is the rule for tasks.
    pub(crate) description: ComponentDescription,
    pub(crate) at_once: usize,
    pub(crate) busy: BusyPolicy,
    /// Aborts a task when its client has been silent for this long.
    pub(crate) needs_client: Option<Duration>,
}

impl ComponentConfig {
    /// Where its tasks are sent, if to another server.
    pub(crate) fn forward(&self) -> Option<&Forward> {
        let kind: &dyn Any = &*self.kind;
        kind.downcast_ref()
    }
}

/// Limits how many tasks run or wait in all scopes together.
#[derive(Debug, Clone)]
pub(crate) struct TotalLimit {
    count: Arc<AtomicUsize>,
    most: usize,
}

impl TotalLimit {
    pub(crate) fn new(most: usize) -> Self {
        Self {
            count: Arc::default(),
            most,
        }
    }

    /// Counts one more task.
    ///
    /// # Errors
    /// The limit, if it is reached.
    pub(crate) fn add(&self) -> Result<(), usize> {
        let one_more = |count| (count < self.most).then_some(count + 1);
        let order = Ordering::Relaxed;
        let counted = self.count.fetch_update(order, order, one_more);
        counted.map(drop).map_err(|_| self.most)
    }

    pub(crate) fn remove(&self) {
        self.count.fetch_sub(1, Ordering::Relaxed);
    }
}
