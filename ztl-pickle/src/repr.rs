//! Values as Python's `repr` prints them.

mod time;

use std::fmt::{self, Display, Write};

use ztl_core::goal::{Floats, Shortest};
use ztl_core::repr::put_quoted;
use ztl_core::sink::Sink;

use crate::Pickle;
use crate::array::Array;
use crate::dtype::{DType, Element, ElementKind};
use crate::value::{Kind, Value};
use crate::walk::{Limited, Visitor, walk};
use time::{put_date, put_delta, put_time, put_timezone, put_zone};

/// The longest text, unless told otherwise.
const MOST: usize = 1 << 20;

/// Prints a value as Python's `repr`, on one line. A value within itself is `[...]`, as in Python.
///
/// An array is printed with all its elements and its type, which numpy shortens and breaks into lines:
/// `array([[1, 2], [3, 4]], dtype=int64)`. An `int` of more than 4300 digits is hexadecimal; Python
/// refuses to print it.
///
/// ```
/// # use ztl_pickle::Pickle;
/// let pickle = Pickle::tuple(["it's".into(), 1e16.into(), Pickle::bytes(b"\0")?])?;
/// assert_eq!(pickle.value().repr().to_string(), r#"("it's", 1e+16, b'\x00')"#);
/// # Ok::<(), ztl_pickle::Error>(())
/// ```
#[derive(Debug, Clone, Copy)]
pub struct Repr<'a> {
    value: Value<'a>,
    most: usize,
}

impl<'a> Value<'a> {
    /// Prints it as Python's `repr`; see [`Repr`].
    #[must_use]
    pub const fn repr(self) -> Repr<'a> {
        Repr::new(self)
    }
}

impl fmt::Debug for Value<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        Display::fmt(&self.repr(), f)
    }
}

impl fmt::Debug for Pickle {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        Display::fmt(&self.value().repr(), f)
    }
}

impl<'a> Repr<'a> {
    pub(crate) const fn new(value: Value<'a>) -> Self {
        Self { value, most: MOST }
    }

    /// Cuts the text after this many bytes, and writes `...` there. Default 1 MiB: a small pickle may have a long text,
    /// since a list may contain another one twice, which contains one twice, and so on.
    #[must_use]
    pub const fn most(mut self, bytes: usize) -> Self {
        self.most = bytes;
        self
    }
}

impl Display for Repr<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut out = Limited {
            out: f,
            left: self.most,
            is_cut: false,
        };
        match put(self.value, &mut out) {
            Err(fmt::Error) if out.is_cut => f.write_str("..."),
            result => result,
        }
    }
}

/// Writes the text of a value.
pub(crate) fn put(value: Value<'_>, out: &mut impl Write) -> fmt::Result {
    walk(value, &mut ReprWriter(out))
}

struct ReprWriter<'a, W>(&'a mut W);

