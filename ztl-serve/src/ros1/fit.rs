//! Values of goals as values of messages, and the rules that goals for them have.

use std::sync::Arc;
use std::time::Duration;

use ztl_core::goal;
use ztl_ros1::message::{Count, Element, FieldType, MessageType, Primitive, Value};
use ztl_std::describe::{GoalField, GoalRule, GoalValue, shown};

/// How many levels of messages a rule for goals describes.
const DESCRIBED: usize = 3;

/// The value of a field, if the goal's value fits its type. `at` names the value in messages, as `goal.x`.
pub(super) fn fit(value: &GoalValue, field: &FieldType, at: &str) -> Result<Value, String> {
    if field.count == Count::One {
        return fit_element(value, &field.element, at);
    }
    let GoalValue::List(items) = value else {
        return Err(wrong(value, field, at));
    };
    if let Count::Fixed(length) = field.count
        && length != items.len()
    {
        let found = items.len();
        return Err(format!("{at} has {found} values, and {field} has {length}"));
    }
    let items = items.iter().enumerate();
    let items =
        items.map(|(index, item)| fit_element(item, &field.element, &format!("{at}.{index}")));
    Ok(list(field, items.collect::<Result<_, _>>()?))
}

/// The value of an array with these items.
pub(super) fn list(field: &FieldType, items: Vec<Value>) -> Value {
    if !field.is_bytes() {
        return Value::List(items);
    }
    let byte = |item: Value| match item {
        Value::Unsigned(byte) => u8::try_from(byte).unwrap_or_default(),
        _ => 0,
    };
    Value::Bytes(items.into_iter().map(byte).collect())
}

fn wrong(value: &GoalValue, field: impl std::fmt::Display, at: &str) -> String {
    let text = value.to_text().unwrap_or_default();
    format!("{at}: '{}' is not {field}", shown(&text))
}

fn fit_element(value: &GoalValue, element: &Element, at: &str) -> Result<Value, String> {
    let primitive = match element {
        Element::Message(message) => return fit_message(value, message, at),
        Element::Primitive(primitive) => *primitive,
    };
    let fitted = match value {
        GoalValue::Bool(truth) if primitive == Primitive::Bool => Some(Value::Bool(*truth)),
        GoalValue::Text(text) => from_text(primitive, text),
        // Integers beyond 2^53 are not numbers of robots.
        #[expect(clippy::cast_precision_loss, reason = "the nearest float is meant")]
        GoalValue::Integer(number) => {
            from_integer(primitive, *number).or_else(|| from_number(primitive, *number as f64))
        }
        GoalValue::Float(number) => from_number(primitive, *number),
        GoalValue::Map(_) => from_parts(primitive, value),
        _ => None,
    };
    // Numbers, too, are texts for who asks for a text.
    let fitted = fitted.or_else(|| match (primitive, value) {
        (Primitive::Text, GoalValue::List(_) | GoalValue::Map(_)) => None,
        (Primitive::Text, value) => value.to_text().ok().map(Value::Text),
        _ => None,
    });
    fitted.ok_or_else(|| {
        let range = primitive.range();
        let range = range.map(|(least, most)| format!(" from {least} to {most}"));
        wrong(
            value,
            format!("{}{}", primitive.name(), range.unwrap_or_default()),
            at,
        )
    })
}

fn fit_message(value: &GoalValue, message: &MessageType, at: &str) -> Result<Value, String> {
    let fields = message.fields();
    let mut given: Vec<Option<Value>> = vec![None; fields.len()];
    match value {
        GoalValue::Map(pairs) => {
            for (key, value) in pairs {
                let name = key.to_text().unwrap_or_default();
                let index = fields.iter().position(|field| *field.name == *name);
                let found =
                    index.and_then(|index| Some((fields.get(index)?, given.get_mut(index)?)));
                let Some((field, slot)) = found else {
                    let name = shown(&name);
                    return Err(format!("{at}: {} has no field '{name}'", message.name()));
                };
                *slot = Some(fit(value, &field.field_type, &format!("{at}.{name}"))?);
            }
        }
        GoalValue::List(items) if items.len() == fields.len() => {
            for ((item, field), slot) in items.iter().zip(fields).zip(&mut given) {
                *slot = Some(fit(
                    item,
                    &field.field_type,
                    &format!("{at}.{}", field.name),
                )?);
            }
        }
        // Of a message with a single field, that field.
        value => match (fields, given.as_mut_slice()) {
            ([field], [slot]) => *slot = Some(fit(value, &field.field_type, at)?),
            _ => return Err(wrong(value, message.name(), at)),
        },
    }
    let values = fields.iter().zip(given);
    let values = values.map(|(field, value)| {
        let value = value.unwrap_or_else(|| field.field_type.zero());
        (Arc::clone(&field.name), value)
    });
    Ok(Value::Message(values.collect()))
}

