//! Readings and the log: what has the lowest priority.

use super::*;
