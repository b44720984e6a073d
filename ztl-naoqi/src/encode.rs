//! Writes values in the types that a signature asks for.

use std::fmt;

use crate::signature::{Signature, Tuple};
use crate::value::Value;

/// Why a value does not fit a signature.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Mismatch {
    /// Where in the value: `[2]` is the third element, `.x` the value of a key.
    pub path: String,
    /// What must be there.
    pub expected: String,
    /// What is there instead.
    pub found: String,
}

impl fmt::Display for Mismatch {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if !self.path.is_empty() {
            write!(f, "at {}: ", self.path.trim_start_matches('.'))?;
        }
        write!(f, "must be {}, not {}", self.expected, self.found)
    }
}

impl std::error::Error for Mismatch {}

/// How far a value is from the types of a signature; the nearest overload is called.
pub(crate) type Distance = u32;

/// Appends a value. Returns how far its types are from the signature's.
///
/// # Errors
/// [`Mismatch`] if the value does not fit; `out` then contains a part of it.
pub(crate) fn encode(
    value: &Value,
    signature: &Signature,
    out: &mut Vec<u8>,
) -> Result<Distance, Mismatch> {
    let wrong = || Mismatch {
        path: String::new(),
        expected: signature.to_string(),
        found: value.what().to_owned(),
    };
    match (signature, value) {
        (Signature::Void, Value::Nothing) => {}
        (Signature::Bool, Value::Bool(value)) => out.push(u8::from(*value)),
        (Signature::Integer { bytes, signed }, Value::Integer(_) | Value::Unsigned(_)) => {
            integer(value, *bytes, *signed, out)?;
        }
        (Signature::Float | Signature::Double, Value::Float(number)) => {
            return float(f64::from(*number), signature, out);
        }
        (Signature::Float | Signature::Double, Value::Double(number)) => {
            return float(*number, signature, out);
        }
        (Signature::Float | Signature::Double, Value::Integer(number)) => {
            return float(*number as f64, signature, out).map(|distance| distance + 2);
        }
        (Signature::Float | Signature::Double, Value::Unsigned(number)) => {
            return float(*number as f64, signature, out).map(|distance| distance + 2);
        }
        (Signature::Text, Value::Text(text)) => counted(text.as_bytes(), out)?,
        (Signature::Raw, Value::Raw(bytes)) => counted(bytes, out)?,
        (Signature::Dynamic, _) => {
            let mut natural = String::new();
            put_name(value, &mut natural).ok_or_else(wrong)?;
            counted(natural.as_bytes(), out)?;
            put(value, out)?;
            return Ok(5);
        }
        (Signature::List(element), Value::List(items)) => {
            return list(items, element, out);
        }
        (Signature::List(element), Value::Tuple(_, items)) => {
            return list(items, element, out).map(|distance| distance + 1);
        }
        (Signature::Map(entry), Value::Map(entries)) => {
            count(entries.len(), out)?;
            let mut most = 0;
            for (key, value) in entries {
                most = most.max(encode(key, &entry.0, out).map_err(|error| at_key(key, error))?);
                most = most.max(encode(value, &entry.1, out).map_err(|error| at_key(key, error))?);
            }
            return Ok(most);
        }
        (Signature::Tuple(tuple), Value::Tuple(_, items)) => {
            return fields(tuple, items, out).ok_or_else(wrong)?;
        }
        (Signature::Tuple(tuple), Value::List(items)) => {
            let written = fields(tuple, items, out).ok_or_else(wrong)?;
            return written.map(|distance| distance + 1);
        }
        (Signature::Tuple(tuple), Value::Map(entries)) => {
            return named(tuple, entries, out).ok_or_else(wrong)?;
        }
        (Signature::Optional(_), Value::Nothing) => out.push(0),
        (Signature::Optional(inner), _) => {
            out.push(1);
            return encode(value, inner, out).map(|distance| distance + 1);
        }
        _ => return Err(wrong()),
    }
    Ok(0)
}

/// Appends the values of a tuple.
fn fields(tuple: &Tuple, items: &[Value], out: &mut Vec<u8>) -> Option<Result<Distance, Mismatch>> {
    (tuple.fields.len() == items.len()).then(|| {
        let mut most = 0;
        for (index, (signature, item)) in tuple.fields.iter().zip(items).enumerate() {
            most = most.max(encode(item, signature, out).map_err(|error| at_index(index, error))?);
        }
        Ok(most)
    })
}

