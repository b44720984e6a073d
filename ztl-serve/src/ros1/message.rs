//! Messages with placeholders: a mapping in the file, whose fields are those of the message's type.

use std::sync::Arc;
use std::time::{SystemTime, UNIX_EPOCH};

use ztl_ros1::message::{Count, Element, FieldType, MessageType, Primitive, Value};
use ztl_std::describe::{GoalField, GoalRule, GoalValue, shown};
use ztl_yaml::{Node, NodeValue, closest};

use super::fit::{fit, from_text, list, may_fit, rule_of};
use crate::call::Call;
use crate::program::template::Template;
use crate::reader::ConfigReader;

/// A message with placeholders.
#[derive(Debug, Clone)]
pub(crate) struct MessageTemplate {
    message: Arc<MessageType>,
    root: Part,
}

#[derive(Debug, Clone)]
enum Part {
    Fixed(Value),
    /// The goal, or the part of it at this path.
    Goal {
        path: Vec<String>,
        field: FieldType,
        /// A part of it that is not meant for the message.
        except: Option<String>,
    },
    /// A text with placeholders.
    Text(Template),
    /// The time when the task begins.
    Now,
    List(FieldType, Vec<Part>),
    Message(Vec<(Arc<str>, Part)>),
}

impl MessageTemplate {
    /// The goal as the message, except a part of it; nothing of it, if the message has no fields.
    fn of_goal(message: &Arc<MessageType>, except: Option<&str>) -> Self {
        let root = match message.fields() {
            [] => Part::Fixed(message.zero()),
            _ => Part::Goal {
                path: Vec::new(),
                field: one(message),
                except: except.map(str::to_owned),
            },
        };
        Self {
            message: Arc::clone(message),
            root,
        }
    }

    /// The bytes of the message for a task, or why its goal does not fit.
    pub(crate) fn fill(&self, call: &Call) -> Result<Vec<u8>, String> {
        let value = self.root.fill(call)?;
        let bytes = self.message.encode(&value);
        bytes.map_err(|error| error.to_string())
    }

    /// Whether it needs the goal as a value, not only as its text.
    pub(crate) fn needs_fields(&self) -> bool {
        let mut found = false;
        self.root
            .each_goal(&mut |path, _| found |= !path.is_empty());
        found
    }

    /// Each part of the goal that it uses, with the rule for it.
    pub(crate) fn goals(&self) -> Vec<(Vec<String>, GoalRule)> {
        let mut goals = Vec::new();
        self.root.each_goal(&mut |path, field| {
            let text = GoalRule::Text { longest: None };
            goals.push((path.to_vec(), field.map_or(text, rule_of)));
        });
        goals
    }
}

/// The rule for goals, from the parts that placeholders use.
pub(crate) fn rule_of_goals(goals: &[(Vec<String>, GoalRule)]) -> GoalRule {
    let mut fields: Vec<GoalField> = Vec::new();
    for (path, rule) in goals {
        match path.as_slice() {
            [] if goals.len() == 1 => return rule.clone(),
            [] => match rule {
                GoalRule::Fields(all) => fields.extend(all.iter().cloned()),
                _ => return GoalRule::Any,
            },
            [name] => {
                if fields.iter().all(|field| *field.name != **name) {
                    fields.push(GoalField {
                        name: name.as_str().into(),
                        rule: rule.clone(),
                        optional: false,
                        default: None,
                    });
                }
            }
            _ => return GoalRule::Any,
        }
    }
    match fields.is_empty() {
        true => GoalRule::Nothing,
        false => GoalRule::Fields(fields.into()),
    }
}

