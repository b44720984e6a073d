//! XML-RPC, the language of ROS 1's master and of the control of its nodes.
//!
//! Reading is bounded: values nest 64 levels at most, and no input panics. The length is limited by HTTP.

mod read;
mod write;

use std::fmt;

pub use read::{parse_call, parse_response};
pub use write::{call, fault, response};

/// The deepest nesting of a value.
const DEPTH: usize = 64;

/// A value of XML-RPC.
#[derive(Debug, Clone, PartialEq)]
pub enum Value {
    /// `nil`, an extension that Python sends.
    Nil,
    /// `boolean`
    Bool(bool),
    /// `int`, `i4` or `i8`.
    Int(i64),
    /// `double`
    Double(f64),
    /// `string`, and a value without a type.
    String(String),
    /// `base64` or `dateTime.iso8601`, as it was written.
    Raw(String),
    /// `array`
    Array(Vec<Value>),
    /// `struct`, in the order of the text.
    Struct(Vec<(String, Value)>),
}

impl Value {
    /// The text of a string.
    #[must_use]
    pub fn as_str(&self) -> Option<&str> {
        match self {
            Self::String(text) => Some(text),
            _ => None,
        }
    }

    /// A whole number.
    #[must_use]
    pub fn as_int(&self) -> Option<i64> {
        match self {
            Self::Int(number) => Some(*number),
            _ => None,
        }
    }

    /// The items of an array.
    #[must_use]
    pub fn as_array(&self) -> Option<&[Value]> {
        match self {
            Self::Array(items) => Some(items),
            _ => None,
        }
    }
}

impl From<&str> for Value {
    fn from(text: &str) -> Self {
        Self::String(text.to_owned())
    }
}

/// The answer to a call.
#[derive(Debug, Clone, PartialEq)]
pub enum Response {
    /// What the method returns.
    Value(Value),
    /// The text of a fault: the method was not carried out, or failed.
    Fault(String),
}

/// Why a text is not a message of XML-RPC.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ReadError {
    /// It is not UTF-8.
    NotUtf8,
    /// At this byte, something else was expected.
    Expected {
        /// What was expected.
        what: &'static str,
        /// The offset in bytes.
        at: usize,
    },
    /// Values nest deeper than this.
    TooDeep {
        /// The limit.
        most: usize,
    },
}

impl fmt::Display for ReadError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NotUtf8 => f.write_str("XML-RPC that is not UTF-8"),
            Self::Expected { what, at } => write!(f, "XML-RPC: expected {what} at byte {at}"),
            Self::TooDeep { most } => write!(f, "XML-RPC: values nest deeper than {most} levels"),
        }
    }
}

impl std::error::Error for ReadError {}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample() -> Value {
        Value::Array(vec![
            Value::Int(-7),
            Value::Bool(true),
            Value::Double(0.1),
            Value::String("a <b> & \"c\"\r\n é".to_owned()),
            Value::Nil,
            Value::Struct(vec![("k".to_owned(), Value::Array(Vec::new()))]),
        ])
    }

    #[test]
    fn what_is_written_is_read() {
        let text = call("m.x", &[sample(), "".into()]);
        let read = parse_call(text.as_bytes()).unwrap();
        assert_eq!(read, ("m.x".to_owned(), vec![sample(), "".into()]));
        let text = response(&sample());
        let read = parse_response(text.as_bytes()).unwrap();
        assert_eq!(read, Response::Value(sample()));
        let text = fault("no such method");
        let read = parse_response(text.as_bytes()).unwrap();
        assert_eq!(read, Response::Fault("no such method".to_owned()));
    }

    #[test]
    fn what_python_and_roscpp_write_is_read() {
        let python = "<?xml version='1.0'?>\n<methodResponse>\n<params>\n<param>\n<value><array><data>\n\
            <value><int>1</int></value>\n<value><string></string></value>\n<value><nil/></value>\n\
            <value><boolean>0</boolean></value></data></array></value>\n</param>\n</params>\n</methodResponse>\n";
        let values = [Value::Int(1), "".into(), Value::Nil, Value::Bool(false)];
        assert_eq!(
            parse_response(python.as_bytes()).unwrap(),
            Response::Value(Value::Array(values.to_vec()))
        );
        let roscpp = "<?xml version=\"1.0\"?>\r\n<methodCall><methodName>requestTopic</methodName>\r\n\
            <params><param><value>/me</value></param><param><value><i4>5</i4></value></param><param><value/></param>\
            <param><value><string>&lt;&#x41;&#66;<!-- no --><![CDATA[<&]]></string></value></param></params></methodCall>\r\n";
        let (method, params) = parse_call(roscpp.as_bytes()).unwrap();
        assert_eq!(method, "requestTopic");
        assert_eq!(
            params,
            ["/me".into(), Value::Int(5), "".into(), "<AB<&".into()]
        );
    }

    #[test]
    fn values_that_nest_too_deep_are_refused() {
        let deep = "<value><array><data>".repeat(100_000);
        let text = format!("<methodResponse><params><param>{deep}");
        assert_eq!(
            parse_response(text.as_bytes()),
            Err(ReadError::TooDeep { most: DEPTH })
        );
    }

    #[test]
    fn no_damage_panics() {
        let text = call("m", &[sample()]);
        let bytes = text.as_bytes();
        crate::damage::damage(bytes, |damaged| {
            let _ = parse_call(damaged);
            let _ = parse_response(damaged);
        });
        for end in 0..bytes.len() - "</methodCall>".len() {
            assert!(parse_call(&bytes[..end]).is_err(), "{end}");
        }
    }
}
