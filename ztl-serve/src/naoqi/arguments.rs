//! Arguments of methods: values of the file and of goals, in the types that a method takes.

use ztl_naoqi::{MetaObject, Method, Signature, Value};
use ztl_std::describe::{GoalRule, GoalValue};

use crate::call::Call;
use crate::value_template::{ValueTemplate, rule_of_paths};

/// For so many arguments that are a number or a text, both are tried.
const MOST_OPEN: usize = 6;

/// Arguments with placeholders.
#[derive(Debug, Clone, Default)]
pub(crate) struct Arguments(pub(super) Vec<ValueTemplate>);

/// A value for a call, and the same as a text, if the method may want that.
#[derive(Debug, Clone)]
pub(super) struct Argument {
    value: Value,
    text: Option<String>,
}

impl Arguments {
    pub(super) fn goal_rule(&self) -> GoalRule {
        let mut paths = Vec::new();
        self.0.iter().for_each(|value| value.goal_paths(&mut paths));
        match paths.as_slice() {
            [[]] => GoalRule::Any,
            paths => rule_of_paths(paths),
        }
    }

    pub(super) const fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    pub(super) fn needs_fields(&self) -> bool {
        self.0.iter().any(ValueTemplate::needs_fields)
    }

    /// The arguments for a task.
    pub(super) fn fill(&self, call: &Call) -> Result<Vec<Argument>, String> {
        let arguments = self.0.iter().map(|template| {
            let value = template.fill(call)?;
            let text = match template {
                ValueTemplate::Goal { path, .. } if path.is_empty() => Some(call.goal.text.clone()),
                ValueTemplate::Goal { .. } => value.to_text().ok(),
                _ => None,
            };
            Ok(Argument::new(value, text))
        });
        arguments.collect()
    }

    /// Whether the service has such a method that may take these arguments: each goal stands for one that fits.
    ///
    /// # Errors
    /// What does not fit.
    pub(super) fn check(
        &self,
        meta: &MetaObject,
        service: &str,
        method: &str,
    ) -> Result<(), String> {
        let mut mistake = None;
        for overload in meta.overloads(method) {
            let Ok(tuple) = overload.arguments() else {
                continue;
            };
            let signatures = tuple.map(|tuple| tuple.fields).unwrap_or_default();
            let samples = self.0.iter().enumerate().map(|(index, template)| {
                let wanted = signatures.get(index).unwrap_or(&Signature::Dynamic);
                sample(template, wanted)
            });
            let samples: Vec<Argument> = samples.collect();
            match fit(meta, service, &named(overload), samples) {
                Ok(_) => return Ok(()),
                Err(error) => mistake = mistake.or(Some(error)),
            }
        }
        let absent = || {
            meta.check(service, method, &[])
                .err()
                .map(|it| it.to_string())
        };
        mistake.or_else(absent).map_or(Ok(()), Err)
    }
}

/// The name of one overload.
fn named(method: &Method) -> String {
    format!("{}::{}", method.name, method.parameters)
}

impl Argument {
    fn new(value: GoalValue, text: Option<String>) -> Self {
        let value = converted(value);
        let text = text.filter(|_| !matches!(value, Value::Text(_)));
        Self { value, text }
    }
}

/// The values that the method takes: those of the goal as they are written, or as texts where it wants texts.
///
/// # Errors
/// Which argument is wrong, and what it must be.
pub(super) fn fit(
    meta: &MetaObject,
    service: &str,
    method: &str,
    arguments: Vec<Argument>,
) -> Result<Vec<Value>, String> {
    let open = arguments.iter().filter(|it| it.text.is_some()).count();
    let mut mistake = String::new();
    for choice in 0..1_u32 << open.min(MOST_OPEN) {
        let mut nth = 0;
        let values = arguments.iter().map(|argument| match &argument.text {
            Some(text) => {
                let as_text = choice >> nth & 1 == 1;
                nth += 1;
                match as_text {
                    true => Value::Text(text.clone()),
                    false => argument.value.clone(),
                }
            }
            None => argument.value.clone(),
        });
        let values: Vec<Value> = values.collect();
        match meta.check(service, method, &values) {
            Ok(()) => return Ok(values),
            Err(error) if choice == 0 => mistake = error.to_string(),
            Err(_) => {}
        }
    }
    Err(mistake)
}

