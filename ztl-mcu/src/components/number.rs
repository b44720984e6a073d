//! Decimal numbers as integers with a fixed number of decimals: `45.5` with three is 45500.
//!
//! A Cortex-M0 has no floating-point unit; parsing into an `f32` takes five times as much flash.

use ztl_core::sink::div_10;

use crate::component::Report;

/// Parses a number and multiplies it by `10^decimals`, rounded half away from zero. `None` if it is not a number or too
/// large.
///
/// It accepts the decimal floats of [`ztl_core::goal`] without `_`.
pub fn parse(text: &str, decimals: u8) -> Option<i32> {
    let (negative, mut rest) = sign(text.as_bytes().trim_ascii());
    let octal = rest.first() == Some(&b'0');
    let mut value = 0;
    let (mut count, kept) = digits(&mut rest, &mut value);
    let mut exponent = i32::from(decimals) + count - kept;
    // 010 is 8 in YAML and 10 for a person.
    if octal && rest.is_empty() && value > 0 {
        return None;
    }
    if let [b'.', behind @ ..] = rest {
        rest = behind;
        let (more, parts) = digits(&mut rest, &mut value);
        count += more;
        exponent -= parts;
    }
    if count == 0 {
        return None;
    }
    if let [b'e' | b'E', behind @ ..] = rest {
        let (negative, behind) = sign(behind);
        rest = behind;
        // A huge exponent only needs to be out of range.
        let mut power = 0;
        if digits(&mut rest, &mut power).0 == 0 {
            return None;
        }
        let power = power.min(1_000_000_000).cast_signed();
        exponent += if negative { -power } else { power };
    }
    if !rest.is_empty() {
        return None;
    }
    let mut dropped = 0u8;
    while exponent < 0 && (value > 0 || dropped > 0) {
        (value, dropped) = div_10(value);
        exponent += 1;
    }
    while exponent > 0 && value > 0 {
        value = Some(value).filter(|&value| value < LONG)? * 10;
        exponent -= 1;
    }
    let value = i32::try_from(value + u32::from(dropped >= 5)).ok()?;
    Some(if negative { -value } else { value })
}

/// Parses a whole number, also with the `.0` of a Python float: `200.0`. `None` if it is something else or too large, or
/// has a leading zero.
pub(super) fn parse_whole(text: &[u8]) -> Option<u32> {
    let (mut rest, mut value) = (text, 0);
    let (count, kept) = digits(&mut rest, &mut value);
    let octal = text.first() == Some(&b'0') && count > 1;
    let whole = matches!(rest, [] | [b'.', b'0']);
    (count > 0 && count == kept && !octal && whole).then_some(value)
}

/// From here on, another digit may not fit.
const LONG: u32 = u32::MAX / 10;

/// Appends the digits at the start of `rest` to `value`, as far as they fit. Returns how many there are and how many were
/// appended.
fn digits(rest: &mut &[u8], value: &mut u32) -> (i32, i32) {
    let (mut count, mut kept) = (0, 0);
    while let [digit @ b'0'..=b'9', behind @ ..] = *rest {
        *rest = behind;
        count += 1;
        if *value < LONG {
            *value = *value * 10 + u32::from(digit - b'0');
            kept += 1;
        }
    }
    (count, kept)
}

/// Whether the number is negative, and the bytes after the sign.
const fn sign(bytes: &[u8]) -> (bool, &[u8]) {
    match bytes {
        [b'-', rest @ ..] => (true, rest),
        [b'+', rest @ ..] | rest => (false, rest),
    }
}

/// Writes `value` with a decimal point before its last `decimals` digits.
pub fn report(report: &mut Report<'_>, value: i32, decimals: u8) {
    if value < 0 {
        report.text("-");
    }
    let mut rest = value.unsigned_abs();
    // The digits in reverse order; a number has at most ten.
    let mut digits = [0u8; 10];
    let mut count = 0u8;
    for digit in &mut digits {
        if rest == 0 && count > decimals {
            break;
        }
        (rest, *digit) = div_10(rest);
        count += 1;
    }
    while count > 0 {
        if count == decimals {
            report.text(".");
        }
        count -= 1;
        let digit = usize::from(digits.get(usize::from(count)).copied().unwrap_or_default());
        report.text("0123456789".get(digit..=digit).unwrap_or_default());
    }
}

