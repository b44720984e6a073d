//! serde's calls, answered from a goal's text.

use serde::de::{DeserializeSeed, Deserializer, Visitor};

use super::access::{Items, Lone};
use super::error::{Expected, GoalError, GoalErrorKind};
use super::number::{Number, OutOfRange, Whole};
use super::reader::Reader;

type Result<T> = core::result::Result<T, GoalError>;

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

/// What the original's YAML reads as a bool too, but which may as well be a text.
fn word_to_bool(text: &str) -> Option<bool> {
    match text {
        "yes" | "Yes" | "YES" | "on" | "On" | "ON" => Some(true),
        "no" | "No" | "NO" | "off" | "Off" | "OFF" => Some(false),
        _ => None,
    }
}

impl<'de> Reader<'de> {
    /// Reads one value, and gives its place to an error that has none.
    pub(super) fn value<S: DeserializeSeed<'de>>(&mut self, seed: S) -> Result<S::Value> {
        self.skip_blanks();
        let at = self.at();
        seed.deserialize(self).map_err(|error| error.or_at(at))
    }

    /// Reads one key, likewise, and remembers where it begins.
    pub(super) fn key<S: DeserializeSeed<'de>>(&mut self, seed: S) -> Result<S::Value> {
        let at = self.begin_key();
        seed.deserialize(self).map_err(|error| error.or_at(at))
    }

    /// Reads a plain text that `read` takes.
    fn scalar<T>(&mut self, expected: Expected, read: impl FnOnce(&str) -> Option<T>) -> Result<T> {
        self.skip_blanks();
        let at = self.at();
        // What is no plain text at all is no such value either.
        let text = self.plain().unwrap_or_default();
        read(text).ok_or(GoalError::expected(at, expected))
    }

    fn whole_number(&mut self) -> Result<Whole> {
        let whole = self.scalar(Expected::Integer, |text| Number::parse(text)?.whole())?;
        whole.map_err(unplaced)
    }

    /// Reads a number, also in quotes: YAML 1.1 takes `1e3` for a text, so that the original sends
    /// `'1e3'` for it.
    fn number(&mut self) -> Result<Number> {
        if self.is_quote() {
            let at = self.at();
            let text = self.quoted()?;
            return Number::parse(text).ok_or(GoalError::expected(at, Expected::Number));
        }
        self.scalar(Expected::Number, Number::parse)
    }

    fn is_quote(&mut self) -> bool {
        matches!(self.skip_blanks(), Some(b'\'' | b'"'))
    }

    /// Reads a text: a goal's whole text as it is, within a collection one with or without quotes.
    fn text(&mut self) -> Result<&'de str> {
        if self.is_top() {
            return Ok(self.whole());
        }
        self.name()
    }

    /// Reads a text with or without quotes.
    fn name(&mut self) -> Result<&'de str> {
        if self.is_quote() {
            return self.quoted();
        }
        if matches!(self.peek(), Some(b'[' | b'(' | b'{')) {
            return Err(GoalError::expected(self.at(), Expected::Text));
        }
        self.plain()
    }

    /// Reads `None`, and at the top nothing at all, if that is what comes next.
    fn take_none(&mut self) -> bool {
        self.skip_blanks();
        let start = self.at();
        let text = self.plain();
        let nothing = self.is_top() && text == Ok("");
        let none = nothing || text.is_ok_and(is_none);
        if !none {
            self.go_back(start);
        }
        none
    }

    fn sequence<V: Visitor<'de>>(&mut self, expected: Expected, visitor: V) -> Result<V::Value> {
        let Some(open) = self.open(b"[(")? else {
            return Err(GoalError::expected(self.at(), expected));
        };
        let mut items = Items::new(self, open);
        let value = visitor.visit_seq(&mut items)?;
        if items.more()? {
            return Err(GoalError::new(self.at(), GoalErrorKind::WrongLength));
        }
        self.close();
        Ok(value)
    }

    fn mapping<V: Visitor<'de>>(&mut self, expected: Expected, visitor: V) -> Result<V::Value> {
        let Some(open) = self.open(b"{")? else {
            return Err(GoalError::expected(self.at(), expected));
        };
        let mut items = Items::new(self, open);
        let value = visitor
            .visit_map(&mut items)
            .map_err(|error| match error.kind {
                // Found before the value is read, so the key is still the last.
                GoalErrorKind::DuplicateField(_) => error.or_at(items.reader.last_key()),
                _ => error,
            })?;
        if items.more()? {
            return Err(GoalError::new(self.at(), GoalErrorKind::WrongLength));
        }
        self.close();
        Ok(value)
    }
}

