//! Scalars as PyYAML reads them, by the rules of YAML 1.1 (`docs/compatibility.md`, "YAML").

mod value;

use ztl_core::base64;

use crate::node::{CORE, Node, NodeValue};
pub use value::{Date, PythonValue, Timestamp, quoted};

/// Most digits of a whole number that Python writes as text.
const MAX_DIGITS: usize = ztl_core::integer::MAX_DIGITS;

/// Python's text of a scalar: PyYAML reads `010` as 8, and `on` as `True`. `None` for a collection.
///
/// # Errors
/// As [`read`].
#[must_use]
pub fn text(node: &Node) -> Option<Result<String, String>> {
    let NodeValue::Scalar { text, plain } = &node.value else {
        return None;
    };
    Some(read(text, *plain, node.tag.as_deref()).map(|value| value.to_string()))
}

/// Reads a scalar. The caller handles tags other than YAML's own.
///
/// # Errors
/// Why it has no value. PyYAML raises an exception there.
pub fn read(text: &str, plain: bool, tag: Option<&str>) -> Result<PythonValue, String> {
    match tag.and_then(|tag| tag.strip_prefix(CORE)) {
        Some(kind) => tagged(kind, text),
        None if plain || tag.is_some() => tagged(kind(text), text),
        None => tagged("str", text),
    }
}

/// Reads a scalar with one of YAML's tags.
fn tagged(kind: &str, text: &str) -> Result<PythonValue, String> {
    match kind {
        "str" => Ok(PythonValue::Text(text.to_owned())),
        "null" => Ok(PythonValue::Null),
        "bool" => truth(text),
        "int" => int(text),
        "float" => float(text),
        "timestamp" => timestamp(text),
        "binary" => binary(text),
        "merge" => Err("'<<' stands for a mapping's keys; as a text, put it in quotes".to_owned()),
        "value" => Err("a single '=' has a special meaning in YAML; put it in quotes".to_owned()),
        other => Err(format!(
            "the tag '!!{other}' is not allowed for a single value"
        )),
    }
}

/// The tag of a plain scalar by its form, tried in PyYAML's order.
fn kind(text: &str) -> &'static str {
    match text {
        "" | "~" | "null" | "Null" | "NULL" => "null",
        "<<" => "merge",
        "=" => "value",
        text if is_truth(text) => "bool",
        text if is_float(text) => "float",
        text if is_int(text) => "int",
        text if is_timestamp(text) => "timestamp",
        _ => "str",
    }
}

fn is_truth(text: &str) -> bool {
    let lower = text.to_ascii_lowercase();
    let known = matches!(
        lower.as_str(),
        "yes" | "no" | "true" | "false" | "on" | "off"
    );
    // `yes`, `Yes` or `YES`, but not `yEs`.
    let rest = text.get(1..).unwrap_or_default();
    let one_case = rest.bytes().all(|c| c.is_ascii_lowercase())
        || (text.bytes().all(|c| c.is_ascii_uppercase()));
    known && one_case
}

fn truth(text: &str) -> Result<PythonValue, String> {
    match text.to_lowercase().as_str() {
        "yes" | "true" | "on" => Ok(PythonValue::Bool(true)),
        "no" | "false" | "off" => Ok(PythonValue::Bool(false)),
        _ => Err(format!("'{text}' is neither true nor false")),
    }
}

/// The rest of a text, consumed from its front.
struct Rest<'t>(&'t str);

impl<'t> Rest<'t> {
    /// Takes the bytes of this kind.
    fn many(&mut self, is: impl Fn(u8) -> bool) -> &'t str {
        let len = self.0.bytes().take_while(|byte| is(*byte)).count();
        let (taken, rest) = self.0.split_at_checked(len).unwrap_or((self.0, ""));
        self.0 = rest;
        taken
    }

    /// Takes one of these characters.
    fn one(&mut self, of: &[char]) -> Option<char> {
        let first = self.0.chars().next().filter(|c| of.contains(c))?;
        self.0 = self.0.get(first.len_utf8()..).unwrap_or_default();
        Some(first)
    }

    /// Takes so many digits, or none if there are fewer.
    fn digits(&mut self, least: usize, most: usize) -> Option<&'t str> {
        let len = self
            .0
            .bytes()
            .take(most)
            .take_while(u8::is_ascii_digit)
            .count();
        if len < least {
            return None;
        }
        let (taken, rest) = self.0.split_at_checked(len)?;
        self.0 = rest;
        Some(taken)
    }
}

