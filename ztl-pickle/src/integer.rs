//! Whole numbers of any size, as Python's: two's complement, the lowest byte first.

use std::fmt::{self, Write};

/// The most decimal digits that are read or written, as in Python: the time grows with the square.
pub(crate) const MAX_DIGITS: usize = 4300;

/// What that many digits and a sign take.
const MAX_BYTES: usize = 1787;

/// The most that one limb of nine digits holds.
const LIMB: u32 = 1_000_000_000;

/// Without the bytes that only repeat the sign.
pub(crate) fn shortest(mut bytes: &[u8]) -> &[u8] {
    while let [rest @ .., before, last] = bytes {
        let sign = if before & 0x80 == 0 { 0 } else { 0xff };
        if *last != sign {
            return bytes;
        }
        bytes = bytes.get(..=rest.len()).unwrap_or_default();
    }
    match bytes {
        [0] => &[],
        _ => bytes,
    }
}

pub(crate) fn is_negative(bytes: &[u8]) -> bool {
    bytes.last().is_some_and(|last| last & 0x80 != 0)
}

/// The number, if 64 bits are enough.
pub(crate) fn to_i64(bytes: &[u8]) -> Option<i64> {
    let mut wide = [if is_negative(bytes) { 0xff } else { 0 }; 8];
    wide.get_mut(..bytes.len())?.copy_from_slice(bytes);
    Some(i64::from_le_bytes(wide))
}

/// The negated number, perhaps with a byte too many.
fn negated(bytes: &[u8]) -> Vec<u8> {
    let mut carry = true;
    let sign = if is_negative(bytes) { 0xff } else { 0 };
    let mut negate = |byte: &u8| {
        let (negated, overflows) = (!byte).overflowing_add(carry.into());
        carry = overflows;
        negated
    };
    bytes.iter().chain([&sign]).map(&mut negate).collect()
}

/// The bytes of a decimal text: digits, perhaps after a sign.
pub(crate) fn from_decimal(text: &[u8]) -> Option<Vec<u8>> {
    let (negative, digits) = match text {
        [b'-', digits @ ..] => (true, digits),
        [b'+', digits @ ..] => (false, digits),
        digits => (false, digits),
    };
    let fits = (1..=MAX_DIGITS).contains(&digits.len());
    if !fits || !digits.iter().all(u8::is_ascii_digit) {
        return None;
    }
    let mut limbs: Vec<u32> = Vec::new();
    for digit in digits {
        let mut carry = u64::from(digit - b'0');
        for limb in &mut limbs {
            let wide = u64::from(*limb) * 10 + carry;
            (*limb, carry) = (wide as u32, wide >> 32);
        }
        if carry > 0 {
            limbs.push(carry as u32);
        }
    }
    let mut bytes: Vec<u8> = limbs.iter().flat_map(|limb| limb.to_le_bytes()).collect();
    bytes.push(0);
    Some(if negative { negated(&bytes) } else { bytes })
}

/// Whether Python prints it.
pub(crate) const fn is_printable(bytes: &[u8]) -> bool {
    bytes.len() <= MAX_BYTES
}

/// Writes the decimal text; the hexadecimal one if Python does not print it.
pub(crate) fn put_text(bytes: &[u8], out: &mut (impl Write + ?Sized)) -> fmt::Result {
    let magnitude = if is_negative(bytes) {
        out.write_char('-')?;
        negated(bytes)
    } else {
        bytes.to_vec()
    };
    if !is_printable(bytes) {
        let mut digits = magnitude.iter().rev().skip_while(|byte| **byte == 0);
        write!(out, "{:#x}", digits.next().unwrap_or(&0))?;
        return digits.try_for_each(|byte| write!(out, "{byte:02x}"));
    }
    let mut limbs: Vec<u32> = Vec::new();
    for byte in magnitude.iter().rev() {
        let mut carry = u32::from(*byte);
        for limb in &mut limbs {
            let wide = u64::from(*limb) * 256 + u64::from(carry);
            *limb = (wide % u64::from(LIMB)) as u32;
            carry = (wide / u64::from(LIMB)) as u32;
        }
        if carry > 0 {
            limbs.push(carry);
        }
    }
    write!(out, "{}", limbs.pop().unwrap_or(0))?;
    limbs
        .iter()
        .rev()
        .try_for_each(|limb| write!(out, "{limb:09}"))
}

/// The shortest bytes of a float without a fraction: it is equal to an integer, also as a key.
pub(crate) fn from_whole_float(value: f64) -> Vec<u8> {
    let bits = value.abs().to_bits();
    let exponent = (bits >> 52) as i32 - 1075;
    let mantissa = u128::from((bits & ((1 << 52) - 1)) | 1 << 52);
    let mut bytes = Vec::new();
    if value != 0.0 && exponent < 0 {
        bytes.extend((mantissa >> -exponent).to_le_bytes());
    } else if value != 0.0 {
        bytes.resize(exponent as usize / 8, 0);
        bytes.extend((mantissa << (exponent % 8)).to_le_bytes());
    }
    if value < 0.0 {
        bytes = negated(&bytes);
    }
    let len = shortest(&bytes).len();
    bytes.truncate(len);
    bytes
}

#[cfg(test)]
mod tests {
    use super::*;

    fn to_text(bytes: &[u8]) -> String {
        let mut text = String::new();
        put_text(bytes, &mut text).unwrap();
        text
    }

    #[test]
    fn integers_survive_both_conversions() {
        for text in [
            "0",
            "1",
            "-1",
            "127",
            "128",
            "-128",
            "-129",
            "255",
            "9223372036854775807",
            "-9223372036854775808",
            "9223372036854775808",
            "100000000000000000000000000000000000000",
            "-340282366920938463463374607431768211456",
        ] {
            let bytes = from_decimal(text.as_bytes()).unwrap();
            assert_eq!(to_text(shortest(&bytes)), text);
            assert_eq!(to_text(&bytes), text);
            assert_eq!(to_i64(shortest(&bytes)), text.parse().ok(), "{text}");
        }
        for wrong in ["", "-", "+", "1 ", "1_0", "0x1", "--1"] {
            assert_eq!(from_decimal(wrong.as_bytes()), None, "{wrong}");
        }
        assert_eq!(from_decimal(&[b'1'; MAX_DIGITS + 1]), None);
        let longest = from_decimal(&[b'9'; MAX_DIGITS]).unwrap();
        assert_eq!(to_text(shortest(&longest)), "9".repeat(MAX_DIGITS));
    }

    #[test]
    fn a_number_that_python_does_not_print_is_hexadecimal() {
        let mut bytes = vec![0; 2000];
        bytes.push(0xff);
        assert_eq!(to_text(&bytes), format!("-0x1{}", "00".repeat(2000)));
    }

    #[test]
    fn a_whole_float_has_the_bytes_of_its_integer() {
        for value in [
            0.0,
            -0.0,
            1.0,
            -1.0,
            256.0,
            4503599627370497.0,
            -9007199254740994.0,
        ] {
            let integer = (value as i64).to_le_bytes();
            assert_eq!(from_whole_float(value), shortest(&integer), "{value}");
        }
        let text = "1000000000000000019884624838656";
        assert_eq!(to_text(&from_whole_float(1e30)), text);
        assert_eq!(to_text(&from_whole_float(-1e30)), format!("-{text}"));
        assert_eq!(from_whole_float(f64::MAX).len(), 129);
    }
}
