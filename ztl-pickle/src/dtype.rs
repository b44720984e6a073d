//! The types of numpy's elements.

use std::fmt::{self, Display};

/// What the elements of an array are.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum ElementKind {
    /// `bool`, a byte.
    Bool,
    /// A signed integer of 1, 2, 4 or 8 bytes.
    Int,
    /// An unsigned integer of 1, 2, 4 or 8 bytes.
    UInt,
    /// A float of 2, 4 or 8 bytes.
    Float,
    /// Two floats of 4 or 8 bytes each.
    Complex,
    /// Bytes, with zeros at the end.
    Bytes,
    /// Text in UTF-32, with zeros at the end.
    Text,
}

use ElementKind::{Bool, Bytes, Complex, Float, Int, Text, UInt};

/// numpy's letter of each kind.
const LETTERS: [(u8, ElementKind); 7] = [
    (b'b', Bool),
    (b'i', Int),
    (b'u', UInt),
    (b'f', Float),
    (b'c', Complex),
    (b'S', Bytes),
    (b'U', Text),
];

/// The type of an array's elements, such as `float64`.
///
/// ```
/// use ztl_pickle::DType;
///
/// assert_eq!(DType::FLOAT64.to_string(), "float64");
/// assert_eq!(DType::new("i2").unwrap().big_endian().to_string(), ">i2");
/// assert_eq!(DType::new("O"), None);
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct DType {
    kind: ElementKind,
    big: bool,
    size: u32,
}

impl DType {
    /// `bool`.
    pub const BOOL: Self = Self::little(Bool, 1);
    /// `uint8`, as in images.
    pub const UINT8: Self = Self::little(UInt, 1);
    /// `int32`.
    pub const INT32: Self = Self::little(Int, 4);
    /// `int64`.
    pub const INT64: Self = Self::little(Int, 8);
    /// `float32`.
    pub const FLOAT32: Self = Self::little(Float, 4);
    /// `float64`.
    pub const FLOAT64: Self = Self::little(Float, 8);

    const fn little(kind: ElementKind, size: u32) -> Self {
        let big = false;
        Self { kind, big, size }
    }

    /// The type with numpy's code, such as `f8`: a letter, and its size in bytes (`U`: in characters). Elements have
    /// their lowest byte first.
    #[must_use]
    pub fn new(code: &str) -> Option<Self> {
        let (letter, digits) = code.as_bytes().split_first()?;
        let (_, kind) = LETTERS.into_iter().find(|(known, _)| known == letter)?;
        let plain =
            digits.first()?.is_ascii_digit() && (digits == b"0" || !digits.starts_with(b"0"));
        let number: u32 = code.get(1..).filter(|_| plain)?.parse().ok()?;
        let valid = match kind {
            Bool => number == 1,
            Int | UInt => matches!(number, 1 | 2 | 4 | 8),
            Float => matches!(number, 2 | 4 | 8),
            Complex => matches!(number, 8 | 16),
            Bytes | Text => number < 1 << 28,
        };
        let size = if kind == Text { number * 4 } else { number };
        valid.then_some(Self::little(kind, size))
    }

    /// The same type with the highest byte first.
    #[must_use]
    pub const fn big_endian(mut self) -> Self {
        self.big = self.has_order();
        self
    }

    /// What an element is.
    #[must_use]
    pub const fn kind(self) -> ElementKind {
        self.kind
    }

    /// The bytes of an element.
    #[must_use]
    pub const fn size(self) -> usize {
        self.size as usize
    }

    /// Whether elements have their highest byte first.
    #[must_use]
    pub const fn is_big_endian(self) -> bool {
        self.big
    }

    /// The same type in numpy's byte order: `<`, `>`, or `|` and `=`, which leave the order of this machine.
    pub(crate) const fn ordered(mut self, order: u8) -> Option<Self> {
        match order {
            b'>' => self.big = self.has_order(),
            b'<' | b'|' | b'=' => self.big = false,
            _ => return None,
        }
        Some(self)
    }

    const fn has_order(self) -> bool {
        match self.kind {
            Bytes => false,
            Text => true,
            _ => self.size > 1,
        }
    }

    /// numpy's letter of the byte order.
    pub(crate) const fn order(self) -> char {
        match (self.has_order(), self.big) {
            (false, _) => '|',
            (true, false) => '<',
            (true, true) => '>',
        }
    }

    /// numpy's code with the byte order, such as `<f8`, `>i2` or `|S5`.
    #[must_use]
    pub fn code(self) -> String {
        format!("{}{}", self.order(), self.short_code())
    }

