//! A goal in words, for messages: `a number from 0 to 100 mm`.

use core::fmt;

use super::{GoalRule, Storage};

/// No message has more characters, so a higher limit means none.
const LONGEST: usize = 1 << 20;

impl<S: Storage> fmt::Display for GoalRule<S> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Any => f.write_str("anything"),
            Self::Nothing => f.write_str("nothing"),
            Self::Text {
                longest: Some(longest),
            } if *longest <= LONGEST => write!(f, "a text of at most {longest} characters"),
            Self::Text { .. } => f.write_str("a text"),
            Self::Number {
                whole,
                least,
                most,
                unit,
                ..
            } => {
                f.write_str(if *whole { "a whole number" } else { "a number" })?;
                match (least, most) {
                    (Some(least), Some(most)) => write!(f, " from {least} to {most}"),
                    (Some(least), None) => write!(f, " of at least {least}"),
                    (None, Some(most)) => write!(f, " of at most {most}"),
                    (None, None) if unit.is_some() => f.write_str(" in"),
                    (None, None) => Ok(()),
                }?;
                match unit {
                    Some(unit) => write!(f, " {}", unit.as_ref()),
                    None => Ok(()),
                }
            }
            Self::Bool => f.write_str("True or False"),
            Self::OneOf(words) => {
                let words = words.as_ref();
                for (place, word) in words.iter().enumerate() {
                    f.write_str(match place {
                        0 => "",
                        _ if place + 1 == words.len() => " or ",
                        _ => ", ",
                    })?;
                    f.write_str(word.as_ref())?;
                }
                Ok(())
            }
            Self::ListOf(item) => write!(f, "a list, each {}", item.as_ref()),
            Self::Fields(fields) => {
                f.write_str("{")?;
                for (place, field) in fields.as_ref().iter().enumerate() {
                    let separator = if place == 0 { "" } else { ", " };
                    write!(f, "{separator}{}: {}", field.name.as_ref(), field.rule)?;
                }
                f.write_str("}")
            }
        }
    }
}
