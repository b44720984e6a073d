//! Reads rules for goals.

use std::sync::Arc;

use ztl_std::describe::{CheckGoal, GoalField, GoalRule, GoalValue};
use ztl_std::server::MAX_MESSAGE;
use ztl_yaml::{Node, NodeValue};

use crate::reader::ConfigReader;

#[derive(Clone, Copy, PartialEq)]
enum GoalType {
    Any,
    Nothing,
    Text,
    Number,
    Integer,
    Bool,
}

const TYPES: [(&str, GoalType); 6] = [
    ("any", GoalType::Any),
    ("nothing", GoalType::Nothing),
    ("text", GoalType::Text),
    ("number", GoalType::Number),
    ("whole", GoalType::Integer),
    ("truth", GoalType::Bool),
];

impl<'d> ConfigReader<'d> {
    /// Reads a rule: a type's name, or a mapping.
    pub(crate) fn rule(&mut self, node: &'d Node) -> Option<GoalRule> {
        if let NodeValue::Scalar { .. } = node.value {
            let kind = self.yaml.one_of(node, &TYPES)?;
            return Some(rule_of(kind));
        }
        let (rule, default) = self.rule_with_default(node)?;
        if default.is_some() {
            let message = "only fields have a default";
            self.yaml.wrong(node, message);
        }
        Some(rule)
    }

    /// Reads the rule of a field, which may have a default.
    fn field(&mut self, name: &'d Node, node: &'d Node) -> Option<GoalField> {
        let name = self.yaml.text(name, "a field's name")?;
        let (rule, default) = match node.value {
            NodeValue::Scalar { .. } => (self.rule(node)?, None),
            _ => self.rule_with_default(node)?,
        };
        Some(GoalField {
            name: name.into(),
            rule,
            optional: default.is_some(),
            default,
        })
    }

    fn rule_with_default(&mut self, node: &'d Node) -> Option<(GoalRule, Option<Arc<str>>)> {
        let mut fields = self
            .yaml
            .fields(node, "type: number, or one-of, or fields")?;
        let named = fields.optional("type");
        let kind = named.map(|node| self.yaml.one_of(node, &TYPES));
        let least = fields.optional("least");
        let most = fields.optional("most");
        let longest = fields.optional("longest");
        let step = fields.optional("step");
        let unit = fields.optional("unit");
        let item = fields.optional("list-of");
        let words = fields.optional("one-of");
        let parts = fields.optional("fields");
        let default = fields.optional("default");
        fields.finish(&mut self.yaml);
        let beside = [
            ("type", named),
            ("least", least),
            ("most", most),
            ("longest", longest),
            ("step", step),
            ("unit", unit),
        ];
        let step_rule = step.map(|node| self.step(node));
        let unit_text = unit.map(|node| self.yaml.text(node, "a unit, as mm"));
        let bounds = [least, most].map(|node| node.map(|node| self.bound(node)));
        let longest = longest.map(|node| {
            let what =
                format!("a number of characters up to {MAX_MESSAGE}, the most that a message has");
            let longest = self.yaml.whole::<usize>(node, &what);
            if let Some(longest) = longest.filter(|longest| *longest > MAX_MESSAGE) {
                let mistake = format!("'{longest}' is not {what}");
                self.yaml.wrong(node, mistake);
            }
            longest
        });
        let implied = match (&bounds, &longest) {
            ([None, None], Some(_)) => GoalType::Text,
            ([None, None], None) if step.or(unit).is_none() => GoalType::Any,
            _ => GoalType::Number,
        };
        let kind = match kind {
            Some(kind) => kind?,
            None => implied,
        };
        let wholes = [("one-of", words), ("fields", parts), ("list-of", item)];
        self.without_effect(kind, wholes, beside);
        let rule = match (words, parts, item) {
            (Some(node), _, _) => {
                let nodes = self.yaml.list(node, "words, as [left, right]")?;
                if nodes.is_empty() {
                    self.yaml.wrong(node, "there is no word in this list");
                }
                let mut words = Vec::new();
                for node in nodes {
                    words.push(Arc::from(self.yaml.text(node, "a word")?));
                }
                GoalRule::OneOf(words.into())
            }
            (None, Some(node), _) => {
                let pairs = self.yaml.pairs(node, "fields, as {x: number}")?;
                let mut fields = Vec::new();
                for (name, node) in pairs {
                    fields.extend(self.field(name, node));
                }
                GoalRule::Fields(fields.into())
            }
            (None, None, Some(node)) => GoalRule::ListOf(Arc::new(self.rule(node)?)),
            (None, None, None) => rule_of(kind),
        };
        let rule = match rule {
            GoalRule::Number { whole, .. } => {
                let [least, most] = bounds.map(Option::flatten);
                if let (Some(low), Some(high)) = (least, most)
                    && low > high
                {
                    self.yaml
                        .wrong(node, format!("least {low} is greater than most {high}"));
                }
                GoalRule::Number {
                    whole,
                    least,
                    most,
                    step: step_rule.flatten(),
                    unit: unit_text.flatten().map(Arc::from),
                }
            }
            GoalRule::Text { .. } => GoalRule::Text {
                longest: match longest {
                    Some(longest) => Some(longest?),
                    None => None,
                },
            },
            rule => rule,
        };
        let default = match default {
            Some(node) => {
                let text = self.yaml.text(node, "a value")?;
                let value = rule.fit(GoalValue::Text(text.to_owned()));
                if value.is_none() {
                    self.yaml.wrong(node, format!("'{text}' is not {rule}"));
                }
                value.map(|_| Arc::from(text))
            }
            None => None,
        };
        Some((rule, default))
    }