const fn digit_or_bar(byte: u8) -> bool {
    byte.is_ascii_digit() || byte == b'_'
}

/// Takes `:30`, `:05`, `:5`, up to the end or a point; returns whether there was one, and all are below 60.
fn sixties(rest: &mut Rest<'_>) -> bool {
    let mut any = false;
    while rest.one(&[':']).is_some() {
        match rest.many(|byte| byte.is_ascii_digit()).as_bytes() {
            [_] | [b'0'..=b'5', _] => any = true,
            _ => return false,
        }
    }
    any
}

fn is_float(text: &str) -> bool {
    let unsigned = text.strip_prefix(['-', '+']).unwrap_or(text);
    if matches!(unsigned, ".inf" | ".Inf" | ".INF") || matches!(text, ".nan" | ".NaN" | ".NAN") {
        return true;
    }
    // A number that begins with a point takes no sign.
    let mut rest = Rest(if unsigned.starts_with('.') {
        text
    } else {
        unsigned
    });
    let begins_with_digit = rest.0.starts_with(|c: char| c.is_ascii_digit());
    if begins_with_digit {
        rest.many(digit_or_bar);
        if rest.0.starts_with(':') {
            let seconds = sixties(&mut rest) && rest.one(&['.']).is_some();
            rest.many(digit_or_bar);
            return seconds && rest.0.is_empty();
        }
    }
    if rest.one(&['.']).is_none() {
        return false;
    }
    if !begins_with_digit && !rest.0.starts_with(|c: char| c.is_ascii_digit()) {
        return false;
    }
    rest.many(digit_or_bar);
    if rest.one(&['e', 'E']).is_some()
        && (rest.one(&['-', '+']).is_none() || rest.digits(1, usize::MAX).is_none())
    {
        return false;
    }
    rest.0.is_empty()
}

fn is_int(text: &str) -> bool {
    let unsigned = text.strip_prefix(['-', '+']).unwrap_or(text);
    let all = |digits: &str, is: fn(u8) -> bool| !digits.is_empty() && digits.bytes().all(is);
    if let Some(bits) = unsigned.strip_prefix("0b") {
        return all(bits, |byte| matches!(byte, b'0' | b'1' | b'_'));
    }
    if let Some(digits) = unsigned.strip_prefix("0x") {
        return all(digits, |byte| byte.is_ascii_hexdigit() || byte == b'_');
    }
    if let Some(octal) = unsigned.strip_prefix('0') {
        return octal.is_empty() || all(octal, |byte| matches!(byte, b'0'..=b'7' | b'_'));
    }
    let mut rest = Rest(unsigned);
    let first = unsigned.starts_with(|c: char| c.is_ascii_digit());
    rest.many(digit_or_bar);
    first && (rest.0.is_empty() || (sixties(&mut rest) && rest.0.is_empty()))
}

fn int(text: &str) -> Result<PythonValue, String> {
    let wrong = || format!("invalid whole number '{text}'");
    let too_long = || format!("a whole number has at most {MAX_DIGITS} digits");
    let plain = text.replace('_', "");
    let (mut negative, digits) = match plain.strip_prefix('-') {
        Some(digits) => (true, digits),
        None => (false, plain.strip_prefix('+').unwrap_or(&plain)),
    };
    let mut number = Decimal::default();
    let (radix, body) = match digits {
        "0" => (10, "0"),
        digits if digits.starts_with("0b") => (2, digits.get(2..).unwrap_or_default()),
        digits if digits.starts_with("0x") => (16, digits.get(2..).unwrap_or_default()),
        digits if digits.starts_with('0') => (8, digits),
        digits => (10, digits),
    };
    // As `int()`, which takes spaces of any kind and another sign.
    let mut body = body.trim();
    if let Some(signed) = body.strip_prefix(['-', '+']) {
        negative ^= body.starts_with('-');
        body = signed;
    }
    if body.is_empty() {
        return Err(wrong());
    }
    for (place, part) in body.split(':').enumerate() {
        if place > 0 {
            // Base 60: each part is a whole number of its own.
            let part: u32 = part
                .trim()
                .parse()
                .ok()
                .filter(|_| radix == 10)
                .ok_or_else(wrong)?;
            number.times_plus(60, part);
            continue;
        }
        if part.is_empty() {
            return Err(wrong());
        }
        for c in part.chars() {
            number.times_plus(radix, c.to_digit(radix).ok_or_else(wrong)?);
        }
        if number.too_long() {
            return Err(too_long());
        }
    }
    let digits = number.text();
    if digits.len() > MAX_DIGITS {
        return Err(too_long());
    }
    let minus = if negative && digits != "0" { "-" } else { "" };
    Ok(PythonValue::Int(format!("{minus}{digits}")))
}

