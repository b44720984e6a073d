//! The table of all kinds of handlers.

use std::sync::Arc;

use ztl_yaml::{Fields, Node};

use crate::kind::Kind;
use crate::reader::{ComponentContext, ConfigReader};
use crate::{built_in, forward, http, naoqi, program, ros1};

/// Reads a kind's settings: the value of its key, and more keys of the same mapping. In a short form there is no
/// mapping.
pub(crate) type ReadKind = for<'d> fn(
    &mut ConfigReader<'d>,
    &'d Node,
    Option<&mut Fields<'d>>,
    ComponentContext<'_>,
) -> Option<Arc<dyn Kind>>;

/// Each kind by its key in the file.
pub(crate) const KINDS: [(&str, ReadKind); 12] = [
    ("run", program::read::read),
    ("shell", program::read::read_shell),
    ("built-in", built_in::read),
    ("forward", forward::read),
    ("ros1-action", ros1::action::read),
    ("ros1-trajectory", ros1::trajectory::read),
    ("ros1-publish", ros1::publish::read),
    ("ros1-service", ros1::service::read),
    ("ros1-parameter", ros1::parameter::read),
    ("naoqi", naoqi::call::read),
    ("naoqi-wait", naoqi::wait::read),
    ("http", http::task::read),
];

/// A component that is a list: `run`.
pub(crate) const LIST: ReadKind = program::read::read;

/// A component that is a single word: `built-in`.
pub(crate) const WORD: ReadKind = built_in::read;