    /// Rejects keys without effect, which would let every goal through.
    fn without_effect(
        &mut self,
        kind: GoalType,
        wholes: [(&str, Option<&'d Node>); 3],
        beside: [(&str, Option<&'d Node>); 6],
    ) {
        let mut given = wholes
            .into_iter()
            .filter_map(|(key, node)| Some((key, node?)));
        let whole = given.next().map(|(key, _)| key);
        if let (Some(first), Some((second, node))) = (whole, given.next()) {
            let message = format!("give only one of {first} and {second}");
            self.yaml.wrong(node, message);
        }
        for (key, node) in beside {
            let Some(node) = node else { continue };
            if let Some(whole) = whole {
                let message = format!("{key} has no effect beside {whole}; remove it");
                self.yaml.wrong(node, message);
                continue;
            }
            let wanted = match key {
                "least" | "most" | "step" | "unit"
                    if !matches!(kind, GoalType::Number | GoalType::Integer) =>
                {
                    "number"
                }
                "longest" if kind != GoalType::Text => "text",
                _ => continue,
            };
            let message = format!("{key} has an effect only with type: {wanted}");
            self.yaml.wrong(node, message);
        }
    }

    fn step(&mut self, node: &'d Node) -> Option<f64> {
        let step = self.bound(node)?;
        if step <= 0.0 {
            self.yaml.wrong(node, "a step must be greater than zero");
        }
        Some(step)
    }

    fn bound(&mut self, node: &'d Node) -> Option<f64> {
        let finite = |text: &str| text.parse().ok().filter(|number: &f64| number.is_finite());
        self.yaml.parsed(node, "a number", |text| {
            finite(text).ok_or_else(|| format!("'{text}' is not a number"))
        })
    }
}

fn rule_of(kind: GoalType) -> GoalRule {
    match kind {
        GoalType::Any => GoalRule::Any,
        GoalType::Nothing => GoalRule::Nothing,
        GoalType::Text => GoalRule::Text { longest: None },
        GoalType::Number | GoalType::Integer => GoalRule::Number {
            whole: matches!(kind, GoalType::Integer),
            least: None,
            most: None,
            step: None,
            unit: None,
        },
        GoalType::Bool => GoalRule::Bool,
    }
}
