//! Explains to the author of a goal which goals a component accepts.

use super::number;
use crate::component::Report;

/// Begins the reason of a refusal with `NAME takes `; what the component takes follows.
pub(super) fn begin_expected(why: &mut Report<'_>, name: &str) {
    why.text(name);
    why.text(" takes ");
}

/// Writes the range of valid numbers.
pub(super) fn put_range(why: &mut Report<'_>, least: i32, most: i32, unit: &str) {
    number::report(why, least, 0);
    why.text(" to ");
    number::report(why, most, 0);
    why.text(" ");
    why.text(unit);
}
