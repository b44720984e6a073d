//! The serde serializer: writes values as Python does.

use core::fmt::Display;

use serde::ser::{self, Serialize, Serializer};

use super::decimal::Whole;
use super::display::{put_display, put_quoted_display};
use super::error::{MAX_DEPTH, WriteError};
use super::floats::Floats;
use crate::repr::put_quoted;
use crate::sink::Sink;

type Result = core::result::Result<(), WriteError>;

/// Writes one value.
pub(super) struct Writer<'s, S: ?Sized, F> {
    sink: &'s mut S,
    floats: F,
    /// Number of open collections.
    depth: u8,
}

impl<'s, S: Sink + ?Sized, F: Floats> Writer<'s, S, F> {
    pub(super) fn new(sink: &'s mut S, floats: F) -> Self {
        Self {
            sink,
            floats,
            depth: 0,
        }
    }

    /// Writes a text: unquoted at the top, quoted within a collection.
    fn text(&mut self, text: &str) -> Result {
        if self.depth == 0 {
            self.sink.put(text.as_bytes());
        } else {
            put_quoted(text, self.sink);
        }
        Ok(())
    }

    fn open(&mut self, bracket: &[u8]) -> Result {
        if self.depth == MAX_DEPTH {
            return Err(WriteError::TooDeep);
        }
        self.depth += 1;
        self.sink.put(bracket);
        Ok(())
    }

    /// Closes one collection for each bracket.
    fn close(&mut self, brackets: &[u8]) -> Result {
        self.depth = self.depth.saturating_sub(brackets.len() as u8);
        self.sink.put(brackets);
        Ok(())
    }

    /// Begins `{'variant': value}`.
    fn variant(&mut self, variant: &str) -> Result {
        self.open(b"{")?;
        self.name(variant);
        self.sink.put(b": ");
        Ok(())
    }

    /// Writes a name from the firmware's source without checking which characters are printable: that table
    /// takes 2.7 KB of flash.
    fn name(&mut self, name: &str) {
        self.sink.put(b"'");
        for part in name.split_inclusive(['\'', '\\']) {
            let plain = part.trim_end_matches(['\'', '\\']);
            self.sink.put(plain.as_bytes());
            if plain.len() < part.len() {
                self.sink.put(b"\\");
                self.sink
                    .put(part.as_bytes().get(plain.len()..).unwrap_or_default());
            }
        }
        self.sink.put(b"'");
    }
}

/// A collection that is being written.
pub(super) struct Items<'w, 's, S: ?Sized, F> {
    writer: &'w mut Writer<'s, S, F>,
    first: bool,
    close: &'static [u8],
}

type Started<'w, 's, S, F> = core::result::Result<Items<'w, 's, S, F>, WriteError>;

impl<'w, 's, S: Sink + ?Sized, F: Floats> Items<'w, 's, S, F> {
    fn new(
        writer: &'w mut Writer<'s, S, F>,
        open: &[u8],
        close: &'static [u8],
    ) -> Started<'w, 's, S, F> {
        writer.open(open)?;
        Ok(Self {
            writer,
            first: true,
            close,
        })
    }

    fn comma(&mut self) {
        if !self.first {
            self.writer.sink.put(b", ");
        }
        self.first = false;
    }

    fn item<T: Serialize + ?Sized>(&mut self, value: &T) -> Result {
        self.comma();
        value.serialize(&mut *self.writer)
    }

    fn value<T: Serialize + ?Sized>(&mut self, value: &T) -> Result {
        self.writer.sink.put(b": ");
        value.serialize(&mut *self.writer)
    }

    fn field<T: Serialize + ?Sized>(&mut self, name: &str, value: &T) -> Result {
        self.comma();
        self.writer.name(name);
        self.value(value)
    }

    fn finish(self) -> Result {
        self.writer.close(self.close)
    }
}

macro_rules! as_i64 {
    ($($method:ident $type:ty)*) => {
        $(fn $method(self, value: $type) -> Result {
            self.serialize_i64(value.into())
        })*
    };
}

macro_rules! as_u64 {
    ($($method:ident $type:ty)*) => {
        $(fn $method(self, value: $type) -> Result {
            self.serialize_u64(value.into())
        })*
    };
}

impl<'w, 's, S: Sink + ?Sized, F: Floats> Serializer for &'w mut Writer<'s, S, F> {
    type Ok = ();
    type Error = WriteError;
    type SerializeSeq = Items<'w, 's, S, F>;
    type SerializeTuple = Items<'w, 's, S, F>;
    type SerializeTupleStruct = Items<'w, 's, S, F>;
    type SerializeTupleVariant = Items<'w, 's, S, F>;
    type SerializeMap = Items<'w, 's, S, F>;
    type SerializeStruct = Items<'w, 's, S, F>;
    type SerializeStructVariant = Items<'w, 's, S, F>;

    fn serialize_bool(self, value: bool) -> Result {
        self.sink.put(if value { b"True" } else { b"False" });
        Ok(())
    }

    as_i64! { serialize_i8 i8 serialize_i16 i16 serialize_i32 i32 }
    as_u64! { serialize_u8 u8 serialize_u16 u16 serialize_u32 u32 }