fn unplaced(_: OutOfRange) -> GoalError {
    GoalError::unplaced(GoalErrorKind::OutOfRange)
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
    type Error = GoalError;

    fn deserialize_any<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value> {
        match self.skip_blanks() {
            Some(b'[' | b'(') => return self.deserialize_seq(visitor),
            Some(b'{') => return self.deserialize_map(visitor),
            Some(b'\'' | b'"') => return visitor.visit_borrowed_str(self.quoted()?),
            _ => {}
        }
        let text = self.plain()?;
        if is_none(text) {
            return visitor.visit_unit();
        }
        if let Some(value) = to_bool(text) {
            return visitor.visit_bool(value);
        }
        match Number::parse(text) {
            Some(number) => match number.whole() {
                Some(Ok(Whole::Negative(value))) => visitor.visit_i64(value),
                Some(Ok(Whole::Positive(value))) => visitor.visit_u64(value),
                Some(Err(error)) => Err(unplaced(error)),
                None => visitor.visit_f64(number.to_f64().map_err(unplaced)?),
            },
            None if self.is_top() => visitor.visit_borrowed_str(self.whole()),
            None => visitor.visit_borrowed_str(text),
        }
    }

    fn deserialize_bool<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value> {
        let read = |text: &str| to_bool(text).or_else(|| word_to_bool(text));
        visitor.visit_bool(self.scalar(Expected::Bool, read)?)
    }

    integers! {
        deserialize_i8 deserialize_i16 deserialize_i32 deserialize_i64 deserialize_i128
        deserialize_u8 deserialize_u16 deserialize_u32 deserialize_u64 deserialize_u128
    }

    fn deserialize_f32<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value> {
        visitor.visit_f32(self.number()?.to_f32().map_err(unplaced)?)
    }

    fn deserialize_f64<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value> {
        visitor.visit_f64(self.number()?.to_f64().map_err(unplaced)?)
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
        match self.skip_blanks() {
            Some(b'[' | b'(') => self.deserialize_seq(visitor),
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
            return Err(GoalError::expected(self.at(), Expected::Nothing));
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
        self.sequence(Expected::Sequence, visitor)
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
        self.mapping(Expected::Mapping, visitor)
    }

    fn deserialize_struct<V: Visitor<'de>>(
        self,
        _: &str,
        _: &[&str],
        visitor: V,
    ) -> Result<V::Value> {
        match self.skip_blanks() {
            Some(b'{') => self.mapping(Expected::Struct, visitor),
            _ => self.sequence(Expected::Struct, visitor),
        }
    }

    fn deserialize_enum<V: Visitor<'de>>(
        self,
        _: &str,
        _: &[&str],
        visitor: V,
    ) -> Result<V::Value> {
        let Some(open) = self.open(b"{")? else {
            return visitor.visit_enum(Lone(self));
        };
        let mut entry = Items::new(self, open);
        if !entry.more()? {
            return Err(GoalError::expected(self.at(), Expected::VariantWithValue));
        }
        let value = visitor.visit_enum(&mut entry)?;
        if entry.more()? {
            return Err(GoalError::expected(self.at(), Expected::Close));
        }
        self.close();
        Ok(value)
    }

    fn deserialize_ignored_any<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value> {
        match self.skip_blanks() {
            Some(b'[' | b'(' | b'{') => return self.deserialize_any(visitor),
            // Nobody needs what is meant, so it needs no scratch.
            Some(b'\'' | b'"') => self.skip_quoted()?.inner,
            _ => self.plain()?,
        };
        visitor.visit_unit()
    }
}