/// The value of a text, if it is one of this type.
pub(super) fn from_text(primitive: Primitive, text: &str) -> Option<Value> {
    if primitive == Primitive::Text {
        return Some(Value::Text(text.to_owned()));
    }
    if primitive == Primitive::Bool {
        return goal::from_str(text).ok().map(Value::Bool);
    }
    if primitive.range().is_some() {
        let signed = goal::from_str::<i64>(text).map(i128::from);
        let number = signed.or_else(|_| goal::from_str::<u64>(text).map(i128::from));
        return from_integer(primitive, number.ok()?);
    }
    if let Ok(number) = goal::from_str::<f64>(text) {
        return from_number(primitive, number);
    }
    match primitive {
        Primitive::Duration => of_duration(humantime::parse_duration(text).ok()?, false),
        _ => None,
    }
}

/// The value of an integer, for a type that takes integers alone.
fn from_integer(primitive: Primitive, number: i128) -> Option<Value> {
    let (least, most) = primitive.range()?;
    if !(least..=most).contains(&number) {
        return None;
    }
    match least {
        0 => u64::try_from(number).ok().map(Value::Unsigned),
        _ => i64::try_from(number).ok().map(Value::Signed),
    }
}

fn from_number(primitive: Primitive, number: f64) -> Option<Value> {
    match primitive {
        Primitive::Float64 if number.is_finite() => Some(Value::Float(number)),
        Primitive::Float32 if number.abs() <= f64::from(f32::MAX) => Some(Value::Float(number)),
        Primitive::Time => of_duration(Duration::try_from_secs_f64(number).ok()?, true),
        Primitive::Duration => {
            let time = Duration::try_from_secs_f64(number.abs()).ok()?;
            let value = of_duration(time, false)?;
            match value {
                Value::Duration { secs, nsecs } if number < 0.0 => Some(Value::Duration {
                    secs: -secs,
                    nsecs: -nsecs,
                }),
                value => Some(value),
            }
        }
        _ => None,
    }
}

fn of_duration(time: Duration, is_moment: bool) -> Option<Value> {
    let nanos = time.subsec_nanos();
    Some(match is_moment {
        true => Value::Time {
            secs: u32::try_from(time.as_secs()).ok()?,
            nsecs: nanos,
        },
        false => Value::Duration {
            secs: i32::try_from(time.as_secs()).ok()?,
            nsecs: i32::try_from(nanos).ok()?,
        },
    })
}

/// A time of seconds and nanoseconds.
fn from_parts(primitive: Primitive, value: &GoalValue) -> Option<Value> {
    let part = |name: &str| match value.part(name) {
        Some(GoalValue::Integer(number)) => Some(*number),
        None => Some(0),
        Some(_) => None,
    };
    let (secs, nsecs) = (part("secs")?, part("nsecs")?);
    match primitive {
        Primitive::Time => Some(Value::Time {
            secs: u32::try_from(secs).ok()?,
            nsecs: u32::try_from(nsecs).ok()?,
        }),
        Primitive::Duration => Some(Value::Duration {
            secs: i32::try_from(secs).ok()?,
            nsecs: i32::try_from(nsecs).ok()?,
        }),
        _ => None,
    }
}

