//! serde's calls, written as Python writes the value.

use core::fmt::{self, Write as _};

use serde::ser::{self, Serialize, Serializer};

use super::MAX_DEPTH;
use super::error::WriteError;
use super::floats::{Decimal, Floats};
use crate::repr::put_quoted;
use crate::sink::Sink;

type Result = core::result::Result<(), WriteError>;

/// Writes one value.
pub(super) struct Writer<'s, S: ?Sized, F> {
    sink: &'s mut S,
    floats: F,
    /// Collections that are open here.
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

    /// Writes a text: a result's whole text as it is, within a collection in quotes.
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

    fn close(&mut self, bracket: &[u8]) {
        self.depth -= 1;
        self.sink.put(bracket);
    }

    fn items(&mut self, open: &[u8], close: &'static [u8]) -> Started<'_, 's, S, F> {
        self.open(open)?;
        Ok(Items {
            writer: self,
            first: true,
            close,
        })
    }

    /// Begins `{'variant': value}`.
    fn variant(&mut self, variant: &str) -> Result {
        self.open(b"{")?;
        self.text(variant)?;
        self.sink.put(b": ");
        Ok(())
    }
}

macro_rules! integers {
    ($($method:ident $type:ty)*) => {
        $(fn $method(self, value: $type) -> Result {
            #[expect(unused_comparisons, reason = "some of the types have no sign")]
            if value < 0 {
                self.sink.put(b"-");
            }
            self.sink.put(Decimal::of(i128::from(value).unsigned_abs() as u64).digits());
            Ok(())
        })*
    };
}

type Started<'w, 's, S, F> = core::result::Result<Items<'w, 's, S, F>, WriteError>;

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
}
