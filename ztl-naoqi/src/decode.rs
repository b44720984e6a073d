//! Reads values: bytes whose signature is known.

use std::fmt;
use std::sync::Arc;

use crate::Limits;
use crate::meta_object::{MetaObject, Object};
use crate::signature::{Signature, SignatureError};
use crate::value::{Value, unsigned};

/// Why bytes are not a value of a signature.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum DecodeError {
    /// They end within a value.
    Truncated {
        /// The length in bytes.
        length: usize,
    },
    /// Bytes follow the value.
    Trailing {
        /// How many bytes follow.
        count: usize,
    },
    /// More values than the limit.
    TooMany {
        /// The limit.
        most: usize,
    },
    /// More levels than the limit.
    TooDeep,
    /// A dynamic value has a signature that cannot be read.
    Signature {
        /// Where it begins, in bytes.
        at: usize,
        /// What is wrong with it.
        error: SignatureError,
    },
    /// A dynamic value's signature exceeds the limit.
    LongSignature,
    /// Values of this type cannot be sent.
    Unknown,
    /// An object does not describe itself as expected.
    Object,
}

impl fmt::Display for DecodeError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Truncated { length } => write!(f, "it ends within a value, at byte {length}"),
            Self::Trailing { count } => write!(f, "{count} bytes follow the value"),
            Self::TooMany { most } => write!(f, "it contains more than {most} values"),
            Self::TooDeep => f.write_str("it is nested too deep"),
            Self::Signature { at, error } => {
                write!(f, "the signature at byte {at} is malformed: {error}")
            }
            Self::LongSignature => f.write_str("it contains a signature that is too long"),
            Self::Unknown => f.write_str("it contains a value of an unknown type"),
            Self::Object => f.write_str("it contains an object that does not describe itself"),
        }
    }
}

impl std::error::Error for DecodeError {}

/// Reads a value that takes all bytes.
///
/// # Errors
/// [`DecodeError`] if the bytes are not a value of this signature, or exceed a limit.
pub fn decode(bytes: &[u8], signature: &Signature, limits: &Limits) -> Result<Value, DecodeError> {
    let most = limits.values.min(bytes.len().saturating_add(64));
    let mut reader = Reader {
        bytes,
        at: 0,
        left: most,
        most,
        limits,
    };
    let value = reader.value(signature, limits.depth)?;
    match reader.rest().len() {
        0 => Ok(value),
        count => Err(DecodeError::Trailing { count }),
    }
}

struct Reader<'b> {
    bytes: &'b [u8],
    at: usize,
    /// How many values may follow.
    left: usize,
    most: usize,
    limits: &'b Limits,
}

