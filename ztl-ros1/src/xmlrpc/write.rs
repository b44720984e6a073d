//! Writes calls and responses.

use super::Value;

/// A call of this method with these parameters.
#[must_use]
pub fn call(method: &str, params: &[Value]) -> String {
    let mut text = "<?xml version=\"1.0\"?><methodCall><methodName>".to_owned();
    escape(method, &mut text);
    text.push_str("</methodName><params>");
    for param in params {
        text.push_str("<param>");
        value(param, &mut text);
        text.push_str("</param>");
    }
    text.push_str("</params></methodCall>");
    text
}

/// A response with this value.
#[must_use]
pub fn response(result: &Value) -> String {
    let mut text = "<?xml version=\"1.0\"?><methodResponse><params><param>".to_owned();
    value(result, &mut text);
    text.push_str("</param></params></methodResponse>");
    text
}

/// The response to a call that could not be understood: a fault with this text.
#[must_use]
pub fn fault(reason: &str) -> String {
    let fault = Value::Struct(vec![
        ("faultCode".to_owned(), Value::Int(1)),
        ("faultString".to_owned(), reason.into()),
    ]);
    let mut text = "<?xml version=\"1.0\"?><methodResponse><fault>".to_owned();
    value(&fault, &mut text);
    text.push_str("</fault></methodResponse>");
    text
}

fn value(of: &Value, text: &mut String) {
    text.push_str("<value>");
    match of {
        Value::Nil => text.push_str("<nil/>"),
        Value::Bool(bool) => tag("boolean", if *bool { "1" } else { "0" }, text),
        Value::Int(number) => {
            let name = if i32::try_from(*number).is_ok() {
                "int"
            } else {
                "i8"
            };
            tag(name, &number.to_string(), text);
        }
        Value::Double(number) => tag("double", &number.to_string(), text),
        Value::String(string) => tag("string", string, text),
        Value::Raw(raw) => tag("base64", raw, text),
        Value::Array(items) => {
            text.push_str("<array><data>");
            items.iter().for_each(|item| value(item, text));
            text.push_str("</data></array>");
        }
        Value::Struct(members) => {
            text.push_str("<struct>");
            for (name, of) in members {
                text.push_str("<member>");
                tag("name", name, text);
                value(of, text);
                text.push_str("</member>");
            }
            text.push_str("</struct>");
        }
    }
    text.push_str("</value>");
}

fn tag(name: &str, content: &str, text: &mut String) {
    text.extend(["<", name, ">"]);
    escape(content, text);
    text.extend(["</", name, ">"]);
}

fn escape(content: &str, text: &mut String) {
    for c in content.chars() {
        match c {
            '&' => text.push_str("&amp;"),
            '<' => text.push_str("&lt;"),
            '>' => text.push_str("&gt;"),
            // An XML reader would turn it into a line feed.
            '\r' => text.push_str("&#13;"),
            c => text.push(c),
        }
    }
}
