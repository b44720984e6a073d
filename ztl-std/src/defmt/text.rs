//! Formats a message's text with its values, following hints such as `{=u8:#x}`.

use std::fmt::Write;

use defmt_parser::{DisplayHint, Fragment, TimePrecision, Type};

use super::args::{Arg, Part, fragments};
use super::table::Table;

/// The formatted text.
pub(super) fn of(table: &Table, format: &str, args: &[Arg<'_>]) -> String {
    let mut printer = Printer {
        table,
        text: String::new(),
    };
    printer.part(format, args, None);
    printer.text
}

struct Printer<'t> {
    table: &'t Table,
    text: String,
}

impl Printer<'_> {
    /// `outer` is the hint of the value that holds this text.
    fn part(&mut self, format: &str, args: &[Arg<'_>], outer: Option<&DisplayHint>) {
        for fragment in fragments(format).unwrap_or_default() {
            match fragment {
                Fragment::Literal(literal) => self.text.push_str(&literal),
                Fragment::Parameter(parameter) => {
                    if let Some(arg) = args.get(parameter.index) {
                        let hint = parameter.hint.as_ref().or(outer);
                        self.arg(arg, &parameter.ty, hint, outer);
                    }
                }
            }
        }
    }

    fn arg(
        &mut self,
        arg: &Arg<'_>,
        of: &Type,
        hint: Option<&DisplayHint>,
        outer: Option<&DisplayHint>,
    ) {
        match arg {
            Arg::Bool(value) => self.show(format_args!("{value}")),
            // With a decimal point even if no digits follow, to tell it from an integer.
            Arg::Single(value) => self.show(format_args!("{value:?}")),
            Arg::Double(value) => self.show(format_args!("{value:?}")),
            Arg::Unsigned(value) => match (of, hint) {
                (Type::BitField(range), _) => {
                    let bits = u32::from(range.end) - u32::from(range.start.min(range.end));
                    let mask = u128::MAX.checked_shr(128 - bits).unwrap_or(0);
                    let field = value.checked_shr(range.start.into()).unwrap_or(0) & mask;
                    match hint {
                        Some(DisplayHint::Ascii) => {
                            let count = usize::try_from(bits.div_ceil(8)).unwrap_or(16).min(16);
                            let bytes = field.to_be_bytes();
                            self.bytes(bytes.get(16 - count..).unwrap_or_default(), hint);
                        }
                        _ => self.unsigned(field, hint),
                    }
                }
                // With `{:?}`, the surrounding hint decides how a number is written.
                (_, Some(DisplayHint::Debug)) => self.unsigned(*value, outer),
                _ => self.unsigned(*value, hint),
            },
            Arg::Signed(value, bits) => self.signed(*value, *bits, hint),
            Arg::Text(text) => match hint {
                Some(DisplayHint::Debug) => self.show(format_args!("{text:?}")),
                _ => self.text.push_str(text),
            },
            Arg::Bytes(bytes) => self.bytes(bytes, hint),
            Arg::Part(part) => {
                let hint = match outer {
                    Some(DisplayHint::Ascii) => outer,
                    _ => hint,
                };
                self.part(part.format, &part.args, hint);
            }
            Arg::Parts(parts) => {
                for part in parts {
                    self.part(part.format, &part.args, hint);
                }
            }
            Arg::List(parts) => match (hint, as_bytes(parts)) {
                (Some(DisplayHint::Ascii), Some(bytes)) => self.bytes(&bytes, hint),
                _ => self.list(parts, |printer, part| {
                    printer.part(part.format, &part.args, hint);
                }),
            },
        }
    }

    /// Writing to a string cannot fail.
    fn show(&mut self, what: std::fmt::Arguments<'_>) {
        let _ = self.text.write_fmt(what);
    }

    fn list<T>(&mut self, items: &[T], show: impl Fn(&mut Self, &T)) {
        self.text.push('[');
        for (place, item) in items.iter().enumerate() {
            if place > 0 {
                self.text.push_str(", ");
            }
            show(self, item);
        }
        self.text.push(']');
    }

    fn unsigned(&mut self, value: u128, hint: Option<&DisplayHint>) {
        match hint {
            Some(DisplayHint::Seconds(precision)) => {
                let (unit, digits) = unit(precision);
                let (whole, part) = (value / unit, value % unit);
                self.show(format_args!("{whole}.{part:0digits$}"));
            }
            Some(DisplayHint::Time(precision)) => self.time(value, precision),
            Some(DisplayHint::ISO8601(precision)) => self.date(value, precision),
            Some(DisplayHint::Bitflags {
                name,
                package,
                disambiguator,
                crate_name,
            }) => {
                let whose = (
                    name.clone(),
                    package.clone(),
                    disambiguator.clone(),
                    crate_name.clone(),
                );
                let is_set = |flag: &u128| match *flag {
                    0 => value == 0,
                    flag => value & flag == flag,
                };
                match self.table.flags(&whose) {
                    Some(flags) => {
                        let set: Vec<&str> = flags
                            .filter(|(_, flag)| is_set(flag))
                            .map(|(name, _)| name)
                            .collect();
                        match set.is_empty() {
                            true => self.text.push_str("(empty)"),
                            false => self.text.push_str(&set.join(" | ")),
                        }
                    }
                    None => self.show(format_args!("{value}")),
                }
            }
            _ => self.based(value, value, hint),
        }
    }

    fn signed(&mut self, value: i128, bits: u32, hint: Option<&DisplayHint>) {
        // Other bases show the value as stored in memory.
        let mask = u128::MAX.checked_shr(128 - bits).unwrap_or(0);
        self.based(value, value.cast_unsigned() & mask, hint);
    }

    fn based(&mut self, value: impl std::fmt::Display, bits: u128, hint: Option<&DisplayHint>) {
        match hint {
            Some(DisplayHint::NoHint { zero_pad }) => {
                self.show(format_args!("{value:0width$}", width = width(*zero_pad)));
            }
            Some(DisplayHint::Hexadecimal {
                alternate,
                uppercase,
                zero_pad,
            }) => {
                let width = width(*zero_pad);
                match (alternate, uppercase) {
                    (false, false) => self.show(format_args!("{bits:0width$x}")),
                    (false, true) => self.show(format_args!("{bits:0width$X}")),
                    (true, false) => self.show(format_args!("{bits:#0width$x}")),
                    (true, true) => self.show(format_args!("{bits:#0width$X}")),
                }
            }
            Some(DisplayHint::Octal {
                alternate,
                zero_pad,
            }) => {
                let width = width(*zero_pad);
                match alternate {
                    false => self.show(format_args!("{bits:0width$o}")),
                    true => self.show(format_args!("{bits:#0width$o}")),
                }
            }
            Some(DisplayHint::Binary {
                alternate,
                zero_pad,
            }) => {
                let width = width(*zero_pad);
                match alternate {
                    false => self.show(format_args!("{bits:0width$b}")),
                    true => self.show(format_args!("{bits:#0width$b}")),
                }
            }
            _ => self.show(format_args!("{value}")),
        }
    }

    fn bytes(&mut self, bytes: &[u8], hint: Option<&DisplayHint>) {
        match hint {
            Some(DisplayHint::Ascii) => {
                let shown = bytes.escape_ascii().to_string().replace("\\'", "'");
                self.show(format_args!("b\"{shown}\""));
            }
            Some(
                DisplayHint::Hexadecimal { .. }
                | DisplayHint::Octal { .. }
                | DisplayHint::Binary { .. },
            ) => self.list(bytes, |printer, byte| {
                printer.unsigned((*byte).into(), hint)
            }),
            _ => self.show(format_args!("{bytes:?}")),
        }
    }

    /// Hours, minutes and seconds, preceded by days if there are any.
    fn time(&mut self, value: u128, precision: &TimePrecision) {
        let (unit, digits) = unit(precision);
        let (seconds, part) = (value / unit, value % unit);
        let (days, seconds) = (seconds / 86_400, seconds % 86_400);
        if days > 0 {
            self.show(format_args!("{days}:"));
        }
        self.clock(seconds);
        if digits > 0 {
            self.show(format_args!(".{part:0digits$}"));
        }
    }

    fn clock(&mut self, seconds: u128) {
        let (hours, minutes, seconds) = (seconds / 3600, seconds / 60 % 60, seconds % 60);
        self.show(format_args!("{hours:02}:{minutes:02}:{seconds:02}"));
    }

    /// A date and time in UTC, from the time since 1970.
    fn date(&mut self, value: u128, precision: &TimePrecision) {
        let (unit, digits) = unit(precision);
        let (seconds, part) = (value / unit, value % unit);
        let (days, seconds) = (seconds / 86_400, seconds % 86_400);
        // In years that start in March, the leap day comes last, and 400 years always have 146,097 days.
        let days = days.saturating_add(719_468);
        let (era, day) = (days / 146_097, days % 146_097);
        let year = (day - day / 1460 + day / 36_524 - day / 146_096) / 365;
        let day = day - (365 * year + year / 4 - year / 100);
        let month = (5 * day + 2) / 153;
        let day = day - (153 * month + 2) / 5 + 1;
        let month = if month < 10 { month + 3 } else { month - 9 };
        let year = era * 400 + year + u128::from(month <= 2);
        self.show(format_args!("{year:04}-{month:02}-{day:02}T"));
        self.clock(seconds);
        if digits > 0 {
            self.show(format_args!(".{part:0digits$}"));
        }
        self.text.push('Z');
    }
}

/// Units per second, and digits after the point.
const fn unit(precision: &TimePrecision) -> (u128, usize) {
    match precision {
        TimePrecision::Micros => (1_000_000, 6),
        TimePrecision::Millis => (1000, 3),
        TimePrecision::Seconds => (1, 0),
    }
}

/// The width as the author requests, within limits.
fn width(zero_pad: usize) -> usize {
    zero_pad.min(256)
}

/// The parts as bytes, if they form a list of bytes.
fn as_bytes(parts: &[Part<'_>]) -> Option<Vec<u8>> {
    let byte = |part: &Part<'_>| match (part.format, part.args.as_slice()) {
        ("{=u8}", [Arg::Unsigned(value)]) => u8::try_from(*value).ok(),
        _ => None,
    };
    parts.iter().map(byte).collect()
}