/// Whether each goal of this rule may fit the type; if not, why not.
pub(super) fn may_fit(rule: &GoalRule, field: &FieldType) -> Result<(), String> {
    let differs = || Err(format!("it is {rule}, and {field} is needed"));
    if matches!(rule, GoalRule::Any) {
        return Ok(());
    }
    let element = FieldType {
        element: field.element.clone(),
        count: Count::One,
    };
    if field.count != Count::One {
        return match rule {
            GoalRule::ListOf(item) => may_fit(item, &element),
            _ => differs(),
        };
    }
    let primitive = match &field.element {
        Element::Primitive(primitive) => *primitive,
        Element::Message(message) => return may_fit_message(rule, message),
    };
    let fits = match (primitive, rule) {
        (_, GoalRule::Nothing | GoalRule::Fields(_) | GoalRule::ListOf(_)) => false,
        (Primitive::Text, _) => true,
        (Primitive::Bool, GoalRule::Bool) => true,
        (Primitive::Bool, _) | (_, GoalRule::Bool) => false,
        (Primitive::Duration, GoalRule::Text { .. }) => true,
        (_, GoalRule::Text { .. }) => false,
        (primitive, GoalRule::OneOf(words)) => words
            .iter()
            .all(|word| from_text(primitive, word).is_some()),
        (
            primitive,
            GoalRule::Number {
                whole, least, most, ..
            },
        ) => {
            if let Some((low, high)) = primitive.range() {
                if !whole {
                    return Err(format!("{field} takes whole numbers; write type: whole"));
                }
                // Bounds as people write them are far from the integers that a float cannot represent.
                #[expect(clippy::cast_precision_loss, reason = "compared with bounds alone")]
                let (low, high) = (low as f64, high as f64);
                let wrong = [least, most]
                    .into_iter()
                    .flatten()
                    .find(|it| **it < low || **it > high);
                if let Some(wrong) = wrong {
                    return Err(format!(
                        "it may be {wrong}, and {field} takes {low} to {high}"
                    ));
                }
            }
            true
        }
        _ => true,
    };
    if fits { Ok(()) } else { differs() }
}

fn may_fit_message(rule: &GoalRule, message: &MessageType) -> Result<(), String> {
    match (rule, message.fields()) {
        (GoalRule::Fields(given), _) => given.iter().try_for_each(|given| {
            let name = &given.name;
            let field = message.field(name);
            let field = field.ok_or_else(|| format!("{} has no field '{name}'", message.name()))?;
            may_fit(&given.rule, field).map_err(|why| format!("{name}: {why}"))
        }),
        (rule, [field]) => may_fit(rule, &field.field_type),
        (rule, _) => Err(format!("it is {rule}, and {} is needed", message.name())),
    }
}

/// The rule for goals that have this type.
pub(super) fn rule_of(field: &FieldType) -> GoalRule {
    rule_within(field, DESCRIBED)
}

fn rule_within(field: &FieldType, levels: usize) -> GoalRule {
    let rule = match &field.element {
        Element::Message(message) => rule_of_message(message, levels),
        Element::Primitive(Primitive::Bool) => GoalRule::Bool,
        Element::Primitive(Primitive::Text) => GoalRule::Text { longest: None },
        Element::Primitive(Primitive::Time | Primitive::Duration) => GoalRule::Any,
        Element::Primitive(primitive) => {
            let range = primitive.range();
            // Those of 64 bits are no floats.
            let bounds = range.and_then(|(least, most)| {
                let bound = |number| i32::try_from(number).map(f64::from).ok();
                let unsigned = |number| u32::try_from(number).map(f64::from).ok();
                Some((
                    bound(least).or_else(|| unsigned(least))?,
                    bound(most).or_else(|| unsigned(most))?,
                ))
            });
            GoalRule::Number {
                whole: range.is_some(),
                least: bounds.map(|(least, _)| least),
                most: bounds.map(|(_, most)| most),
                step: None,
                unit: None,
            }
        }
    };
    match field.count {
        Count::One => rule,
        Count::Fixed(_) | Count::Any => GoalRule::ListOf(Arc::new(rule)),
    }
}

fn rule_of_message(message: &MessageType, levels: usize) -> GoalRule {
    let Some(below) = levels.checked_sub(1) else {
        return GoalRule::Any;
    };
    let fields = message.fields().iter().map(|field| GoalField {
        name: Arc::clone(&field.name),
        rule: rule_within(&field.field_type, below),
        optional: true,
        default: None,
    });
    match message.fields() {
        [] => GoalRule::Nothing,
        // Of a message with a single field, that field.
        [field] => rule_within(&field.field_type, below),
        _ => GoalRule::Fields(fields.collect()),
    }
}