/// `value` without its last `digits` digits, rounded half away from zero.
pub(super) fn rounded(value: i32, digits: u8) -> i32 {
    let mut unit = 1i32;
    for _ in 0..digits.min(9) {
        unit *= 10;
    }
    let half = if value < 0 { -(unit / 2) } else { unit / 2 };
    value
        .saturating_add(half)
        .checked_div(unit)
        .unwrap_or(value)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::string::String;

    #[test]
    fn numbers_are_parsed_with_their_decimals() {
        for (text, decimals, expected) in [
            ("45", 3, Some(45_000)),
            (" 45.5 ", 3, Some(45_500)),
            ("-.25", 3, Some(-250)),
            ("+7.", 3, Some(7000)),
            ("0.0004", 3, Some(0)),
            ("0.0005", 3, Some(1)),
            ("-12.34567", 3, Some(-12_346)),
            ("9e1", 3, Some(90_000)),
            ("1e-05", 3, Some(0)),
            ("12345E-3", 0, Some(12)),
            ("2147483647", 0, Some(i32::MAX)),
            ("2147483648", 0, None),
            ("99999999999", 0, None),
            ("0e999", 3, Some(0)),
            ("1e999", 3, None),
            ("0e-0000", 3, Some(0)),
            ("5e0001", 0, Some(50)),
            ("1e-99999999999", 3, Some(0)),
            ("1e99999999999", 3, None),
            ("1e-999", 3, Some(0)),
            ("00", 3, Some(0)),
            ("010", 3, None),
            ("", 3, None),
            (".", 3, None),
            ("-", 3, None),
            ("1.2.3", 3, None),
            ("4 5", 3, None),
            ("e5", 3, None),
            ("1e", 3, None),
            ("1e+", 3, None),
            ("nan", 3, None),
            ("left", 3, None),
            ("+-1", 3, None),
        ] {
            assert_eq!(parse(text, decimals), expected, "{text}");
        }
    }

    fn written(value: i32, decimals: u8) -> String {
        let mut text = heapless::String::<16>::new();
        report(&mut Report::new(&mut text), value, decimals);
        text.as_str().into()
    }

    #[test]
    fn numbers_are_written_with_their_decimals() {
        for (value, decimals, expected) in [
            (0, 0, "0"),
            (0, 1, "0.0"),
            (-5, 1, "-0.5"),
            (450, 1, "45.0"),
            (12_345, 3, "12.345"),
            (12_005, 3, "12.005"),
            (i32::MIN, 0, "-2147483648"),
            (i32::MIN, 9, "-2.147483648"),
        ] {
            assert_eq!(written(value, decimals), expected);
        }
    }

    #[test]
    fn rounding_is_half_away_from_zero() {
        for (value, digits, expected) in [
            (149, 2, 1),
            (150, 2, 2),
            (-150, 2, -2),
            (-149, 2, -1),
            (7, 0, 7),
            (i32::MAX, 1, i32::MAX / 10),
        ] {
            assert_eq!(rounded(value, digits), expected);
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::default() })]

        #[test]
        fn parsing_inverts_writing(value in -i32::MAX..i32::MAX, decimals in 0u8..=9) {
            prop_assert_eq!(parse(&written(value, decimals), decimals), Some(value));
        }

        #[test]
        fn numbers_parse_like_any_goal(
            text in "[-+]?[0-9]{0,4}(\\.[0-9]{0,4})?([eE][-+]?[0-9]{0,5})?|[-+0-9.eE]{0,8}",
        ) {
            let theirs = ztl_core::goal::from_str::<f64>(&text);
            match parse(&text, 2) {
                Some(ours) => {
                    let theirs = theirs.unwrap();
                    prop_assert!((theirs * 100.0 - f64::from(ours)).abs() <= 0.5 + 1e-6, "{text}: {ours}");
                }
                None => prop_assert!(
                    theirs.is_err() || theirs.is_ok_and(|theirs| theirs.abs() * 100.0 > f64::from(i32::MAX) - 1.0),
                    "{text} is not read"
                ),
            }
        }
    }
}