/// The value of a whole goal or of a part of it.
pub(super) fn goal_part(
    call: &Call,
    path: &[String],
    except: Option<&str>,
    field: &FieldType,
) -> Result<Value, String> {
    if let ([], Count::One, Element::Primitive(primitive)) = (path, field.count, &field.element)
        && let Some(value) = from_text(*primitive, &call.goal.text)
    {
        return Ok(value);
    }
    let parsed = match &call.goal.fields {
        Some(fields) => Ok(fields.clone()),
        None => GoalValue::parse(&call.goal.text),
    };
    let wrong = |error| {
        let text = shown(&call.goal.text);
        format!("the goal '{text}' is not {field}: {error}")
    };
    let goal = parsed.map_err(wrong)?;
    let at = ["goal"].into_iter().chain(path.iter().map(String::as_str));
    let at = at.collect::<Vec<_>>().join(".");
    let value = path.iter().try_fold(&goal, |value, key| value.part(key));
    match value {
        Some(GoalValue::Map(pairs)) if except.is_some() => {
            let is_apart = |key: &GoalValue| matches!(key, GoalValue::Text(text) if Some(text.as_str()) == except);
            let meant = pairs.iter().filter(|(key, _)| !is_apart(key));
            let meant = meant.cloned().collect();
            fit(&GoalValue::Map(meant), field, &at)
        }
        Some(value) => fit(value, field, &at),
        None => Err(format!(
            "the task needs {at}, and the goal has no such part"
        )),
    }
}

impl Part {
    fn fill(&self, call: &Call) -> Result<Value, String> {
        Ok(match self {
            Self::Fixed(value) => value.clone(),
            Self::Goal {
                path,
                field,
                except,
            } => goal_part(call, path, except.as_deref(), field)?,
            Self::Text(template) => Value::Text(template.fill(call)?),
            Self::Now => now(),
            Self::List(field, parts) => {
                let items = parts.iter().map(|part| part.fill(call));
                list(field, items.collect::<Result<_, _>>()?)
            }
            Self::Message(parts) => {
                let fields = parts
                    .iter()
                    .map(|(name, part)| Ok((Arc::clone(name), part.fill(call)?)));
                Value::Message(fields.collect::<Result<_, String>>()?)
            }
        })
    }

    /// Calls this for each part of the goal, with the type that it must fit; `None` for a part of a text.
    fn each_goal<'p>(&'p self, call: &mut impl FnMut(&'p [String], Option<&'p FieldType>)) {
        match self {
            Self::Fixed(_) | Self::Now => {}
            Self::Goal { path, field, .. } => call(path, Some(field)),
            Self::Text(template) => template.goal_paths().for_each(|path| call(path, None)),
            Self::List(_, parts) => parts.iter().for_each(|part| part.each_goal(call)),
            Self::Message(parts) => parts.iter().for_each(|(_, part)| part.each_goal(call)),
        }
    }

    fn fixed(self) -> Result<Value, Self> {
        match self {
            Self::Fixed(value) => Ok(value),
            part => Err(part),
        }
    }
}

/// The wall clock as a time of ROS; zero, which means "now" to most of ROS, if it is before 1970.
fn now() -> Value {
    let now = SystemTime::now()
        .duration_since(UNIX_EPOCH)
        .unwrap_or_default();
    Value::Time {
        secs: u32::try_from(now.as_secs()).unwrap_or_default(),
        nsecs: now.subsec_nanos(),
    }
}

/// The type of a single message.
fn one(message: &Arc<MessageType>) -> FieldType {
    FieldType {
        element: Element::Message(Arc::clone(message)),
        count: Count::One,
    }
}

impl<'d> ConfigReader<'d> {
    /// The message in `node`, or else the goal as the message, `except` a part of it.
    pub(crate) fn message_or_goal(
        &mut self,
        node: Option<&'d Node>,
        message: &Arc<MessageType>,
        rule: &GoalRule,
        except: Option<&str>,
    ) -> MessageTemplate {
        match node {
            Some(node) => self.message_template(node, message, rule),
            None => MessageTemplate::of_goal(message, except),
        }
    }

    /// Reads a message of this type for goals of this rule. After a mistake the message is not used.
    pub(crate) fn message_template(
        &mut self,
        node: &'d Node,
        message: &Arc<MessageType>,
        rule: &GoalRule,
    ) -> MessageTemplate {
        let mut reader = MessageReader { reader: self, rule };
        MessageTemplate {
            root: reader.message(node, message),
            message: Arc::clone(message),
        }
    }
}

struct MessageReader<'r, 'd, 'c> {
    reader: &'r mut ConfigReader<'d>,
    rule: &'c GoalRule,
}

