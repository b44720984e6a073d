//! A goal as JSON Schema (2020-12).

use core::fmt::{self, Display, Formatter};

use super::json::{Quoted, Texts, bound, list};
use super::{GoalRule, Storage};

struct Schema<'a, S: Storage>(&'a GoalRule<S>);

impl<S: Storage> GoalRule<S> {
    /// The goal as JSON Schema, for the goal as a JSON value. Steps are not rules, so it leaves them out.
    pub fn schema(&self) -> impl Display + '_ {
        Schema(self)
    }
}

impl<S: Storage> Display for Schema<'_, S> {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        match self.0 {
            GoalRule::Any => f.write_str("{}"),
            // An empty goal is the empty text.
            GoalRule::Nothing => f.write_str("{\"enum\": [null, \"\"]}"),
            GoalRule::Text { longest } => {
                f.write_str("{\"type\": \"string\"")?;
                if let Some(longest) = longest {
                    write!(f, ", \"maxLength\": {longest}")?;
                }
                f.write_str("}")
            }
            GoalRule::Number {
                whole,
                least,
                most,
                unit,
                ..
            } => {
                let kind = if *whole { "integer" } else { "number" };
                write!(f, "{{\"type\": \"{kind}\"")?;
                bound(f, "minimum", *least)?;
                bound(f, "maximum", *most)?;
                if let Some(unit) = unit {
                    write!(f, ", \"description\": {}", Quoted(unit.as_ref()))?;
                }
                f.write_str("}")
            }
            GoalRule::Bool => f.write_str("{\"type\": \"boolean\"}"),
            GoalRule::OneOf(words) => write!(f, "{{\"enum\": {}}}", Texts(words.as_ref())),
            GoalRule::ListOf(item) => {
                let item = Schema(item.as_ref());
                write!(f, "{{\"type\": \"array\", \"items\": {item}}}")
            }
            GoalRule::Fields(fields) => {
                let fields = fields.as_ref();
                f.write_str("{\"anyOf\": [{\"type\": \"object\", \"properties\": {")?;
                list(f, fields, |f, field| {
                    let (name, rule) = (Quoted(field.name.as_ref()), Schema(&field.rule));
                    write!(f, "{name}: {rule}")
                })?;
                f.write_str("}, \"required\": [")?;
                let mut separator = "";
                for field in fields.iter().filter(|field| !field.optional) {
                    write!(f, "{separator}{}", Quoted(field.name.as_ref()))?;
                    separator = ", ";
                }
                f.write_str("], \"additionalProperties\": false}, {\"type\": \"array\"")?;
                // JSON Schema allows no empty list there.
                if !fields.is_empty() {
                    f.write_str(", \"prefixItems\": [")?;
                    list(f, fields, |f, field| write!(f, "{}", Schema(&field.rule)))?;
                    f.write_str("]")?;
                }
                let many = fields.len();
                write!(f, ", \"minItems\": {many}, \"maxItems\": {many}}}]}}")
            }
        }
    }
}