/// Appends the values of a tuple whose fields have names.
fn named(
    tuple: &Tuple,
    entries: &[(Value, Value)],
    out: &mut Vec<u8>,
) -> Option<Result<Distance, Mismatch>> {
    let names = tuple.names.iter();
    let items: Option<Vec<&Value>> = names
        .map(|name| {
            let named = |(key, _): &&(Value, Value)| key.as_text() == Some(name);
            entries.iter().find(named).map(|(_, value)| value)
        })
        .collect();
    let items = items.filter(|items| items.len() == entries.len() && !items.is_empty())?;
    let mut most = 0;
    for (index, (signature, item)) in tuple.fields.iter().zip(items).enumerate() {
        match encode(item, signature, out) {
            Ok(distance) => most = most.max(distance),
            Err(mut error) => {
                let name = tuple.names.get(index).map_or("", |name| name);
                error.path.insert_str(0, &format!(".{name}"));
                return Some(Err(error));
            }
        }
    }
    Some(Ok(most))
}

fn list(items: &[Value], element: &Signature, out: &mut Vec<u8>) -> Result<Distance, Mismatch> {
    count(items.len(), out)?;
    let mut most = 0;
    for (index, item) in items.iter().enumerate() {
        most = most.max(encode(item, element, out).map_err(|error| at_index(index, error))?);
    }
    Ok(most)
}

fn at_index(index: usize, mut error: Mismatch) -> Mismatch {
    error.path.insert_str(0, &format!("[{index}]"));
    error
}

fn at_key(key: &Value, mut error: Mismatch) -> Mismatch {
    error.path.insert_str(0, &format!(".{key}"));
    error
}

fn count(count: usize, out: &mut Vec<u8>) -> Result<(), Mismatch> {
    let count = u32::try_from(count).map_err(|_| Mismatch {
        path: String::new(),
        expected: "shorter".to_owned(),
        found: format!("{count} long"),
    })?;
    out.extend(count.to_le_bytes());
    Ok(())
}

fn counted(bytes: &[u8], out: &mut Vec<u8>) -> Result<(), Mismatch> {
    count(bytes.len(), out)?;
    out.extend(bytes);
    Ok(())
}

fn integer(value: &Value, bytes: u8, signed: bool, out: &mut Vec<u8>) -> Result<(), Mismatch> {
    let number = match value {
        Value::Integer(number) => i128::from(*number),
        Value::Unsigned(number) => i128::from(*number),
        _ => 0,
    };
    let bits = u32::from(bytes) * 8;
    let (least, most) = match signed {
        true => (-(1_i128 << (bits - 1)), (1_i128 << (bits - 1)) - 1),
        false => (0, (1_i128 << bits) - 1),
    };
    if !(least..=most).contains(&number) {
        return Err(Mismatch {
            path: String::new(),
            expected: format!("an integer from {least} to {most}"),
            found: number.to_string(),
        });
    }
    out.extend(number.to_le_bytes().iter().take(usize::from(bytes)));
    Ok(())
}

fn float(number: f64, signature: &Signature, out: &mut Vec<u8>) -> Result<Distance, Mismatch> {
    if *signature == Signature::Double {
        out.extend(number.to_le_bytes());
        return Ok(0);
    }
    let single = number as f32;
    if number.is_finite() && !single.is_finite() {
        return Err(Mismatch {
            path: String::new(),
            expected: "a number of 32 bits".to_owned(),
            found: number.to_string(),
        });
    }
    out.extend(single.to_le_bytes());
    Ok(0)
}

/// The signature that a value has as a dynamic one: that which libqi's Python gives it. None for an object.
fn put_name(value: &Value, out: &mut String) -> Option<()> {
    let name = match value {
        Value::Nothing => "v",
        Value::Bool(_) => "b",
        Value::Integer(_) => "l",
        Value::Unsigned(_) => "L",
        Value::Float(_) => "f",
        Value::Double(_) => "d",
        Value::Text(_) => "s",
        Value::Raw(_) => "r",
        Value::List(_) => "[m]",
        Value::Map(_) => "{mm}",
        Value::Object(_) => return None,
        Value::Tuple(_, items) => {
            out.push('(');
            for item in items {
                put_name(item, out)?;
            }
            ")"
        }
    };
    out.push_str(name);
    Some(())
}

/// Appends a value in the types of [`put_name`].
fn put(value: &Value, out: &mut Vec<u8>) -> Result<(), Mismatch> {
    match value {
        Value::Nothing | Value::Object(_) => {}
        Value::Bool(value) => out.push(u8::from(*value)),
        Value::Integer(number) => out.extend(number.to_le_bytes()),
        Value::Unsigned(number) => out.extend(number.to_le_bytes()),
        Value::Float(number) => out.extend(number.to_le_bytes()),
        Value::Double(number) => out.extend(number.to_le_bytes()),
        Value::Text(text) => counted(text.as_bytes(), out)?,
        Value::Raw(bytes) => counted(bytes, out)?,
        Value::List(items) => {
            list(items, &Signature::Dynamic, out)?;
        }
        Value::Map(entries) => {
            count(entries.len(), out)?;
            for (key, value) in entries {
                encode(key, &Signature::Dynamic, out)?;
                encode(value, &Signature::Dynamic, out)?;
            }
        }
        Value::Tuple(_, items) => {
            for item in items {
                put(item, out)?;
            }
        }
    }
    Ok(())
}
