//! How floats are written.

use super::decimal::{F32, F64, Format, Whole};
use crate::sink::Sink;

/// A format for the floats in results. Only the one in use is linked.
pub trait Floats: Copy {
    /// Writes an `f32`.
    fn put_f32(self, value: f32, sink: &mut (impl Sink + ?Sized));
    /// Writes an `f64`.
    fn put_f64(self, value: f64, sink: &mut (impl Sink + ?Sized));
}

/// Like Python's `repr`: the shortest text that reads back as the same number, with an exponent below
/// `0.0001` and from `1e+16` on. Examples: `0.1`, `1000.0`, `1e-05`, `-0.0`, `inf`, `nan`.
///
/// An `f32` gets just enough digits to tell it from other `f32`s: `0.1`, although its exact value differs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Shortest;

/// A fixed number of digits after the point, like Python's `'%.2f' % value`: rounded to the nearest, a tie to
/// the even digit. `Fixed(0)` writes no point, so Python reads the text as an `int`.
///
/// Unlike in Python, zero has no sign, so a noisy sensor never shows `-0.00`. Digits after the 17th
/// significant one are zeros.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Fixed(
    /// Number of digits after the point.
    pub u8,
);

impl Floats for Shortest {
    fn put_f32(self, value: f32, sink: &mut (impl Sink + ?Sized)) {
        put_shortest(Bits::of_f32(value), sink);
    }

    fn put_f64(self, value: f64, sink: &mut (impl Sink + ?Sized)) {
        put_shortest(Bits::of_f64(value), sink);
    }
}

impl Floats for Fixed {
    fn put_f32(self, value: f32, sink: &mut (impl Sink + ?Sized)) {
        put_fixed(Bits::of_f32(value), self.0.into(), sink);
    }

    fn put_f64(self, value: f64, sink: &mut (impl Sink + ?Sized)) {
        put_fixed(Bits::of_f64(value), self.0.into(), sink);
    }
}

/// A float of either format.
#[derive(Clone, Copy)]
struct Bits {
    format: &'static Format,
    negative: bool,
    magnitude: u64,
}

impl Bits {
    fn of_f32(value: f32) -> Self {
        let bits = value.to_bits();
        Self {
            format: &F32,
            negative: bits >> 31 != 0,
            magnitude: u64::from(bits << 1 >> 1),
        }
    }

    fn of_f64(value: f64) -> Self {
        let bits = value.to_bits();
        Self {
            format: &F64,
            negative: bits >> 63 != 0,
            magnitude: bits << 1 >> 1,
        }
    }

    /// The text of a float without digits.
    fn name(self) -> Option<&'static [u8]> {
        match self.magnitude.cmp(&self.format.infinity()) {
            core::cmp::Ordering::Less => None,
            core::cmp::Ordering::Equal if self.negative => Some(b"-inf"),
            core::cmp::Ordering::Equal => Some(b"inf"),
            core::cmp::Ordering::Greater => Some(b"nan"),
        }
    }
}

fn put_shortest(bits: Bits, sink: &mut (impl Sink + ?Sized)) {
    if let Some(name) = bits.name() {
        return sink.put(name);
    }
    let (digits, power) = match bits.magnitude {
        0 => (0, 0),
        magnitude => bits.format.shortest(magnitude),
    };
    let text = Whole::of(digits);
    if bits.negative {
        sink.put(b"-");
    }
    let after_first = text.digits().len() as i32 - 1;
    if (-4..16).contains(&power) {
        put_digits(text.digits(), power, (after_first - power).max(1), sink);
    } else {
        put_digits(text.digits(), 0, after_first, sink);
        sink.put(if power < 0 { b"e-" } else { b"e+" });
        let power = power.unsigned_abs();
        if power < 10 {
            sink.put(b"0");
        }
        crate::sink::put_decimal(sink, power);
    }
}

fn put_fixed(bits: Bits, decimals: i32, sink: &mut (impl Sink + ?Sized)) {
    if let Some(name) = bits.name() {
        return sink.put(name);
    }
    let rounded = match bits.magnitude {
        0 => None,
        magnitude => bits.format.fixed(magnitude, decimals),
    };
    if bits.negative && rounded.is_some() {
        sink.put(b"-");
    }
    let (digits, power) = rounded.unwrap_or((0, 0));
    put_digits(Whole::of(digits).digits(), power, decimals, sink);
}

/// Writes digits, the first of which stands for `10^power`, with `decimals` digits after the point; with 0,
/// no point.
fn put_digits(digits: &[u8], power: i32, decimals: i32, sink: &mut (impl Sink + ?Sized)) {
    for place in (-decimals..=power.max(0)).rev() {
        if place == -1 {
            sink.put(b".");
        }
        let digit = usize::try_from(power - place).ok();
        let digit = digit.and_then(|nth| digits.get(nth));
        sink.put(&[digit.copied().unwrap_or(b'0')]);
    }
}