impl<W: Write> Visitor for ReprWriter<'_, W> {
    fn leaf(&mut self, value: Value<'_>) -> fmt::Result {
        let out = &mut *self.0;
        match value.kind() {
            Kind::None => out.write_str("None"),
            Kind::Bool(value) => out.write_str(python_bool(value)),
            Kind::Int(value) => write!(out, "{value}"),
            Kind::BigInt(value) => write!(out, "{value}"),
            Kind::Float(value) => put_float(value, 8, out),
            Kind::Str(text) => put_str(text, out),
            Kind::BrokenStr(bytes) => put_broken(bytes, out),
            Kind::Bytes(bytes) => put_bytes(bytes, out),
            Kind::ByteArray(bytes) => {
                out.write_str("bytearray(")?;
                put_bytes(bytes, out)?;
                out.write_char(')')
            }
            Kind::Array(array) => put_array(array, out),
            Kind::Scalar(scalar) => {
                let dtype = scalar.dtype();
                match dtype.kind() {
                    ElementKind::Bytes => out.write_str("np.bytes_")?,
                    ElementKind::Text => out.write_str("np.str_")?,
                    ElementKind::Bool => out.write_str("np.")?,
                    // The scalar has the order of this machine.
                    _ => write!(out, "np.{}", dtype.ordered(b'<').unwrap_or(dtype))?,
                }
                if dtype.kind() == ElementKind::Bool {
                    return scalar
                        .element()
                        .map_or(Ok(()), |element| put_element(&element, 8, out));
                }
                out.write_char('(')?;
                if let Some(element) = scalar.element() {
                    put_element(&element, dtype.size(), out)?;
                }
                out.write_char(')')
            }
            Kind::DType(dtype) => write!(out, "dtype('{}')", dtype_name(dtype)),
            Kind::Date(date) => {
                out.write_str("datetime.date(")?;
                put_date(date, out)?;
                out.write_char(')')
            }
            Kind::Time(time) => {
                out.write_str("datetime.time(")?;
                put_time(time, out)?;
                put_zone(time.zone, out)?;
                out.write_str(if time.fold { ", fold=1)" } else { ")" })
            }
            Kind::DateTime(moment) => {
                out.write_str("datetime.datetime(")?;
                put_date(moment.date, out)?;
                out.write_str(", ")?;
                put_time(moment.time, out)?;
                out.write_str(if moment.time.fold { ", fold=1" } else { "" })?;
                put_zone(moment.time.zone, out)?;
                out.write_char(')')
            }
            Kind::TimeDelta(delta) => put_delta(delta, out),
            Kind::TimeZone(zone) => put_timezone(zone, out),
            // Those have items.
            Kind::List(_) | Kind::Tuple(_) | Kind::Set(_) | Kind::FrozenSet(_) => Ok(()),
            Kind::Dict(_) | Kind::OrderedDict(_) => Ok(()),
        }
    }

    fn open(&mut self, value: Value<'_>) -> fmt::Result {
        self.0.write_str(match value.kind() {
            Kind::List(_) => "[",
            Kind::Tuple(_) => "(",
            Kind::Set(items) if items.len() == 0 => "set(",
            Kind::FrozenSet(items) if items.len() == 0 => "frozenset(",
            Kind::FrozenSet(_) => "frozenset({",
            Kind::OrderedDict(entries) if entries.len() == 0 => "OrderedDict(",
            Kind::OrderedDict(_) => "OrderedDict({",
            _ => "{",
        })
    }

    fn before(&mut self, value: Value<'_>, index: u32) -> fmt::Result {
        let is_mapping = matches!(value.kind(), Kind::Dict(_) | Kind::OrderedDict(_));
        self.0.write_str(match index {
            0 => "",
            _ if is_mapping && !index.is_multiple_of(2) => ": ",
            _ => ", ",
        })
    }

    fn close(&mut self, value: Value<'_>) -> fmt::Result {
        self.0.write_str(match value.kind() {
            Kind::List(_) => "]",
            Kind::Tuple(items) if items.len() == 1 => ",)",
            Kind::Tuple(_) => ")",
            Kind::Set(items) | Kind::FrozenSet(items) if items.len() == 0 => ")",
            Kind::OrderedDict(entries) if entries.len() == 0 => ")",
            Kind::FrozenSet(_) | Kind::OrderedDict(_) => "})",
            _ => "}",
        })
    }

    fn recursive(&mut self, value: Value<'_>) -> fmt::Result {
        self.0.write_str(match value.kind() {
            Kind::List(_) => "[...]",
            Kind::Tuple(_) => "(...)",
            Kind::Dict(_) => "{...}",
            _ => "...",
        })
    }

    fn key(&mut self, _: Value<'_>) -> Result<bool, fmt::Error> {
        Ok(false)
    }
}

const fn python_bool(value: bool) -> &'static str {
    if value { "True" } else { "False" }
}

/// Makes writers of text usable as sink; keeps the first error.
struct Adapter<'a, W: ?Sized>(&'a mut W, fmt::Result);

impl<W: Write + ?Sized> Sink for Adapter<'_, W> {
    fn put(&mut self, bytes: &[u8]) {
        if self.1.is_ok() {
            self.1 = self
                .0
                .write_str(std::str::from_utf8(bytes).unwrap_or_default());
        }
    }
}

/// A float of so many bytes: the shortest text that means it.
pub(crate) fn put_float(value: f64, size: usize, out: &mut (impl Write + ?Sized)) -> fmt::Result {
    // Python writes `nan` without a sign.
    let value = if value.is_nan() { f64::NAN } else { value };
    let mut sink = Adapter(out, Ok(()));
    match size {
        4 => Shortest.put_f32(value as f32, &mut sink),
        _ => Shortest.put_f64(value, &mut sink),
    }
    sink.1
}

fn put_str(text: &str, out: &mut (impl Write + ?Sized)) -> fmt::Result {
    let mut sink = Adapter(out, Ok(()));
    put_quoted(text, &mut sink);
    sink.1
}

/// The parts of a text: valid ones, and surrogates.
pub(crate) fn parts(bytes: &[u8]) -> impl Iterator<Item = Result<&str, u16>> {
    let mut rest = bytes;
    std::iter::from_fn(move || {
        let valid = match std::str::from_utf8(rest) {
            Ok("") => return None,
            Ok(text) => text,
            Err(error) => {
                let valid = rest.get(..error.valid_up_to()).unwrap_or_default();
                std::str::from_utf8(valid).unwrap_or_default()
            }
        };
        if !valid.is_empty() {
            rest = rest.get(valid.len()..)?;
            return Some(Ok(valid));
        }
        let (&[_, middle, low], after) = rest.split_first_chunk()?;
        rest = after;
        Some(Err(0xd000
            | u16::from(middle & 0x3f) << 6
            | u16::from(low & 0x3f)))
    })
}

