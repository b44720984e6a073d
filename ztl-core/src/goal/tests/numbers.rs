use std::string::{String, ToString};
use std::vec::Vec;

use super::random::Random;
use super::read;
use crate::goal::{Expected, Fixed, GoalErrorKind, from_str, to_slice, to_slice_with};

#[test]
fn floats_are_read_in_every_spelling() {
    for (text, value) in [
        ("1", 1.0),
        ("-1", -1.0),
        ("+1", 1.0),
        ("1.", 1.0),
        (".5", 0.5),
        ("-.5e1", -5.0),
        ("1e3", 1000.0),
        ("1E+3", 1000.0),
        ("1_000.2_5e-0_1", 100.025),
        ("01.5", 1.5),
        ("0x10", 16.0),
        ("0", 0.0),
        ("-0.0", -0.0),
        ("-.0", -0.0),
        ("0e99999999999999999999", 0.0),
        ("1e-99999999999999999999", 0.0),
        ("inf", f32::INFINITY),
        ("-.inf", f32::NEG_INFINITY),
        ("+.INF", f32::INFINITY),
        ("100000000000000000000000000000", 1e29),
        (" 1.5 ", 1.5),
        ("'1.5'", 1.5),
    ] {
        let read = from_str::<f32>(text).unwrap();
        assert_eq!(read.to_bits(), value.to_bits(), "{text}");
        assert_eq!(from_str::<f64>(text).unwrap() as f32, value, "{text}");
    }
    for text in ["nan", ".nan", ".NaN", ".NAN"] {
        assert!(from_str::<f32>(text).unwrap().is_nan(), "{text}");
    }
}

#[test]
fn other_texts_are_not_numbers() {
    for text in [
        ".", "-", "+", "e5", "1e", "1e+", "1.2.3", "1,5", "1_", "_1", "1__0", "1._5", "1_.5",
        "1e_5", "--1", "+-1", "0x", "0x_1", "0xg", "0b2", "0o8", "010", "-007", "infinity", "Inf",
        "NaN", "-nan", "1 2", "½", "１", "1.5f", "0x1p3", "1:30", "- 1",
    ] {
        let error = from_str::<f32>(text).unwrap_err();
        assert_eq!(
            error.kind,
            GoalErrorKind::Expected(Expected::Number),
            "{text}"
        );
        let error = from_str::<i32>(text).unwrap_err();
        assert_eq!(
            error.kind,
            GoalErrorKind::Expected(Expected::Integer),
            "{text}"
        );
    }
}

#[test]
fn integers_are_exact_and_have_a_range() {
    assert_eq!(from_str("18446744073709551615"), Ok(u64::MAX));
    assert_eq!(from_str("0xFFFF_FFFF_FFFF_FFFF"), Ok(u64::MAX));
    assert_eq!(from_str("-9223372036854775808"), Ok(i64::MIN));
    assert_eq!(from_str("-0x8000000000000000"), Ok(i64::MIN));
    assert_eq!(from_str("-0b101"), Ok(-5i8));
    assert_eq!(from_str("+0O17"), Ok(15u8));
    assert_eq!(from_str("-0"), Ok(0u8));
    assert_eq!(from_str("00"), Ok(0u8));
    assert_eq!(from_str("18446744073709551615"), Ok(i128::from(u64::MAX)));
    for text in [
        "18446744073709551616",
        "-9223372036854775809",
        "0x10000000000000000",
        "99999999999999999999999999999999",
    ] {
        let error = read::<serde_json::Value>(text).unwrap_err();
        assert_eq!(error.kind, GoalErrorKind::OutOfRange, "{text}");
    }
    assert_eq!(
        from_str::<u8>("256").unwrap_err().kind,
        GoalErrorKind::OutOfRange
    );
    assert_eq!(
        from_str::<u8>("-1").unwrap_err().kind,
        GoalErrorKind::OutOfRange
    );
    assert_eq!(
        from_str::<i8>("-129").unwrap_err().kind,
        GoalErrorKind::OutOfRange
    );
    assert_eq!(from_str("-128"), Ok(i8::MIN));
}

/// Compares our parser with the standard library's; where that returns infinity, ours returns out of range.
#[track_caller]
fn agrees(text: &str) {
    let ours = from_str::<f32>(text).map_or(f32::INFINITY, f32::abs);
    let theirs = text.parse::<f32>().unwrap().abs();
    assert_eq!(ours.to_bits(), theirs.to_bits(), "{text} as f32");
    let ours = from_str::<f64>(text).map_or(f64::INFINITY, f64::abs);
    let theirs = text.parse::<f64>().unwrap().abs();
    assert_eq!(ours.to_bits(), theirs.to_bits(), "{text} as f64");
}

