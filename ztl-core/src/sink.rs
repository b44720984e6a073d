//! Where encoders write: a caller's buffer, a growing vector, or a counter.

/// Receives the bytes that an encoder produces, in order.
///
/// An encoder never fails midway: a full sink keeps counting, so that its owner can report the size needed.
/// Any `FnMut(&[u8])` is a sink.
///
/// ```
/// use ztl_core::sink::Sink;
/// let mut grown = Vec::new();
/// let sink: &mut dyn Sink = &mut |bytes: &[u8]| grown.extend_from_slice(bytes);
/// sink.put(b"abc");
/// assert_eq!(grown, b"abc");
/// ```
pub trait Sink {
    /// Receives the next bytes.
    fn put(&mut self, bytes: &[u8]);
}

impl<F: FnMut(&[u8])> Sink for F {
    fn put(&mut self, bytes: &[u8]) {
        self(bytes);
    }
}

/// A sink over a caller's buffer. It keeps counting when the buffer is full.
#[derive(Debug)]
pub struct SliceSink<'a> {
    buffer: &'a mut [u8],
    wanted: usize,
}

/// The caller's buffer is too small.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct BufferTooSmall {
    /// Bytes needed for the whole output.
    pub needed: usize,
    /// Size of the buffer.
    pub available: usize,
}

impl BufferTooSmall {
    /// Output of `needed` bytes, for a buffer of `available`.
    #[must_use]
    pub const fn new(needed: usize, available: usize) -> Self {
        Self { needed, available }
    }
}

impl core::fmt::Display for BufferTooSmall {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        let Self { needed, available } = self;
        write!(
            f,
            "buffer too small: {needed} bytes needed, {available} available"
        )
    }
}

impl core::error::Error for BufferTooSmall {}

impl<'a> SliceSink<'a> {
    /// A sink that fills `buffer` from its start.
    pub fn new(buffer: &'a mut [u8]) -> Self {
        Self { buffer, wanted: 0 }
    }

    /// Returns the bytes written.
    ///
    /// # Errors
    /// [`BufferTooSmall`] if more was put than the buffer holds.
    pub fn finish(self) -> Result<&'a [u8], BufferTooSmall> {
        let available = self.buffer.len();
        let buffer: &'a [u8] = self.buffer;
        buffer.get(..self.wanted).ok_or(BufferTooSmall {
            needed: self.wanted,
            available,
        })
    }
}

impl Sink for SliceSink<'_> {
    fn put(&mut self, bytes: &[u8]) {
        // In two steps, so that the compiler sees that the lengths match.
        let rest = self.buffer.get_mut(self.wanted..);
        if let Some(room) = rest.and_then(|rest| rest.get_mut(..bytes.len())) {
            room.copy_from_slice(bytes);
        }
        self.wanted = self.wanted.saturating_add(bytes.len());
    }
}

/// Writes `number` in decimal.
pub fn put_decimal(sink: &mut (impl Sink + ?Sized), number: u32) {
    let mut digits = [b'0'; 10];
    let mut rest = number;
    let mut first = 9;
    for (place, digit) in digits.iter_mut().enumerate().rev() {
        let (tenth, last) = div_10(rest);
        *digit = b'0' + last;
        rest = tenth;
        first = place;
        if rest == 0 {
            break;
        }
    }
    sink.put(digits.get(first..).unwrap_or_default());
}

/// Divides by 10: quotient and remainder. Uses shifts, because a division costs 0.4 KiB on a Cortex-M0.
#[must_use]
pub const fn div_10(number: u32) -> (u32, u8) {
    // Approximates 0.8 × `number` from below.
    let mut tenth = (number >> 1) + (number >> 2);
    tenth += tenth >> 4;
    tenth += tenth >> 8;
    tenth += tenth >> 16;
    tenth >>= 3;
    let last = number - tenth * 10;
    if last < 10 {
        (tenth, last as u8)
    } else {
        (tenth + 1, (last - 10) as u8)
    }
}

