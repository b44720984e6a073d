//! Reads rules for goals.

use ztl_yaml::{Node, NodeValue};

use crate::goal_rule::{Field, GoalRule};
use crate::goal_value::GoalValue;
use crate::reader::ConfigReader;

#[derive(Clone, Copy, PartialEq)]
enum GoalType {
    Any,
    Text,
    Number,
    Integer,
    Bool,
}

const TYPES: [(&str, GoalType); 5] = [
    ("any", GoalType::Any),
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
    fn field(&mut self, name: &'d Node, node: &'d Node) -> Option<Field> {
        let name = self.yaml.text(name, "a field's name")?;
        let (rule, default) = match node.value {
            NodeValue::Scalar { .. } => (self.rule(node)?, None),
            _ => self.rule_with_default(node)?,
        };
        Some(Field {
            name: name.to_owned(),
            rule,
            default,
        })
    }

    fn rule_with_default(&mut self, node: &'d Node) -> Option<(GoalRule, Option<GoalValue>)> {
        let mut fields = self
            .yaml
            .fields(node, "type: number, or one-of, or fields")?;
        let named = fields.optional("type");
        let kind = named.map(|node| self.yaml.one_of(node, &TYPES));
        let least = fields.optional("least");
        let most = fields.optional("most");
        let longest = fields.optional("longest");
        let words = fields.optional("one-of");
        let parts = fields.optional("fields");
        let default = fields.optional("default");
        fields.finish(&mut self.yaml);
        let beside = [
            ("type", named),
            ("least", least),
            ("most", most),
            ("longest", longest),
        ];
        let bounds = [least, most].map(|node| node.map(|node| self.bound(node)));
        let longest = longest.map(|node| {
            let what = "a number of characters";
            self.yaml.whole::<usize>(node, what)
        });
        let implied = match (&bounds, &longest) {
            ([None, None], Some(_)) => GoalType::Text,
            ([None, None], None) => GoalType::Any,
            _ => GoalType::Number,
        };
        let kind = match kind {
            Some(kind) => kind?,
            None => implied,
        };
        self.without_effect(kind, words, parts, beside);
        let rule = match (words, parts) {
            (Some(node), _) => {
                let nodes = self.yaml.list(node, "words, as [left, right]")?;
                if nodes.is_empty() {
                    self.yaml.wrong(node, "there is no word in this list");
                }
                let mut words = Vec::new();
                for node in nodes {
                    words.push(self.yaml.text(node, "a word")?.to_owned());
                }
                GoalRule::OneOf(words)
            }
            (None, Some(node)) => {
                let pairs = self.yaml.pairs(node, "fields, as {x: number}")?;
                let mut fields = Vec::new();
                for (name, node) in pairs {
                    fields.extend(self.field(name, node));
                }
                GoalRule::Fields(fields)
            }
            (None, None) => rule_of(kind),
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
                GoalRule::Number { whole, least, most }
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
                value
            }
            None => None,
        };
        Some((rule, default))
    }

    /// Rejects keys without effect, which would let every goal through.
    fn without_effect(
        &mut self,
        kind: GoalType,
        words: Option<&'d Node>,
        parts: Option<&'d Node>,
        beside: [(&str, Option<&'d Node>); 4],
    ) {
        if let (Some(_), Some(node)) = (words, parts) {
            let message = "give only one of one-of and fields";
            self.yaml.wrong(node, message);
        }
        let whole = words.map(|_| "one-of").or(parts.map(|_| "fields"));
        for (key, node) in beside {
            let Some(node) = node else { continue };
            if let Some(whole) = whole {
                let message = format!("{key} has no effect beside {whole}; remove it");
                self.yaml.wrong(node, message);
                continue;
            }
            let wanted = match key {
                "least" | "most" if !matches!(kind, GoalType::Number | GoalType::Integer) => {
                    "number"
                }
                "longest" if kind != GoalType::Text => "text",
                _ => continue,
            };
            let message = format!("{key} has an effect only with type: {wanted}");
            self.yaml.wrong(node, message);
        }
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
        GoalType::Text => GoalRule::Text { longest: None },
        GoalType::Number | GoalType::Integer => GoalRule::Number {
            whole: matches!(kind, GoalType::Integer),
            least: None,
            most: None,
        },
        GoalType::Bool => GoalRule::Bool,
    }
}
