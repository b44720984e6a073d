//! The serde deserializer over a goal's text.

use serde::de::{DeserializeSeed, Deserializer, Visitor};

use super::access::{Items, Lone};
use super::decimal::{F32, F64, Format};
use super::error::{Error, Expected, Fault, GoalErrorKind};
use super::number::{Number, Whole};
use super::reader::Reader;

type Result<T, E = Error> = core::result::Result<T, E>;

fn is_none(text: &str) -> bool {
    matches!(text, "None" | "null" | "Null" | "NULL" | "~")
}

fn to_bool(text: &str) -> Option<bool> {
    match text {
        "True" | "true" | "TRUE" => Some(true),
        "False" | "false" | "FALSE" => Some(false),
        _ => None,
    }
}

/// Words that the original's YAML reads as a bool, but which may also be text.
fn word_to_bool(text: &str) -> Option<bool> {
    match text {
        "yes" | "Yes" | "YES" | "on" | "On" | "ON" => Some(true),
        "no" | "No" | "NO" | "off" | "Off" | "OFF" => Some(false),
        _ => None,
    }
}

impl<'de> Reader<'de> {
    /// Reads one value. An error without a position gets that of the value.
    pub(super) fn value<S: DeserializeSeed<'de>>(&mut self, seed: S) -> Result<S::Value> {
        self.placed(|reader| seed.deserialize(reader))
    }

    /// Reads one key in the same way, and stores where it begins.
    pub(super) fn key<S: DeserializeSeed<'de>>(&mut self, seed: S) -> Result<S::Value> {
        self.begin_key();
        self.value(seed)
    }

    /// Skips whitespace and reads what follows.
    pub(super) fn placed<T>(&mut self, read: impl FnOnce(&mut Self) -> Result<T>) -> Result<T> {
        self.text.skip_blanks();
        let at = self.text.at;
        let value = read(self);
        if let Err(Error::Serde(_)) = value {
            self.fail_at(at);
        }
        value
    }

    /// Reads a plain text and converts it with `read`.
    fn scalar<T>(&mut self, read: impl FnOnce(&str) -> Result<T, Fault>) -> Result<T, Fault> {
        let at = self.text.at;
        // A missing plain text fails in `read` as well.
        let value = read(self.plain());
        if value.is_err() {
            self.text.at = at;
        }
        value
    }

    fn whole_number(&mut self) -> Result<Whole, Fault> {
        self.scalar(|text| {
            let expected = Fault::Expected(Expected::Integer);
            let mut number = Number::ZERO;
            if !number.read(text) {
                return Err(expected);
            }
            number.whole().ok_or(expected)?.ok_or(Fault::OutOfRange)
        })
    }

    /// Reads a number as the bits of a float of this format. The number may be quoted: YAML 1.1 reads `1e3`
    /// as text, so the original sends `'1e3'`.
    fn float(&mut self, format: &Format) -> Result<u64, Fault> {
        let at = self.text.at;
        let text = if self.is_quote() {
            self.quoted()?
        } else {
            self.plain()
        };
        let mut number = Number::ZERO;
        let bits = if number.read(text) {
            number.nearest(format).ok_or(Fault::OutOfRange)
        } else {
            Err(Fault::Expected(Expected::Number))
        };
        if bits.is_err() {
            self.text.at = at;
        }
        bits
    }

    fn is_quote(&self) -> bool {
        matches!(self.text.peek(), b'\'' | b'"')
    }

    /// Reads a text: at the top the goal's whole text, within a collection a text with or without quotes.
    fn text(&mut self) -> Result<&'de str, Fault> {
        if self.is_top() {
            return Ok(self.whole());
        }
        self.name()
    }

    /// Reads a text with or without quotes.
    fn name(&mut self) -> Result<&'de str, Fault> {
        match self.text.peek() {
            b'\'' | b'"' => self.quoted(),
            b'[' | b'(' | b'{' => Err(Fault::Expected(Expected::Text)),
            _ => self.some_plain(),
        }
    }

    /// Reads a plain text that must not be empty.
    fn some_plain(&mut self) -> Result<&'de str, Fault> {
        let text = self.plain();
        if text.is_empty() && !self.is_top() {
            return Err(Fault::Expected(Expected::Value));
        }
        Ok(text)
    }

    /// Consumes `None`, or an empty goal at the top, if it comes next.
    fn take_none(&mut self) -> bool {
        let start = self.text.at;
        let text = self.plain();
        let none = is_none(text) || self.is_top() && text.is_empty();
        if !none {
            self.text.at = start;
        }
        none
    }

    /// Reads a sequence, a mapping, or either.
    fn collection<V: Visitor<'de>>(&mut self, expected: Expected, visitor: V) -> Result<V::Value> {
        let open = self.open(expected)?;
        let mut items = Items { reader: self, open };
        let value = if items.open.is_mapping() {
            visitor.visit_map(&mut items)
        } else {
            visitor.visit_seq(&mut items)
        };
        let Items { reader, open } = &mut items;
        match value {
            Ok(_) => reader.close(open)?,
            // serde reports this before it reads the value, so the key is still the last one.
            Err(Error::Serde(GoalErrorKind::DuplicateField(_))) => {
                reader.fail_at(reader.last_key())
            }
            Err(_) => {}
        }
        value
    }
}