#[test]
fn random_decimals_round_as_in_the_standard_library() {
    let mut random = Random::seeded();
    for _ in 0..100_000 {
        let digits = random.below(19) + 1;
        let mantissa = random.next() % 10u64.pow(digits as u32);
        let exponent = match random.below(4) {
            0 => random.below(700) as i32 - 350,
            1 => random.below(100) as i32 - 60,
            _ => random.below(24) as i32 - 16,
        };
        agrees(&std::format!("{mantissa}e{exponent}"));
    }
}

#[test]
fn every_float_reads_back_from_its_shortest_and_longest_text() {
    let mut random = Random::seeded();
    for _ in 0..20_000 {
        let bits = random.next();
        let (wide, narrow) = (f64::from_bits(bits), f32::from_bits(bits as u32));
        for text in [
            std::format!("{narrow}"),
            std::format!("{narrow:.8e}"),
            std::format!("{wide:?}"),
            std::format!("{wide:.16e}"),
        ] {
            if !text.contains(['i', 'N']) {
                agrees(&text);
            }
        }
    }
}

#[test]
fn a_tie_between_two_floats_goes_to_the_even_one() {
    let mut random = Random::seeded();
    let edges = [
        0u32,
        1,
        2,
        0x7f_ffff,
        0x80_0000,
        0x80_0001,
        0xff_ffff,
        0x100_0000,
        0x7f7f_fffe,
        0x4b7f_ffff,
    ];
    let bits: Vec<u32> = edges
        .into_iter()
        .chain((0..20_000).map(|_| random.next() as u32 % 0x7f7f_ffff))
        .collect();
    for bits in bits {
        // Exactly halfway: `f64` has enough digits.
        let low = f64::from(f32::from_bits(bits));
        let middle = (low + f64::from(f32::from_bits(bits + 1))) / 2.0;
        let text = std::format!("{middle:?}");
        if text.bytes().filter(u8::is_ascii_digit).count() <= 19 {
            agrees(&text);
        }
        // The neighbours of the middle, as shortest texts.
        for near in [middle.to_bits() - 1, middle.to_bits() + 1] {
            agrees(&std::format!("{:?}", f64::from_bits(near)));
        }
    }
    // Integers exactly halfway between two `f32`, then two `f64`.
    for text in [
        "16777217",
        "16777219",
        "33554434",
        "33554438",
        "9007199254740993",
        "9007199254740995",
        "18014398509481986",
        "1.000000059604644775390625",
        "340282356779733661637539395458142568447",
    ] {
        agrees(text);
    }
    // The largest and smallest floats, and values just beyond.
    for text in [
        "3.4028235e38",
        "3.4028236e38",
        "3.402823567e38",
        "1e38",
        "1e39",
        "1e-45",
        "7e-46",
        "7.1e-46",
        "1.17549435e-38",
        "1.1754943e-38",
        "1.7976931348623157e308",
        "1.7976931348623159e308",
        "5e-324",
        "2e-324",
        "2.5e-324",
        "2.2250738585072014e-308",
        "2.2250738585072011e-308",
    ] {
        agrees(text);
    }
}

#[test]
fn digits_after_the_nineteenth_break_ties_upwards() {
    // Halfway between two `f32`, and one bit above.
    agrees("16777217.0000000000000000000000000000000000001");
    agrees("16777217.0000000000000000000000000000000000000");
    agrees("0.1000000000000000055511151231257827021181583404541015625");
    let long = "1".repeat(100_000) + "e-99999";
    agrees(&long);
    let zeros = String::from("0.") + &"0".repeat(100_000) + "1e100001";
    agrees(&zeros);
    // More digits than fit, which is a float only in decimal.
    agrees(&"9".repeat(300));
    let hex = "0x".to_string() + &"f".repeat(60);
    let error = from_str::<f64>(&hex).unwrap_err();
    assert_eq!(error.kind, GoalErrorKind::OutOfRange);
    assert_eq!(from_str("0x1_0000_0000_0000_0000"), Ok(2f64.powi(64)));
}

#[test]
fn random_decimals_of_up_to_forty_digits_round_as_in_the_standard_library() {
    let mut random = Random::seeded();
    for _ in 0..10_000 {
        let digits = random.below(40) + 1;
        let digits: String = (0..digits)
            .map(|_| char::from(b'0' + random.below(10) as u8))
            .collect();
        let exponent = random.below(100) as i32 - 70;
        agrees(&std::format!("0.{digits}e{exponent}"));
    }
}