    fn serialize_i64(self, value: i64) -> Result {
        if value < 0 {
            self.sink.put(b"-");
        }
        self.serialize_u64(value.unsigned_abs())
    }

    fn serialize_u64(self, value: u64) -> Result {
        self.sink.put(Whole::of(value).digits());
        Ok(())
    }

    fn serialize_f32(self, value: f32) -> Result {
        self.floats.put_f32(value, self.sink);
        Ok(())
    }

    fn serialize_f64(self, value: f64) -> Result {
        self.floats.put_f64(value, self.sink);
        Ok(())
    }

    fn serialize_char(self, value: char) -> Result {
        self.text(value.encode_utf8(&mut [0; 4]))
    }

    fn serialize_str(self, value: &str) -> Result {
        self.text(value)
    }

    fn serialize_bytes(self, value: &[u8]) -> Result {
        self.collect_seq(value)
    }

    fn serialize_none(self) -> Result {
        self.serialize_unit()
    }

    fn serialize_some<T: Serialize + ?Sized>(self, value: &T) -> Result {
        value.serialize(self)
    }

    fn serialize_unit(self) -> Result {
        self.sink.put(b"None");
        Ok(())
    }

    fn serialize_unit_struct(self, _: &str) -> Result {
        self.serialize_unit()
    }

    fn serialize_unit_variant(self, _: &str, _: u32, variant: &str) -> Result {
        if self.depth == 0 {
            self.sink.put(variant.as_bytes());
        } else {
            self.name(variant);
        }
        Ok(())
    }

    fn serialize_newtype_struct<T: Serialize + ?Sized>(self, _: &str, value: &T) -> Result {
        value.serialize(self)
    }

    fn serialize_newtype_variant<T: Serialize + ?Sized>(
        self,
        _: &str,
        _: u32,
        variant: &str,
        value: &T,
    ) -> Result {
        self.variant(variant)?;
        value.serialize(&mut *self)?;
        self.close(b"}")
    }

    fn serialize_seq(self, _: Option<usize>) -> Started<'w, 's, S, F> {
        Items::new(self, b"[", b"]")
    }

    fn serialize_tuple(self, _: usize) -> Started<'w, 's, S, F> {
        Items::new(self, b"[", b"]")
    }

    fn serialize_tuple_struct(self, _: &str, _: usize) -> Started<'w, 's, S, F> {
        Items::new(self, b"[", b"]")
    }

    fn serialize_tuple_variant(
        self,
        _: &str,
        _: u32,
        variant: &str,
        _: usize,
    ) -> Started<'w, 's, S, F> {
        self.variant(variant)?;
        Items::new(self, b"[", b"]}")
    }

    fn serialize_map(self, _: Option<usize>) -> Started<'w, 's, S, F> {
        Items::new(self, b"{", b"}")
    }

    fn serialize_struct(self, _: &str, _: usize) -> Started<'w, 's, S, F> {
        Items::new(self, b"{", b"}")
    }

    fn serialize_struct_variant(
        self,
        _: &str,
        _: u32,
        variant: &str,
        _: usize,
    ) -> Started<'w, 's, S, F> {
        self.variant(variant)?;
        Items::new(self, b"{", b"}}")
    }

    fn collect_str<T: Display + ?Sized>(self, value: &T) -> Result {
        let written = if self.depth == 0 {
            put_display(value, self.sink)
        } else {
            put_quoted_display(value, self.sink)
        };
        written.map_err(|_| WriteError::Refused)
    }
}

macro_rules! items {
    ($($trait:ident $method:ident)*) => {
        $(impl<S: Sink + ?Sized, F: Floats> ser::$trait for Items<'_, '_, S, F> {
            type Ok = ();
            type Error = WriteError;

            fn $method<T: Serialize + ?Sized>(&mut self, value: &T) -> Result {
                self.item(value)
            }

            fn end(self) -> Result {
                self.finish()
            }
        })*
    };
}

items! {
    SerializeSeq serialize_element
    SerializeTuple serialize_element
    SerializeTupleStruct serialize_field
    SerializeTupleVariant serialize_field
}

macro_rules! fields {
    ($($trait:ident)*) => {
        $(impl<S: Sink + ?Sized, F: Floats> ser::$trait for Items<'_, '_, S, F> {
            type Ok = ();
            type Error = WriteError;

            fn serialize_field<T: Serialize + ?Sized>(&mut self, name: &'static str, value: &T) -> Result {
                self.field(name, value)
            }

            fn end(self) -> Result {
                self.finish()
            }
        })*
    };
}

fields! { SerializeStruct SerializeStructVariant }

impl<S: Sink + ?Sized, F: Floats> ser::SerializeMap for Items<'_, '_, S, F> {
    type Ok = ();
    type Error = WriteError;

    fn serialize_key<T: Serialize + ?Sized>(&mut self, key: &T) -> Result {
        self.item(key)
    }

    fn serialize_value<T: Serialize + ?Sized>(&mut self, value: &T) -> Result {
        self.value(value)
    }

    fn end(self) -> Result {
        self.finish()
    }
}