fn converted(value: GoalValue) -> Value {
    match value {
        GoalValue::Null => Value::Nothing,
        GoalValue::Bool(value) => Value::Bool(value),
        GoalValue::Integer(number) => match (i64::try_from(number), u64::try_from(number)) {
            (Ok(number), _) => Value::Integer(number),
            (_, Ok(number)) => Value::Unsigned(number),
            _ => Value::Double(number as f64),
        },
        GoalValue::Float(number) => Value::Double(number),
        GoalValue::Text(text) => Value::Text(text),
        GoalValue::List(items) => Value::List(items.into_iter().map(converted).collect()),
        GoalValue::Map(pairs) => {
            let pairs = pairs.into_iter();
            Value::Map(
                pairs
                    .map(|(key, value)| (converted(key), converted(value)))
                    .collect(),
            )
        }
    }
}

/// A value that stands for all that goals may bring.
fn sample(template: &ValueTemplate, wanted: &Signature) -> Argument {
    let plain = |value| Argument { value, text: None };
    match template {
        ValueTemplate::Fixed(value) => Argument::new(value.clone(), None),
        ValueTemplate::Answer(_) | ValueTemplate::Text(_) => plain(Value::Text("text".to_owned())),
        ValueTemplate::Goal { rule, .. } => match sample_of_rule(rule) {
            Some(value) => Argument::new(value, Some("text".to_owned())),
            None => plain(sample_of_type(wanted)),
        },
        ValueTemplate::List(items) => {
            let element = match wanted {
                Signature::List(element) => element,
                _ => &Signature::Dynamic,
            };
            plain(Value::List(
                items.iter().map(|it| sample(it, element).value).collect(),
            ))
        }
        ValueTemplate::Map(pairs) => {
            let pairs = pairs.iter().map(|(key, value)| {
                let value = sample(value, &Signature::Dynamic).value;
                (converted(key.clone()), value)
            });
            plain(Value::Map(pairs.collect()))
        }
    }
}

/// A value that the rule takes; nothing if it takes different types.
fn sample_of_rule(rule: &GoalRule) -> Option<GoalValue> {
    Some(match rule {
        GoalRule::Number {
            whole: true,
            least,
            most,
            ..
        } => {
            let number = least.or(*most).unwrap_or_default();
            GoalValue::Integer(number as i128)
        }
        GoalRule::Number { .. } => GoalValue::Float(0.5),
        GoalRule::Bool => GoalValue::Bool(true),
        GoalRule::Text { .. } | GoalRule::OneOf(_) => GoalValue::Text("text".to_owned()),
        GoalRule::ListOf(item) => GoalValue::List(vec![sample_of_rule(item)?]),
        _ => return None,
    })
}

/// A value of this type.
fn sample_of_type(signature: &Signature) -> Value {
    match signature {
        Signature::Bool => Value::Bool(true),
        Signature::Integer { .. } => Value::Integer(0),
        Signature::Float | Signature::Double => Value::Double(0.5),
        Signature::Raw => Value::Raw(Vec::new()),
        Signature::List(_) => Value::List(Vec::new()),
        Signature::Map(_) => Value::Map(Vec::new()),
        Signature::Tuple(tuple) => Value::List(tuple.fields.iter().map(sample_of_type).collect()),
        Signature::Void | Signature::Optional(_) => Value::Nothing,
        Signature::Text | Signature::Dynamic | Signature::Object | Signature::Unknown => {
            Value::Text("text".to_owned())
        }
    }
}