/// A whole number: nine decimal digits per piece, the lowest first.
#[derive(Default)]
struct Decimal(Vec<u32>);

const PIECE: u64 = 1_000_000_000;

impl Decimal {
    fn times_plus(&mut self, factor: u32, plus: u32) {
        if self.too_long() {
            return;
        }
        let mut carry = u64::from(plus);
        for piece in &mut self.0 {
            let value = u64::from(*piece) * u64::from(factor) + carry;
            *piece = u32::try_from(value % PIECE).unwrap_or(0);
            carry = value / PIECE;
        }
        if carry > 0 {
            self.0.push(u32::try_from(carry).unwrap_or(0));
        }
    }

    /// Whether it is certainly too long, so that the work has a limit.
    fn too_long(&self) -> bool {
        self.0.len() * 9 > MAX_DIGITS + 9
    }

    fn text(&self) -> String {
        let mut pieces = self.0.iter().rev();
        let mut text = pieces.next().map_or_else(|| "0".to_owned(), u32::to_string);
        pieces.for_each(|piece| text += &format!("{piece:09}"));
        text
    }
}

fn float(text: &str) -> Result<PythonValue, String> {
    let wrong = || format!("invalid number '{text}'");
    let plain = text.replace('_', "").to_lowercase();
    let (sign, number) = match plain.strip_prefix('-') {
        Some(number) => (-1.0, number),
        None => (1.0, plain.strip_prefix('+').unwrap_or(&plain)),
    };
    let part = |text: &str| {
        let known = !text.is_empty()
            && text
                .bytes()
                .all(|c| c.is_ascii_digit() || b".e+-".contains(&c));
        text.parse::<f64>().ok().filter(|_| known)
    };
    let value = match number {
        ".inf" => f64::INFINITY,
        ".nan" => f64::NAN,
        number if number.contains(':') => {
            let (mut value, mut base) = (0.0, 1.0);
            for text in number.split(':').rev() {
                value += part(text).ok_or_else(wrong)? * base;
                base *= 60.0;
            }
            value
        }
        number => part(number).ok_or_else(wrong)?,
    };
    Ok(PythonValue::Float(sign * value))
}

fn is_timestamp(text: &str) -> bool {
    moment(text).is_some_and(|moment| moment.time.is_some() || text.len() == 10)
}

/// The parts of a timestamp, as written.
struct Moment<'t> {
    day: [&'t str; 3],
    /// Hour, minute, second; fraction; zone.
    time: Option<([&'t str; 3], &'t str, Zone<'t>)>,
}

enum Zone<'t> {
    None,
    Utc,
    Offset(bool, &'t str, &'t str),
}

fn moment(text: &str) -> Option<Moment<'_>> {
    let mut rest = Rest(text);
    let year = rest.digits(4, 4)?;
    rest.one(&['-'])?;
    let month = rest.digits(1, 2)?;
    rest.one(&['-'])?;
    let day = [year, month, rest.digits(1, 2)?];
    if rest.0.is_empty() {
        return Some(Moment { day, time: None });
    }
    if rest.one(&['T', 't']).is_none() && rest.many(is_blank).is_empty() {
        return None;
    }
    let hour = rest.digits(1, 2)?;
    rest.one(&[':'])?;
    let minute = rest.digits(2, 2)?;
    rest.one(&[':'])?;
    let clock = [hour, minute, rest.digits(2, 2)?];
    let fraction = match rest.one(&['.']) {
        Some(_) => rest.many(|byte| byte.is_ascii_digit()),
        None => "",
    };
    if rest.0.is_empty() {
        return Some(Moment {
            day,
            time: Some((clock, fraction, Zone::None)),
        });
    }
    rest.many(is_blank);
    let zone = match rest.one(&['Z', '-', '+'])? {
        'Z' => Zone::Utc,
        sign => {
            let hours = rest.digits(1, 2)?;
            let minutes = match rest.one(&[':']) {
                Some(_) => rest.digits(2, 2)?,
                None => "0",
            };
            Zone::Offset(sign == '-', hours, minutes)
        }
    };
    rest.0.is_empty().then_some(Moment {
        day,
        time: Some((clock, fraction, zone)),
    })
}

