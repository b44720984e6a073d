//! Robots with an HTTP interface, such as Misty: a request is the task, or begins it.
//!
//! | file | what |
//! |---|---|
//! | `hosts` | `http` at the top of the file: names for hosts |
//! | `request` | a request of the file, and what it is for a goal |
//! | `exchange` | one request and its answer, bounded |
//! | `condition` | what an answer means |
//! | `task` | `http`: the kind, and the thread of a task |

#[cfg(feature = "http")]
mod condition;
#[cfg(feature = "http")]
mod exchange;
pub(crate) mod hosts;
#[cfg(feature = "http")]
mod request;
#[cfg(feature = "http")]
pub(crate) mod task;

/// What reads the kind where it is left out.
#[cfg(not(feature = "http"))]
pub(crate) mod task {
    use std::sync::Arc;

    use ztl_yaml::{Fields, Node};

    use crate::kind::Kind;
    use crate::reader::{ComponentContext, ConfigReader};

    /// Says that it is left out.
    pub(crate) fn read<'d>(
        reader: &mut ConfigReader<'d>,
        node: &'d Node,
        _: Option<&mut Fields<'d>>,
        _: ComponentContext<'_>,
    ) -> Option<Arc<dyn Kind>> {
        let message = "this ztl has no http, as those for old robots; take one built with the feature http, beside the robot";
        reader.yaml.wrong(node, message);
        None
    }
}