impl<'b> Reader<'b> {
    fn rest(&self) -> &'b [u8] {
        self.bytes.get(self.at..).unwrap_or_default()
    }

    fn take(&mut self, count: usize) -> Result<&'b [u8], DecodeError> {
        let taken = self.rest().get(..count).ok_or(DecodeError::Truncated {
            length: self.bytes.len(),
        })?;
        self.at += count;
        Ok(taken)
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N], DecodeError> {
        let taken = self.take(N)?.first_chunk().copied();
        taken.ok_or(DecodeError::Truncated {
            length: self.bytes.len(),
        })
    }

    fn u32(&mut self) -> Result<u32, DecodeError> {
        Ok(u32::from_le_bytes(self.array()?))
    }

    /// A length, and as many bytes.
    fn counted(&mut self) -> Result<&'b [u8], DecodeError> {
        let count = self.u32()?;
        self.take(usize::try_from(count).unwrap_or(usize::MAX))
    }

    /// Accounts for values before memory is allocated for them.
    fn charge(&mut self, count: usize) -> Result<(), DecodeError> {
        let too_many = DecodeError::TooMany { most: self.most };
        self.left = self.left.checked_sub(count).ok_or(too_many)?;
        Ok(())
    }

    /// A count of elements that take `each` values.
    fn count(&mut self, each: usize) -> Result<usize, DecodeError> {
        let count = usize::try_from(self.u32()?).unwrap_or(usize::MAX);
        self.charge(count.saturating_mul(each))?;
        Ok(count)
    }

    fn value(&mut self, signature: &Signature, depth: usize) -> Result<Value, DecodeError> {
        let depth = depth.checked_sub(1).ok_or(DecodeError::TooDeep)?;
        Ok(match signature {
            Signature::Void => Value::Nothing,
            Signature::Bool => Value::Bool(self.array::<1>()? != [0]),
            Signature::Integer { bytes, signed } => self.integer(*bytes, *signed)?,
            Signature::Float => Value::Float(f32::from_le_bytes(self.array()?)),
            Signature::Double => Value::Double(f64::from_le_bytes(self.array()?)),
            Signature::Text => Value::Text(String::from_utf8_lossy(self.counted()?).into_owned()),
            Signature::Raw => Value::Raw(self.counted()?.to_vec()),
            Signature::Dynamic => {
                let at = self.at;
                let text = self.counted()?;
                if text.len() > self.limits.signature {
                    return Err(DecodeError::LongSignature);
                }
                let text = String::from_utf8_lossy(text);
                // An empty signature stands for no value.
                if text.is_empty() {
                    return Ok(Value::Nothing);
                }
                let inner = Signature::parse(&text, depth)
                    .map_err(|error| DecodeError::Signature { at, error })?;
                self.value(&inner, depth)?
            }
            Signature::Object => self.object(depth)?,
            Signature::Unknown => return Err(DecodeError::Unknown),
            Signature::List(element) => {
                let count = self.count(1)?;
                let mut items = Vec::with_capacity(count);
                for _ in 0..count {
                    items.push(self.value(element, depth)?);
                }
                Value::List(items)
            }
            Signature::Map(entry) => {
                let count = self.count(2)?;
                let mut entries = Vec::with_capacity(count);
                for _ in 0..count {
                    let key = self.value(&entry.0, depth)?;
                    entries.push((key, self.value(&entry.1, depth)?));
                }
                Value::Map(entries)
            }
            Signature::Tuple(tuple) => {
                self.charge(tuple.fields.len())?;
                let fields = tuple.fields.iter();
                let fields: Result<_, _> = fields.map(|field| self.value(field, depth)).collect();
                Value::Tuple(Arc::clone(&tuple.names), fields?)
            }
            Signature::Optional(inner) => match self.array::<1>()? {
                [0] => Value::Nothing,
                _ => self.value(inner, depth)?,
            },
        })
    }

    fn integer(&mut self, bytes: u8, signed: bool) -> Result<Value, DecodeError> {
        Ok(match (bytes, signed) {
            (1, true) => Value::Integer(i8::from_le_bytes(self.array()?).into()),
            (1, false) => Value::Integer(u8::from_le_bytes(self.array()?).into()),
            (2, true) => Value::Integer(i16::from_le_bytes(self.array()?).into()),
            (2, false) => Value::Integer(u16::from_le_bytes(self.array()?).into()),
            (4, true) => Value::Integer(i32::from_le_bytes(self.array()?).into()),
            (4, false) => Value::Integer(self.u32()?.into()),
            (_, true) => Value::Integer(i64::from_le_bytes(self.array()?)),
            (_, false) => unsigned(u64::from_le_bytes(self.array()?)),
        })
    }

    /// An object: its description, its service and its number there.
    fn object(&mut self, depth: usize) -> Result<Value, DecodeError> {
        let meta = self.value(&MetaObject::signature(), depth)?;
        let meta = MetaObject::from_value(&meta).ok_or(DecodeError::Object)?;
        Ok(Value::Object(Arc::new(Object {
            meta,
            service: self.u32()?,
            object: self.u32()?,
        })))
    }
}