#[test]
fn the_shortest_text_is_as_short_as_in_the_standard_library_and_reads_back() {
    let mut random = Random::seeded();
    let mut buffer = [0xA5; 32];
    let powers = (0..2046u64).flat_map(|field| {
        let bits = field << 52;
        [bits, bits + 1, bits.saturating_sub(1)]
    });
    let wide: Vec<u64> = powers.chain((0..10_000).map(|_| random.next())).collect();
    for bits in wide {
        let value = f64::from_bits(bits);
        if value.is_finite() {
            let ours = to_slice(&value, &mut buffer).unwrap();
            as_good(
                ours,
                &std::format!("{value:e}"),
                &std::format!("{value:.17e}"),
            );
            assert_eq!(ours.parse::<f64>().unwrap().to_bits(), bits);
        }
    }
    let powers = (0..254u32).flat_map(|field| {
        let bits = field << 23;
        [bits, bits + 1, bits.saturating_sub(1)]
    });
    let random = (0..20_000).map(|_| random.next() as u32);
    let narrow: Vec<u32> = powers.chain(random).collect();
    for bits in narrow {
        let value = f32::from_bits(bits);
        if value.is_finite() {
            let ours = to_slice(&value, &mut buffer).unwrap();
            as_good(
                ours,
                &std::format!("{value:e}"),
                &std::format!("{value:.9e}"),
            );
            assert_eq!(ours.parse::<f32>().unwrap().to_bits(), bits);
        }
    }
}

/// Compares the digits of two texts. If both are equally near, ours may have the even one, like Python.
#[track_caller]
fn as_good(ours: &str, theirs: &str, exact: &str) {
    let [ours, theirs, exact] = [ours, theirs, exact].map(digits);
    let tie = exact
        .strip_suffix('5')
        .is_some_and(|rest| rest.len() == theirs.len());
    assert!(
        ours == theirs || tie && ours.len() == theirs.len() && exact.starts_with(&ours),
        "{ours} {theirs} {exact}"
    );
}

/// The significant digits of a text.
fn digits(text: &str) -> String {
    let mantissa = text.split('e').next().unwrap_or_default();
    let digits = mantissa.replace(['-', '.'], "");
    digits.trim_matches('0').to_string()
}

#[test]
fn fixed_decimals_are_written_as_in_the_standard_library() {
    let mut random = Random::seeded();
    let mut buffer = [0xA5; 400];
    for _ in 0..50_000 {
        let decimals = random.below(7);
        let value = match random.below(3) {
            // Often exactly halfway.
            0 => (random.below(20_000) as f32 - 10_000.0) / 16.0,
            1 => (random.below(20_000) as f32 - 10_000.0) / 1000.0,
            _ => f32::from_bits(random.next() as u32),
        };
        if !value.is_finite() || value.abs() > 1e9 {
            continue;
        }
        let mut theirs = std::format!("{value:.decimals$}");
        if !theirs.contains(|c: char| matches!(c, '1'..='9')) {
            theirs = theirs.replace('-', "");
        }
        let ours = to_slice_with(&value, Fixed(decimals as u8), &mut buffer);
        assert_eq!(ours, Ok(&*theirs), "{value}");
        let wide = f64::from(value);
        assert_eq!(
            to_slice_with(&wide, Fixed(decimals as u8), &mut buffer),
            Ok(&*theirs)
        );
    }
    for (value, decimals, text) in [
        (0.0, 2, "0.00"),
        (-0.0, 1, "0.0"),
        (-0.004, 2, "0.00"),
        (0.5, 0, "0"),
        (1.5, 0, "2"),
        (9.99, 1, "10.0"),
        (0.06, 1, "0.1"),
        (1e22, 1, "10000000000000000000000.0"),
        (1.0 / 3.0, 20, "0.33333333333333331000"),
        (1e-30, 3, "0.000"),
        (f64::INFINITY, 2, "inf"),
        (f64::NEG_INFINITY, 2, "-inf"),
        (f64::NAN, 2, "nan"),
        (-f64::NAN, 2, "nan"),
    ] {
        assert_eq!(
            to_slice_with(&value, Fixed(decimals), &mut buffer),
            Ok(text)
        );
    }
    assert_eq!(
        to_slice_with(&f64::MAX, Fixed(255), &mut [0xA5; 565])
            .unwrap()
            .len(),
        565
    );
}
