//! The values in a message, in defmt's wire format.

use defmt_parser::{Fragment, Parameter, ParserMode, Type};

use super::table::Table;

/// Deepest nesting of values.
const DEPTH: usize = 16;
/// Most values in a message.
const VALUES: usize = 4096;

/// A value in a message.
#[derive(Debug)]
pub(super) enum Arg<'t> {
    Bool(bool),
    Single(f32),
    Double(f64),
    Unsigned(u128),
    /// With its width in bits.
    Signed(i128, u32),
    Text(String),
    Bytes(Vec<u8>),
    /// A text with values of its own.
    Part(Part<'t>),
    /// Parts without separators.
    Parts(Vec<Part<'t>>),
    /// Parts in brackets.
    List(Vec<Part<'t>>),
}

/// A format string and its values.
#[derive(Debug)]
pub(super) struct Part<'t> {
    pub(super) format: &'t str,
    pub(super) args: Vec<Arg<'t>>,
}

/// Reads the values of a message. Missing or malformed values give `None`.
pub(super) struct Reader<'t, 'b> {
    table: &'t Table,
    bytes: &'b [u8],
    depth: usize,
    values: usize,
}

impl<'t, 'b> Reader<'t, 'b> {
    pub(super) const fn new(table: &'t Table, bytes: &'b [u8]) -> Self {
        Self {
            table,
            bytes,
            depth: 0,
            values: 0,
        }
    }

    /// Number of bytes left.
    pub(super) const fn left(&self) -> usize {
        self.bytes.len()
    }

    /// The number of a format string.
    pub(super) fn number(&mut self) -> Option<u16> {
        let bytes = self.take(2)?;
        Some(u16::from_le_bytes(bytes.try_into().ok()?))
    }

    /// The values of a format string, ordered by index.
    pub(super) fn args(&mut self, format: &str) -> Option<Vec<Arg<'t>>> {
        if self.depth >= DEPTH {
            return None;
        }
        self.depth += 1;
        let args = self.args_of(format);
        self.depth -= 1;
        args
    }

    fn args_of(&mut self, format: &str) -> Option<Vec<Arg<'t>>> {
        let types = types(format)?;
        let mut args = Vec::new();
        for of in types {
            self.values += 1;
            if self.values > VALUES {
                return None;
            }
            args.push(self.arg(&of)?);
        }
        Some(args)
    }

    fn arg(&mut self, of: &Type) -> Option<Arg<'t>> {
        Some(match of {
            Type::U8 => Arg::Unsigned(self.unsigned(1)?),
            Type::U16 => Arg::Unsigned(self.unsigned(2)?),
            Type::U32 | Type::Usize => Arg::Unsigned(self.unsigned(4)?),
            Type::U64 => Arg::Unsigned(self.unsigned(8)?),
            Type::U128 => Arg::Unsigned(self.unsigned(16)?),
            Type::I8 => self.signed(1)?,
            Type::I16 => self.signed(2)?,
            Type::I32 | Type::Isize => self.signed(4)?,
            Type::I64 => self.signed(8)?,
            Type::I128 => self.signed(16)?,
            Type::F32 => Arg::Single(f32::from_le_bytes(self.take(4)?.try_into().ok()?)),
            Type::F64 => Arg::Double(f64::from_le_bytes(self.take(8)?.try_into().ok()?)),
            Type::Bool => Arg::Bool(match self.unsigned(1)? {
                0 => false,
                1 => true,
                _ => return None,
            }),
            Type::Char => {
                let code = u32::try_from(self.unsigned(4)?).ok()?;
                Arg::Text(char::from_u32(code)?.to_string())
            }
            Type::Str => {
                let len = self.length()?;
                let bytes = self.take(len)?;
                Arg::Text(std::str::from_utf8(bytes).ok()?.to_owned())
            }
            Type::IStr => {
                let number = self.number()?;
                Arg::Text(self.table.part(number)?.to_owned())
            }
            Type::U8Slice => {
                let len = self.length()?;
                Arg::Bytes(self.take(len)?.to_vec())
            }
            Type::U8Array(len) => Arg::Bytes(self.take(*len)?.to_vec()),
            // Formatted by `core::fmt` on the device; ends with a byte that never occurs in UTF-8.
            Type::Debug | Type::Display => {
                let len = self.bytes.iter().position(|byte| *byte == 0xff)?;
                let text = std::str::from_utf8(self.take(len)?).ok()?.to_owned();
                self.take(1)?;
                Arg::Text(text)
            }
            Type::BitField(range) => {
                let first = range.start / 8;
                let bytes = range.end.checked_sub(1)? / 8 - first + 1;
                let bytes = usize::from(bytes).next_power_of_two();
                let value = self.unsigned(bytes)?;
                Arg::Unsigned(value.checked_shl(u32::from(first) * 8)?)
            }
            Type::Format => {
                let number = self.number()?;
                Arg::Part(self.part(number)?)
            }
            Type::FormatSlice => {
                let len = self.length()?;
                Arg::List(self.list(len)?)
            }
            Type::FormatArray(len) => Arg::List(self.list(*len)?),
            Type::FormatSequence => {
                let mut parts = Vec::new();
                loop {
                    match self.number()? {
                        0 => break Arg::Parts(parts),
                        number => {
                            let format = self.table.part(number)?;
                            let args = self.args(format)?;
                            parts.push(Part { format, args });
                        }
                    }
                }
            }
        })
    }

    fn part(&mut self, number: u16) -> Option<Part<'t>> {
        let format = self.table.part(number)?;
        let format = self.variant(format)?;
        let args = self.args(format)?;
        Some(Part { format, args })
    }

    fn list(&mut self, len: usize) -> Option<Vec<Part<'t>>> {
        let number = self.number()?;
        let format = self.table.part(number)?;
        let mut parts = Vec::new();
        for _ in 0..len {
            self.values += 1;
            if self.values > VALUES {
                return None;
            }
            let format = self.variant(format)?;
            let args = self.args(format)?;
            parts.push(Part { format, args });
        }
        Some(parts)
    }

    /// Chooses among `A|B`, the variants of an enum, by the next bytes.
    fn variant(&mut self, format: &'t str) -> Option<&'t str> {
        let others = format.matches('|').count();
        if others == 0 {
            return Some(format);
        }
        let bytes = match others {
            0..=0xff => 1,
            0x100..=0xffff => 2,
            _ => 4,
        };
        let chosen = usize::try_from(self.unsigned(bytes)?).ok()?;
        format.split('|').nth(chosen)
    }

    fn take(&mut self, count: usize) -> Option<&'b [u8]> {
        let (taken, rest) = self.bytes.split_at_checked(count)?;
        self.bytes = rest;
        Some(taken)
    }

    fn length(&mut self) -> Option<usize> {
        usize::try_from(self.unsigned(4)?).ok()
    }

    fn unsigned(&mut self, count: usize) -> Option<u128> {
        let mut bytes = [0; 16];
        bytes.get_mut(..count)?.copy_from_slice(self.take(count)?);
        Some(u128::from_le_bytes(bytes))
    }

    fn signed(&mut self, count: usize) -> Option<Arg<'t>> {
        let bits = u32::try_from(count * 8).ok()?;
        let value = self.unsigned(count)?;
        // Extends the sign to 128 bits.
        let away = 128 - bits;
        let value = (value << away).cast_signed() >> away;
        Some(Arg::Signed(value, bits))
    }
}

/// The fragments of a format string.
pub(super) fn fragments(format: &str) -> Option<Vec<Fragment<'_>>> {
    defmt_parser::parse(format, ParserMode::ForwardsCompatible).ok()
}

/// The types of the values of a format string in the order they are sent: one per index. Several bit fields
/// of one value give a single type.
fn types(format: &str) -> Option<Vec<Type>> {
    let mut types: Vec<(usize, Type)> = Vec::new();
    for fragment in fragments(format)? {
        let Fragment::Parameter(Parameter { index, ty, .. }) = fragment else {
            continue;
        };
        match types.iter_mut().find(|(known, _)| *known == index) {
            Some((_, Type::BitField(known))) => {
                if let Type::BitField(more) = ty {
                    *known = known.start.min(more.start)..known.end.max(more.end);
                }
            }
            Some(_) => {}
            None => types.push((index, ty)),
        }
    }
    types.sort_by_key(|(index, _)| *index);
    // Without gaps, so that an index finds its value.
    let whole = types
        .iter()
        .enumerate()
        .all(|(place, (index, _))| place == *index);
    whole.then(|| types.into_iter().map(|(_, of)| of).collect())
}