macro_rules! integers {
    ($($method:ident)*) => {
        $(fn $method<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value> {
            match self.whole_number()? {
                Whole::Negative(value) => visitor.visit_i64(value),
                Whole::Positive(value) => visitor.visit_u64(value),
            }
        })*
    };
}

impl<'de> Deserializer<'de> for &mut Reader<'de> {
    type Error = Error;

    fn deserialize_any<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value> {
        match self.text.peek() {
            b'[' | b'(' | b'{' => return self.collection(Expected::Value, visitor),
            b'\'' | b'"' => return visitor.visit_borrowed_str(self.quoted()?),
            _ => {}
        }
        let at = self.text.at;
        let text = self.some_plain()?;
        if is_none(text) {
            return visitor.visit_unit();
        }
        if let Some(value) = to_bool(text) {
            return visitor.visit_bool(value);
        }
        let mut number = Number::ZERO;
        if !number.read(text) {
            let text = if self.is_top() { self.whole() } else { text };
            return visitor.visit_borrowed_str(text);
        }
        let float = match number.whole() {
            Some(Some(Whole::Negative(value))) => return visitor.visit_i64(value),
            Some(Some(Whole::Positive(value))) => return visitor.visit_u64(value),
            Some(None) => None,
            None => number.nearest(&F64),
        };
        let Some(bits) = float else {
            self.text.at = at;
            return Err(Fault::OutOfRange.into());
        };
        visitor.visit_f64(f64::from_bits(bits))
    }

    fn deserialize_bool<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value> {
        visitor.visit_bool(self.scalar(|text| {
            let value = to_bool(text).or_else(|| word_to_bool(text));
            value.ok_or(Fault::Expected(Expected::Bool))
        })?)
    }

    integers! {
        deserialize_i8 deserialize_i16 deserialize_i32 deserialize_i64 deserialize_i128
        deserialize_u8 deserialize_u16 deserialize_u32 deserialize_u64 deserialize_u128
    }

    fn deserialize_f32<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value> {
        visitor.visit_f32(f32::from_bits(self.float(&F32)? as u32))
    }

    fn deserialize_f64<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value> {
        visitor.visit_f64(f64::from_bits(self.float(&F64)?))
    }

    fn deserialize_char<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value> {
        self.deserialize_str(visitor)
    }

    fn deserialize_str<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value> {
        visitor.visit_borrowed_str(self.text()?)
    }

    fn deserialize_string<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value> {
        self.deserialize_str(visitor)
    }

    fn deserialize_identifier<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value> {
        visitor.visit_borrowed_str(self.name()?)
    }

    fn deserialize_bytes<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value> {
        match self.text.peek() {
            b'[' | b'(' => self.deserialize_seq(visitor),
            _ => self.deserialize_str(visitor),
        }
    }

    fn deserialize_byte_buf<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value> {
        self.deserialize_bytes(visitor)
    }

    fn deserialize_option<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value> {
        if self.take_none() {
            visitor.visit_none()
        } else {
            visitor.visit_some(self)
        }
    }

    fn deserialize_unit<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value> {
        if !self.take_none() {
            return Err(Fault::Expected(Expected::Nothing).into());
        }
        visitor.visit_unit()
    }

    fn deserialize_unit_struct<V: Visitor<'de>>(self, _: &str, visitor: V) -> Result<V::Value> {
        self.deserialize_unit(visitor)
    }

    fn deserialize_newtype_struct<V: Visitor<'de>>(self, _: &str, visitor: V) -> Result<V::Value> {
        visitor.visit_newtype_struct(self)
    }

    fn deserialize_seq<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value> {
        self.collection(Expected::Sequence, visitor)
    }

    fn deserialize_tuple<V: Visitor<'de>>(self, _: usize, visitor: V) -> Result<V::Value> {
        self.deserialize_seq(visitor)
    }

    fn deserialize_tuple_struct<V: Visitor<'de>>(
        self,
        _: &str,
        _: usize,
        visitor: V,
    ) -> Result<V::Value> {
        self.deserialize_seq(visitor)
    }

    fn deserialize_map<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value> {
        self.collection(Expected::Mapping, visitor)
    }

    fn deserialize_struct<V: Visitor<'de>>(
        self,
        _: &str,
        _: &[&str],
        visitor: V,
    ) -> Result<V::Value> {
        self.collection(Expected::Struct, visitor)
    }

    fn deserialize_enum<V: Visitor<'de>>(
        self,
        _: &str,
        _: &[&str],
        visitor: V,
    ) -> Result<V::Value> {
        if self.text.peek() != b'{' {
            return visitor.visit_enum(Lone(self));
        }
        let open = self.open(Expected::Mapping)?;
        let mut entry = Items { reader: self, open };
        if !entry.more()? {
            return Err(Fault::Expected(Expected::VariantWithValue).into());
        }
        let value = visitor.visit_enum(&mut entry)?;
        let Items { reader, open } = &mut entry;
        reader.close(open).map_err(|fault| match fault {
            Fault::WrongLength => Fault::Expected(Expected::Close),
            fault => fault,
        })?;
        Ok(value)
    }

    fn deserialize_ignored_any<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value> {
        match self.text.peek() {
            b'[' | b'(' | b'{' => return self.collection(Expected::Value, visitor),
            // The content is ignored, so it needs no scratch.
            b'\'' | b'"' => drop(self.skip_quoted()?),
            _ => drop(self.some_plain()?),
        }
        visitor.visit_unit()
    }
}