impl<'d> MessageReader<'_, 'd, '_> {
    fn message(&mut self, node: &'d Node, message: &Arc<MessageType>) -> Part {
        if let Some(part) = self.placeholder(node, &one(message)) {
            return part;
        }
        let names = message.fields().iter().map(|field| &*field.name);
        let names = names.collect::<Vec<_>>().join(", ");
        let what = format!("the fields of {}: {names}", message.name());
        let pairs = self.reader.yaml.pairs(node, &what).unwrap_or_default();
        for (key, _) in pairs {
            self.known(key, message, &names);
        }
        let mut parts = Vec::new();
        for field in message.fields() {
            let is_meant = |key: &Node| matches!(&key.value, NodeValue::Scalar { text, .. } if **text == *field.name);
            let given = pairs.iter().find(|(key, _)| is_meant(key));
            let part = match given {
                Some((_, node)) => self.field(node, &field.field_type, message),
                None => Part::Fixed(field.field_type.zero()),
            };
            parts.push((Arc::clone(&field.name), part));
        }
        let is_fixed = parts.iter().all(|(_, part)| matches!(part, Part::Fixed(_)));
        match is_fixed {
            true => Part::Fixed(Value::Message(
                parts
                    .into_iter()
                    .filter_map(|(name, part)| Some((name, part.fixed().ok()?)))
                    .collect(),
            )),
            false => Part::Message(parts),
        }
    }

    /// Reports a key that is not a field of the type.
    fn known(&mut self, key: &'d Node, message: &MessageType, names: &str) {
        let Some(text) = self.reader.yaml.text(key, "the name of a field") else {
            return;
        };
        if message.field(text).is_some() {
            return;
        }
        let fields = message.fields().iter().map(|field| &*field.name);
        let help = match closest(text, fields) {
            Some(field) => format!("did you mean '{field}'?"),
            None if names.is_empty() => "it has no fields".to_owned(),
            None => format!("there are: {names}"),
        };
        let mistake = format!("{} has no field '{text}'", message.name());
        self.reader.yaml.wrong_with(key, mistake, Some(help));
    }

    fn field(&mut self, node: &'d Node, field: &FieldType, within: &MessageType) -> Part {
        if field.count == Count::One {
            return self.element(node, field, within);
        }
        if let Some(part) = self.placeholder(node, field) {
            return part;
        }
        let Some(nodes) = self.reader.yaml.list(node, &field.to_string()) else {
            return Part::Fixed(field.zero());
        };
        if let Count::Fixed(length) = field.count
            && length != nodes.len()
        {
            let found = nodes.len();
            self.wrong(node, format!("found {found} values; {field} has {length}"));
        }
        let element = FieldType {
            element: field.element.clone(),
            count: Count::One,
        };
        let parts: Vec<Part> = nodes
            .iter()
            .map(|node| self.element(node, &element, within))
            .collect();
        match parts.iter().all(|part| matches!(part, Part::Fixed(_))) {
            true => {
                let values = parts.into_iter().filter_map(|part| part.fixed().ok());
                Part::Fixed(list(field, values.collect()))
            }
            false => Part::List(field.clone(), parts),
        }
    }

    fn element(&mut self, node: &'d Node, field: &FieldType, within: &MessageType) -> Part {
        let primitive = match &field.element {
            Element::Message(message) => return self.message(node, message),
            Element::Primitive(primitive) => *primitive,
        };
        if let Some(part) = self.placeholder(node, field) {
            return part;
        }
        let is_time = matches!(primitive, Primitive::Time | Primitive::Duration);
        if is_time && let NodeValue::Map(_) = node.value {
            return self.time(node, primitive);
        }
        let what = match primitive.range() {
            Some((least, most)) => format!("{field}, a whole number from {least} to {most}"),
            None if primitive == Primitive::Time => "time: now, or seconds".to_owned(),
            None if primitive == Primitive::Duration => {
                "duration: seconds, or as 500 ms".to_owned()
            }
            None if primitive == Primitive::Bool => "bool: true or false".to_owned(),
            None => field.to_string(),
        };
        let zero = Part::Fixed(field.zero());
        let text = match &node.value {
            // An empty text in quotes is a text.
            NodeValue::Scalar { text, plain: false } if primitive == Primitive::Text => text,
            _ => match self.reader.yaml.text(node, &what) {
                Some(text) => text,
                None => return zero,
            },
        };
        if primitive == Primitive::Time && text == "now" {
            return Part::Now;
        }
        let constants = within.constants().iter();
        let mut named = constants.filter(|constant| constant.name == text);
        let literal = named.next().map_or(text, |constant| &constant.text);
        let value = from_text(primitive, literal).or_else(|| not_finite(primitive, text));
        match value {
            Some(value) => Part::Fixed(value),
            None => {
                self.wrong(node, format!("'{text}' is not {what}"));
                zero
            }
        }
    }

