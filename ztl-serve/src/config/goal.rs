//! Rules for goals.

use super::super::rule::{Field, Rule};
use super::super::value::Value as GoalValue;
use super::Source;
use ztl_yaml::{Node, NodeValue};

#[derive(Clone, Copy, PartialEq)]
enum Kind {
    Any,
    Text,
    Number,
    Whole,
    Truth,
}

const KINDS: [(&str, Kind); 5] = [
    ("any", Kind::Any),
    ("text", Kind::Text),
    ("number", Kind::Number),
    ("whole", Kind::Whole),
    ("truth", Kind::Truth),
];

impl<'d> Source<'d> {
    /// A rule: a type's name, or a mapping.
    pub(super) fn rule(&mut self, node: &'d Node) -> Option<Rule> {
        if let NodeValue::Scalar { .. } = node.value {
            let kind = self.reading.one_of(node, &KINDS)?;
            return Some(rule(kind));
        }
        let (rule, default) = self.rule_with_default(node)?;
        if default.is_some() {
            let message = "only a field may be left out, so there is no default here";
            self.reading.wrong(node, message);
        }
        Some(rule)
    }

    /// The same of a field, which may say what is taken when it is left out.
    fn field(&mut self, name: &'d Node, node: &'d Node) -> Option<Field> {
        let name = self.reading.text(name, "a field's name")?;
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

    fn rule_with_default(&mut self, node: &'d Node) -> Option<(Rule, Option<GoalValue>)> {
        let mut fields = self
            .reading
            .fields(node, "type: number, or one-of, or fields")?;
        let named = fields.optional("type");
        let kind = named.map(|node| self.reading.one_of(node, &KINDS));
        let least = fields.optional("least");
        let most = fields.optional("most");
        let longest = fields.optional("longest");
        let words = fields.optional("one-of");
        let parts = fields.optional("fields");
        let default = fields.optional("default");
        fields.finish(&mut self.reading);
        let beside = [
            ("type", named),
            ("least", least),
            ("most", most),
            ("longest", longest),
        ];
        let bounds = [least, most].map(|node| node.map(|node| self.bound(node)));
        let longest = longest.map(|node| {
            let what = "a number of characters";
            self.reading.whole::<usize>(node, what)
        });
        let implied = match (&bounds, &longest) {
            ([None, None], Some(_)) => Kind::Text,
            ([None, None], None) => Kind::Any,
            _ => Kind::Number,
        };
        let kind = match kind {
            Some(kind) => kind?,
            None => implied,
        };
        self.idle(kind, words, parts, beside);
        let rule = match (words, parts) {
            (Some(node), _) => {
                let nodes = self.reading.list(node, "words, as [left, right]")?;
                if nodes.is_empty() {
                    self.reading.wrong(node, "there is no word in this list");
                }
                let mut words = Vec::new();
                for node in nodes {
                    words.push(self.reading.text(node, "a word")?.to_owned());
                }
                Rule::OneOf(words)
            }
            (None, Some(node)) => {
                let pairs = self.reading.pairs(node, "fields, as {x: number}")?;
                let mut fields = Vec::new();
                for (name, node) in pairs {
                    fields.extend(self.field(name, node));
                }
                Rule::Fields(fields)
            }
            (None, None) => rule(kind),
        };
        let rule = match rule {
            Rule::Number { whole, .. } => {
                let [least, most] = bounds.map(Option::flatten);
                if let (Some(low), Some(high)) = (least, most)
                    && low > high
                {
                    self.reading.wrong(
                        node,
                        format!("no number is at least {low} and at most {high}"),
                    );
                }
                Rule::Number { whole, least, most }
            }
            Rule::Text { .. } => Rule::Text {
                longest: match longest {
                    Some(longest) => Some(longest?),
                    None => None,
                },
            },
            rule => rule,
        };
        let default = match default {
            Some(node) => {
                let text = self.reading.text(node, "a value")?;
                let value = rule.fit(GoalValue::Text(text.to_owned()));
                if value.is_none() {
                    self.reading.wrong(node, format!("'{text}' is not {rule}"));
                }
                value
            }
            None => None,
        };
        Some((rule, default))
    }

    /// A key that nothing is compared with is a mistake: it would let every goal through.
    fn idle(
        &mut self,
        kind: Kind,
        words: Option<&'d Node>,
        parts: Option<&'d Node>,
        beside: [(&str, Option<&'d Node>); 4],
    ) {
        if let (Some(_), Some(node)) = (words, parts) {
            let message = "one-of and fields cannot both say what is taken";
            self.reading.wrong(node, message);
        }
        let whole = words.map(|_| "one-of").or(parts.map(|_| "fields"));
        for (key, node) in beside {
            let Some(node) = node else { continue };
            if let Some(whole) = whole {
                let message = format!("{whole} says all that is taken; leave out {key}");
                self.reading.wrong(node, message);
                continue;
            }
            let wanted = match key {
                "least" | "most" if !matches!(kind, Kind::Number | Kind::Whole) => "number",
                "longest" if kind != Kind::Text => "text",
                _ => continue,
            };
            let message = format!("{key} is only for a {wanted}; write type: {wanted}");
            self.reading.wrong(node, message);
        }
    }

    fn bound(&mut self, node: &'d Node) -> Option<f64> {
        let finite = |text: &str| text.parse().ok().filter(|number: &f64| number.is_finite());
        self.reading.parsed(node, "a number", |text| {
            finite(text).ok_or_else(|| format!("'{text}' is not a number"))
        })
    }
}

fn rule(kind: Kind) -> Rule {
    match kind {
        Kind::Any => Rule::Any,
        Kind::Text => Rule::Text { longest: None },
        Kind::Number | Kind::Whole => Rule::Number {
            whole: matches!(kind, Kind::Whole),
            least: None,
            most: None,
        },
        Kind::Truth => Rule::Truth,
    }
}