    /// numpy's code without the order, such as `f8`.
    pub(crate) fn short_code(self) -> String {
        let letter = LETTERS.into_iter().find(|(_, kind)| *kind == self.kind);
        let letter = letter.map_or('?', |(letter, _)| letter.into());
        let size = if self.kind == Text {
            self.size / 4
        } else {
            self.size
        };
        format!("{letter}{size}")
    }

    /// The number at the start of `bytes`, of this size and order.
    fn bits<const N: usize>(self, bytes: &[u8]) -> Option<[u8; N]> {
        let mut bits: [u8; N] = *bytes.first_chunk()?;
        if self.big {
            bits.reverse();
        }
        Some(bits)
    }

    /// The element in these bytes.
    pub(crate) fn element(self, bytes: &[u8]) -> Option<Element<'_>> {
        let bytes = bytes.get(..self.size())?;
        Some(match (self.kind, self.size) {
            (Bool, _) => Element::Bool(bytes != [0]),
            (Int, 1) => Element::Int(i8::from_le_bytes(self.bits(bytes)?).into()),
            (Int, 2) => Element::Int(i16::from_le_bytes(self.bits(bytes)?).into()),
            (Int, 4) => Element::Int(i32::from_le_bytes(self.bits(bytes)?).into()),
            (Int, _) => Element::Int(i64::from_le_bytes(self.bits(bytes)?)),
            (UInt, 1) => Element::UInt(u8::from_le_bytes(self.bits(bytes)?).into()),
            (UInt, 2) => Element::UInt(u16::from_le_bytes(self.bits(bytes)?).into()),
            (UInt, 4) => Element::UInt(u32::from_le_bytes(self.bits(bytes)?).into()),
            (UInt, _) => Element::UInt(u64::from_le_bytes(self.bits(bytes)?)),
            (Float, size) => Element::Float(self.float(bytes, size)?),
            (Complex, size) => {
                let (real, imaginary) = bytes.split_at_checked(self.size() / 2)?;
                let float = |part| self.float(part, size / 2);
                Element::Complex(float(real)?, float(imaginary)?)
            }
            (Bytes, _) => {
                let end = bytes.iter().rposition(|byte| *byte != 0);
                let end = end.map_or(0, |last| last + 1);
                Element::Bytes(bytes.get(..end)?)
            }
            (Text, _) => {
                let codes = bytes.chunks_exact(4).filter_map(|code| self.bits(code));
                let codes = codes.map(u32::from_le_bytes);
                let chars = codes.map(|code| char::from_u32(code).unwrap_or('\u{fffd}'));
                let text: String = chars.collect();
                Element::Text(text.trim_end_matches('\0').to_owned())
            }
        })
    }

    fn float(self, bytes: &[u8], size: u32) -> Option<f64> {
        Some(match size {
            2 => half(u16::from_le_bytes(self.bits(bytes)?)),
            4 => f32::from_le_bytes(self.bits(bytes)?).into(),
            _ => f64::from_le_bytes(self.bits(bytes)?),
        })
    }
}

impl Display for DType {
    /// numpy's name, such as `float64`, `>i2`, `<U3`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let name = match self.kind {
            _ if self.big => "",
            Bool => return f.write_str("bool"),
            Int => "int",
            UInt => "uint",
            Float => "float",
            Complex => "complex",
            Bytes | Text => "",
        };
        match name {
            "" => f.write_str(&self.code()),
            name => write!(f, "{name}{}", self.size * 8),
        }
    }
}

/// An element of an array.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub enum Element<'a> {
    /// Of `bool`.
    Bool(bool),
    /// Of a signed integer.
    Int(i64),
    /// Of an unsigned integer.
    UInt(u64),
    /// Of a float.
    Float(f64),
    /// Real and imaginary part.
    Complex(f64, f64),
    /// Without zeros at the end.
    Bytes(&'a [u8]),
    /// Without zeros at the end; U+FFFD for what is not Unicode.
    Text(String),
}

/// A float of 16 bits.
fn half(bits: u16) -> f64 {
    let sign = if bits & 0x8000 == 0 { 1.0 } else { -1.0 };
    let (exponent, fraction) = (i32::from(bits >> 10 & 31), f64::from(bits & 1023));
    sign * match exponent {
        0 => fraction * f64::exp2(-24.0),
        31 if fraction == 0.0 => f64::INFINITY,
        31 => f64::NAN,
        _ => (1.0 + fraction / 1024.0) * f64::exp2(f64::from(exponent - 15)),
    }
}
