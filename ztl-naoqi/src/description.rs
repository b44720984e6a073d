//! Reads the description of an object.

use crate::meta_object::{Member, MetaObject, Method};
use crate::signature::{Names, Signature, Tuple};
use crate::value::Value;

/// The longest name or signature, in bytes.
const LONGEST_TEXT: usize = 8 << 10;

impl MetaObject {
    /// The signature of descriptions.
    pub(crate) fn signature() -> Signature {
        let tuple = |fields| {
            Signature::Tuple(Tuple {
                fields,
                names: Names::default(),
            })
        };
        let by_number = |value| {
            let id = Signature::Integer {
                bytes: 4,
                signed: false,
            };
            Signature::Map(Box::new((id, value)))
        };
        let id = || Signature::Integer {
            bytes: 4,
            signed: false,
        };
        use Signature::Text;
        let parameters = Signature::List(Box::new(tuple(vec![Text, Text])));
        let method = tuple(vec![id(), Text, Text, Text, Text, parameters, Text]);
        let member = || by_number(tuple(vec![id(), Text, Text]));
        tuple(vec![by_number(method), member(), member(), Text])
    }

    /// Takes a decoded description.
    pub(crate) fn from_value(value: &Value) -> Option<Self> {
        let entries = |place| match value.field("", place)? {
            Value::Map(entries) => Some(entries.iter().map(|(_, value)| value)),
            _ => None,
        };
        let text = |value: &Value, place| {
            let text = value.field("", place)?.as_text()?;
            // A parsed signature takes many times its length.
            (text.len() <= LONGEST_TEXT).then(|| text.to_owned())
        };
        let member = |value: &Value| {
            Some(Member {
                id: value.field("", 0)?.as_u32()?,
                name: text(value, 1)?,
                signature: text(value, 2)?,
            })
        };
        let methods = entries(0)?.map(|value| {
            Some(Method {
                id: value.field("", 0)?.as_u32()?,
                returns: text(value, 1)?,
                name: text(value, 2)?,
                parameters: text(value, 3)?,
            })
        });
        Some(Self {
            methods: methods.collect::<Option<_>>()?,
            signals: entries(1)?.map(member).collect::<Option<_>>()?,
            properties: entries(2)?.map(member).collect::<Option<_>>()?,
        })
    }
}