const fn is_blank(byte: u8) -> bool {
    matches!(byte, b' ' | b'\t')
}

fn timestamp(text: &str) -> Result<PythonValue, String> {
    let none = || {
        format!(
            "'{text}' looks like a date, and there is no such day or time; as a text, put it in quotes"
        )
    };
    let Moment {
        day: [year, month, day],
        time,
    } = moment(text).ok_or_else(none)?;
    let small = |digits: &str| digits.parse::<u8>().ok();
    let date = (|| Date::new(year.parse().ok()?, small(month)?, small(day)?))().ok_or_else(none)?;
    let Some(([hour, minute, second], fraction, zone)) = time else {
        return Ok(PythonValue::Date(date));
    };
    let clock = (|| {
        let clock = (small(hour)?, small(minute)?, small(second)?);
        (clock.0 < 24 && clock.1 < 60 && clock.2 < 60).then_some(clock)
    })();
    let fraction: String = fraction.chars().chain("000000".chars()).take(6).collect();
    let offset = match zone {
        Zone::None => None,
        Zone::Utc => Some(0),
        Zone::Offset(west, hours, minutes) => {
            let minutes = (|| Some(i32::from(small(hours)?) * 60 + i32::from(small(minutes)?)))();
            let minutes = minutes
                .filter(|minutes| *minutes < 24 * 60)
                .ok_or_else(none)?;
            Some(if west { -minutes } else { minutes })
        }
    };
    Ok(PythonValue::Time(Timestamp {
        date,
        clock: clock.ok_or_else(none)?,
        micros: fraction.parse().unwrap_or(0),
        offset,
    }))
}

fn binary(text: &str) -> Result<PythonValue, String> {
    if !text.is_ascii() {
        return Err("invalid base64: not ASCII".to_owned());
    }
    let mut buffer = vec![0; text.len()];
    match base64::decode(text.as_bytes(), &mut buffer) {
        Ok(bytes) => Ok(PythonValue::Bytes(bytes.to_vec())),
        Err(error) => Err(format!("invalid base64: {error}")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_whole_number_is_as_long_as_python_writes_it() {
        let longest = "9".repeat(MAX_DIGITS);
        assert_eq!(int(&longest), Ok(PythonValue::Int(longest.clone())));
        assert!(int(&format!("-{longest}")).is_ok());
        let hex = "f".repeat(MAX_DIGITS * 5 / 6 + 5);
        for longer in [
            format!("{longest}9"),
            format!("1_{longest}"),
            format!("0x{hex}"),
        ] {
            let wrong = int(&longer).expect_err("too long");
            assert_eq!(wrong, "a whole number has at most 4300 digits");
        }
    }

    #[test]
    fn a_tagged_whole_number_may_have_spaces_and_signs_like_pythons_int() {
        for (text, number) in [
            ("\u{a0}010", "10"),
            ("010\u{a0}", "8"),
            ("-\u{2003}-5", "5"),
            ("0x+f", "15"),
            ("1: 2", "62"),
        ] {
            assert_eq!(
                int(text),
                Ok(PythonValue::Int(number.to_owned())),
                "{text:?}"
            );
        }
        for text in ["", "\u{a0}", "- ", "--5 5", "0x"] {
            assert!(int(text).is_err(), "{text:?}");
        }
    }
}