    fn time(&mut self, node: &'d Node, primitive: Primitive) -> Part {
        let zero = Element::Primitive(primitive);
        let zero = FieldType {
            element: zero,
            count: Count::One,
        }
        .zero();
        let Some(mut fields) = self.reader.yaml.fields(node, "secs: 1, nsecs: 0") else {
            return Part::Fixed(zero);
        };
        let (secs, nsecs) = (fields.optional("secs"), fields.optional("nsecs"));
        fields.finish(&mut self.reader.yaml);
        let yaml = &mut self.reader.yaml;
        let mut part = |node: Option<&'d Node>| {
            node.map_or(Some(0), |node| yaml.whole::<i64>(node, "a whole number"))
        };
        let (Some(secs), Some(nsecs)) = (part(secs), part(nsecs)) else {
            return Part::Fixed(zero);
        };
        let value = match primitive {
            Primitive::Time => u32::try_from(secs)
                .ok()
                .zip(u32::try_from(nsecs).ok())
                .map(|(secs, nsecs)| Value::Time { secs, nsecs }),
            _ => i32::try_from(secs)
                .ok()
                .zip(i32::try_from(nsecs).ok())
                .map(|(secs, nsecs)| Value::Duration { secs, nsecs }),
        };
        if value.is_none() {
            self.wrong(
                node,
                format!("this is out of range for {}", primitive.name()),
            );
        }
        Part::Fixed(value.unwrap_or(zero))
    }

    /// A part with placeholders; `None` if there are none.
    fn placeholder(&mut self, node: &'d Node, field: &FieldType) -> Option<Part> {
        let NodeValue::Scalar { text, .. } = &node.value else {
            return None;
        };
        let template = match Template::parse(text) {
            Ok(template) if template.is_fixed() => return None,
            Ok(template) => template,
            Err(mistake) => {
                self.wrong(node, mistake);
                return Some(Part::Fixed(field.zero()));
            }
        };
        if let Some(lacking) = template.lacks(self.rule) {
            self.wrong(
                node,
                format!("no goal has '{lacking}': it is {}", self.rule),
            );
            return Some(Part::Fixed(field.zero()));
        }
        let is_text =
            field.count == Count::One && field.element == Element::Primitive(Primitive::Text);
        let Some(path) = template.goal_alone() else {
            if !is_text {
                self.wrong(
                    node,
                    format!(
                        "only a text has words beside a placeholder; {field} takes '{{goal}}' alone"
                    ),
                );
                return Some(Part::Fixed(field.zero()));
            }
            return Some(Part::Text(template));
        };
        if let Some(rule) = self.rule.part(path)
            && let Err(why) = may_fit(rule, field)
        {
            self.wrong(node, format!("the goal does not fit: {why}"));
            return Some(Part::Fixed(field.zero()));
        }
        Some(Part::Goal {
            path: path.to_vec(),
            field: field.clone(),
            except: None,
        })
    }

    fn wrong(&mut self, node: &Node, message: impl Into<String>) {
        self.reader.yaml.wrong(node, message);
    }
}

/// Numbers that only the owner of the robot may write.
fn not_finite(primitive: Primitive, text: &str) -> Option<Value> {
    if !matches!(primitive, Primitive::Float32 | Primitive::Float64) {
        return None;
    }
    Some(Value::Float(match text {
        ".nan" | ".NaN" | ".NAN" => f64::NAN,
        ".inf" | ".Inf" | ".INF" => f64::INFINITY,
        "-.inf" | "-.Inf" | "-.INF" => f64::NEG_INFINITY,
        _ => return None,
    }))
}
