//! How floats are written.

use super::decimal::{F32, F64, Format};
use crate::sink::Sink;

/// A way to write floats in results. Only the code of the one in use is linked.
pub trait Floats: Copy {
    /// Writes an `f32`.
    fn put_f32(self, value: f32, sink: &mut (impl Sink + ?Sized));
    /// Writes an `f64`.
    fn put_f64(self, value: f64, sink: &mut (impl Sink + ?Sized));
}

/// As Python's `repr`: the shortest text that reads back as the same number of the same type, with
/// an exponent below `1e-04` and from `1e+16` on. `0.1`, `1000.0`, `1e-05`, `-0.0`, `inf`, `nan`.
///
/// An `f32` is written as short as tells it from other `f32`s: `0.1`, which Python reads as another
/// number than the `f32`'s exact value.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Shortest;

/// With so many digits after the point, as Python's `'%.2f' % value`: rounded to the nearest, of two
/// equally near ones to the even. With 0 there is no point, and Python reads the text as an `int`.
///
/// Other than Python's, zero has no sign, so that no `-0.00` comes out of a sensor's noise; and
/// digits after the 18th, counted from the first that is not 0, are zeros.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Fixed(
    /// Digits after the point.
    pub u8,
);

impl Floats for Shortest {
    fn put_f32(self, value: f32, sink: &mut (impl Sink + ?Sized)) {
        if finite(value.is_nan(), value.is_infinite(), value.is_sign_negative(), sink) {
            put_shortest(&F32, value.abs().to_bits().into(), sink);
        }
    }

    fn put_f64(self, value: f64, sink: &mut (impl Sink + ?Sized)) {
        if finite(value.is_nan(), value.is_infinite(), value.is_sign_negative(), sink) {
            put_shortest(&F64, value.abs().to_bits(), sink);
        }
    }
}

impl Floats for Fixed {
    fn put_f32(self, value: f32, sink: &mut (impl Sink + ?Sized)) {
        let fixed = self.digits(&F32, value.abs().to_bits().into(), value.is_finite());
        let negative = value.is_sign_negative() && fixed.is_some();
        if finite(value.is_nan(), value.is_infinite(), negative, sink) {
            self.put(fixed, sink);
        }
    }

    fn put_f64(self, value: f64, sink: &mut (impl Sink + ?Sized)) {
        let fixed = self.digits(&F64, value.abs().to_bits(), value.is_finite());
        let negative = value.is_sign_negative() && fixed.is_some();
        if finite(value.is_nan(), value.is_infinite(), negative, sink) {
            self.put(fixed, sink);
        }
    }
}