/// Writes `value` with exactly `decimals` digits after the point (at most 6; 0 writes no point), rounded half
/// away from zero. Writes `nan`, `inf` and `-inf` for the special values; saturates beyond ±9e12.
///
/// Takes one multiplication and no `core::fmt`, which would cost 2.5 KiB on a Cortex-M0.
pub fn put_fixed(sink: &mut (impl Sink + ?Sized), value: f32, decimals: u8) {
    if value.is_nan() {
        return sink.put(b"nan");
    }
    if value.is_infinite() {
        return sink.put(if value > 0.0 { b"inf" } else { b"-inf" });
    }
    let decimals = usize::from(decimals.min(6));
    let scale = (0..decimals).fold(1u64, |scale, _| scale * 10);
    // The cast saturates.
    let scaled = (f64::from(value.abs()) * scale as f64 + 0.5) as u64;
    if value < 0.0 && scaled > 0 {
        sink.put(b"-");
    }
    let mut digits = [b'0'; 20];
    let mut rest = scaled;
    let mut first = digits.len();
    for (place, digit) in digits.iter_mut().enumerate().rev() {
        *digit = b'0' + (rest % 10) as u8;
        rest /= 10;
        first = place;
        if rest == 0 && place + decimals < 20 {
            break;
        }
    }
    let (whole, fraction) = digits.split_at(20 - decimals);
    sink.put(whole.get(first.min(whole.len())..).unwrap_or_default());
    if decimals > 0 {
        sink.put(b".");
        sink.put(fraction);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_full_buffer_reports_the_size_needed() {
        let mut buffer = [0xA5; 4];
        let mut sink = SliceSink::new(&mut buffer);
        sink.put(b"ab");
        sink.put(b"cde");
        assert_eq!(
            sink.finish(),
            Err(BufferTooSmall {
                needed: 5,
                available: 4
            })
        );
    }

    #[test]
    fn put_fixed_writes_what_the_standard_library_writes() {
        for value in [
            0.0f32, 0.04, 0.05, 1.0, 39.96, 40.0, -0.01, -90.0, 1234.56, 1e7,
        ] {
            for decimals in 0..=6 {
                let mut buffer = [0xA5; 32];
                let mut sink = SliceSink::new(&mut buffer);
                put_fixed(&mut sink, value, decimals);
                let ours = std::str::from_utf8(sink.finish().unwrap()).unwrap();
                let mut theirs = std::format!("{value:.*}", usize::from(decimals));
                // Ours writes no negative zero.
                if !theirs.contains(|c| ('1'..='9').contains(&c)) {
                    theirs = theirs.replace('-', "");
                }
                assert_eq!(ours, theirs);
            }
        }
        let mut buffer = [0xA5; 32];
        let mut sink = SliceSink::new(&mut buffer);
        put_fixed(&mut sink, 39.96, 1);
        put_fixed(&mut sink, -0.5, 1);
        put_fixed(&mut sink, 7.0, 0);
        assert_eq!(sink.finish(), Ok(&b"40.0-0.57"[..]));
    }

    #[test]
    fn div_10_is_exact() {
        let edges = [0, 9, 10, 19, 99_999, 1 << 31, u32::MAX - 6, u32::MAX];
        for number in (0..100_000)
            .chain(edges)
            .chain((0..u32::MAX).step_by(65_521))
        {
            assert_eq!(div_10(number), (number / 10, (number % 10) as u8));
        }
    }

    #[test]
    fn put_decimal_writes_no_leading_zeros() {
        for number in [0, 7, 10, 99, 100, 4_294_967_295] {
            let mut buffer = [0xA5; 12];
            let mut sink = SliceSink::new(&mut buffer);
            put_decimal(&mut sink, number);
            assert_eq!(
                sink.finish().unwrap(),
                std::string::ToString::to_string(&number).as_bytes()
            );
        }
    }
}