/// A text with surrogates.
fn put_broken(bytes: &[u8], out: &mut impl Write) -> fmt::Result {
    let quote = quote(bytes);
    out.write_char(quote)?;
    for part in parts(bytes) {
        match part {
            Err(surrogate) => write!(out, "\\u{surrogate:04x}")?,
            Ok(text) => {
                for c in text.chars() {
                    match c {
                        _ if c == quote => write!(out, "\\{c}")?,
                        '\'' | '"' => out.write_char(c)?,
                        _ => {
                            let mut quoted = String::new();
                            put_str(c.encode_utf8(&mut [0; 4]), &mut quoted)?;
                            out.write_str(quoted.trim_matches('\''))?;
                        }
                    }
                }
            }
        }
    }
    out.write_char(quote)
}

fn quote(bytes: &[u8]) -> char {
    match bytes.contains(&b'\'') && !bytes.contains(&b'"') {
        true => '"',
        false => '\'',
    }
}

fn put_bytes(bytes: &[u8], out: &mut impl Write) -> fmt::Result {
    let quote = quote(bytes);
    write!(out, "b{quote}")?;
    for byte in bytes {
        match byte {
            b'\\' => out.write_str("\\\\")?,
            b'\n' => out.write_str("\\n")?,
            b'\r' => out.write_str("\\r")?,
            b'\t' => out.write_str("\\t")?,
            byte if char::from(*byte) == quote => write!(out, "\\{quote}")?,
            b' '..=b'~' => out.write_char(char::from(*byte))?,
            byte => write!(out, "\\x{byte:02x}")?,
        }
    }
    out.write_char(quote)
}

fn dtype_name(dtype: DType) -> String {
    match dtype.kind() {
        ElementKind::Bytes => dtype.short_code(),
        _ => dtype.to_string(),
    }
}

fn put_array(array: Array<'_>, out: &mut impl Write) -> fmt::Result {
    out.write_str("array(")?;
    let (shape, size) = (array.shape(), array.dtype().size());
    if shape.contains(&0) {
        out.write_str("[]")?;
    } else {
        put_nested(array, out, |element, out| put_element(element, size, out))?;
    }
    if shape.contains(&0) && shape.len() > 1 {
        let lengths: Vec<String> = shape.iter().map(usize::to_string).collect();
        write!(out, ", shape=({})", lengths.join(", "))?;
    }
    let name = dtype_name(array.dtype());
    match name.starts_with(char::is_alphabetic) && array.dtype().kind() != ElementKind::Bytes {
        true => write!(out, ", dtype={name})"),
        false => write!(out, ", dtype='{name}')"),
    }
}

/// The elements in nested brackets.
pub(crate) fn put_nested<W: Write>(
    array: Array<'_>,
    out: &mut W,
    put: impl Fn(&Element<'_>, &mut W) -> fmt::Result,
) -> fmt::Result {
    let mut shape = array.shape();
    if let Some(empty) = shape.iter().position(|length| *length == 0) {
        shape.truncate(empty);
        let count = shape.iter().product();
        return put_in_brackets(shape, (0..count).map(|_| "[]"), out, |item, out| {
            out.write_str(item)
        });
    }
    put_in_brackets(shape, array.elements(), out, put)
}

fn put_in_brackets<T, W: Write>(
    shape: Vec<usize>,
    items: impl Iterator<Item = T>,
    out: &mut W,
    put: impl Fn(&T, &mut W) -> fmt::Result,
) -> fmt::Result {
    // After how many items each bracket closes, from the outermost.
    let mut sizes = shape;
    let mut size = 1;
    for length in sizes.iter_mut().rev() {
        size *= *length;
        *length = size;
    }
    for (index, item) in items.enumerate() {
        let is_first = |size: &&usize| index.is_multiple_of(**size);
        let is_last = |size: &&usize| (index + 1).is_multiple_of(**size);
        let (opened, closed) = (sizes.iter().filter(is_first), sizes.iter().filter(is_last));
        out.write_str(if index > 0 { ", " } else { "" })?;
        opened
            .map(|_| '[')
            .try_for_each(|bracket| out.write_char(bracket))?;
        put(&item, out)?;
        closed
            .map(|_| ']')
            .try_for_each(|bracket| out.write_char(bracket))?;
    }
    Ok(())
}

fn put_element(element: &Element<'_>, size: usize, out: &mut impl Write) -> fmt::Result {
    match element {
        Element::Bool(value) => out.write_str(python_bool(*value)),
        Element::Int(value) => write!(out, "{value}"),
        Element::UInt(value) => write!(out, "{value}"),
        Element::Float(value) => put_float(*value, size, out),
        Element::Complex(real, imaginary) => {
            put_float(*real, size / 2, out)?;
            let has_sign = imaginary.is_sign_negative() && !imaginary.is_nan();
            out.write_str(if has_sign { "" } else { "+" })?;
            put_float(*imaginary, size / 2, out)?;
            out.write_char('j')
        }
        Element::Bytes(bytes) => put_bytes(bytes, out),
        Element::Text(text) => put_str(text, out),
    }
}
