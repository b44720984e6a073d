//! A description in JSON that the compiler writes, so that firmware holds it as a constant and has no code for it.

use super::{ComponentDescription, Field, GoalRule};

/// The description of a component in JSON, as a `&'static str`: what [`ComponentDescription::json`] says, without spaces.
///
/// The compiler evaluates it and rejects a number of 2^53 or more, or with more than 9 decimals.
///
/// ```
/// use ztl_core::describe::{ComponentDescription, GoalRule};
/// use ztl_core::description;
///
/// const LAMP: &str = description!(ComponentDescription {
///     about: Some("lights the desk"),
///     ..ComponentDescription::new(GoalRule::words(&["on", "off"]))
/// });
/// assert_eq!(LAMP, r#"{"goal":{"one-of":["on","off"]},"about":"lights the desk"}"#);
/// ```
#[macro_export]
macro_rules! description {
    ($component:expr) => {{
        const COMPONENT: $crate::describe::ComponentDescription = $component;
        const LENGTH: usize = $crate::describe::text_len(&COMPONENT);
        const TEXT: [u8; LENGTH] = $crate::describe::text(&COMPONENT);
        const VALID: &str = match ::core::str::from_utf8(&TEXT) {
            Ok(text) => text,
            Err(_) => panic!("the texts of a description are UTF-8"),
        };
        VALID
    }};
}

/// The length of a description in JSON; for [`description!`](crate::description).
#[must_use]
pub const fn text_len(component: &ComponentDescription) -> usize {
    let mut counted = Writer::<0>::new();
    counted.component(component);
    counted.len
}

/// A description in JSON, of the length that [`text_len`] says; for [`description!`](crate::description).
///
/// # Panics
/// If a number is 2^53 or more, or has more than 9 decimals. A constant does not compile then.
#[must_use]
pub const fn text<const LENGTH: usize>(component: &ComponentDescription) -> [u8; LENGTH] {
    let mut written = Writer::<LENGTH>::new();
    written.component(component);
    written.bytes
}

/// Writes the first `N` bytes, and counts all.
struct Writer<const N: usize> {
    bytes: [u8; N],
    len: usize,
    /// Whether the next key is the first of its mapping.
    first: bool,
}

impl<const N: usize> Writer<N> {
    const fn new() -> Self {
        Self {
            bytes: [0; N],
            len: 0,
            first: true,
        }
    }

    const fn byte(&mut self, byte: u8) {
        if self.len < N {
            #[expect(clippy::indexing_slicing, reason = "the compiler evaluates it")]
            {
                self.bytes[self.len] = byte;
            }
        }
        self.len += 1;
    }

    const fn raw(&mut self, text: &str) {
        let mut rest = text.as_bytes();
        while let [byte, behind @ ..] = rest {
            self.byte(*byte);
            rest = behind;
        }
    }

    const fn quoted(&mut self, text: &str) {
        self.byte(b'"');
        let mut rest = text.as_bytes();
        while let [byte, behind @ ..] = rest {
            match *byte {
                b'"' | b'\\' => {
                    self.byte(b'\\');
                    self.byte(*byte);
                }
                0..=0x1f => {
                    self.raw("\\u00");
                    self.byte(b'0' + (*byte >> 4));
                    let low = *byte & 15;
                    self.byte(if low < 10 {
                        b'0' + low
                    } else {
                        b'a' - 10 + low
                    });
                }
                byte => self.byte(byte),
            }
            rest = behind;
        }
        self.byte(b'"');
    }

    const fn open(&mut self) {
        self.byte(b'{');
        self.first = true;
    }

    const fn close(&mut self) {
        self.byte(b'}');
        self.first = false;
    }

    const fn key(&mut self, key: &str) {
        if !self.first {
            self.byte(b',');
        }
        self.first = false;
        self.quoted(key);
        self.byte(b':');
    }

    const fn pair(&mut self, key: &str, text: Option<&str>) {
        if let Some(text) = text {
            self.key(key);
            self.quoted(text);
        }
    }

    const fn texts(&mut self, key: &str, texts: &[&str]) {
        self.key(key);
        self.byte(b'[');
        let mut rest = texts;
        while let [text, behind @ ..] = rest {
            self.quoted(text);
            if !behind.is_empty() {
                self.byte(b',');
            }
            rest = behind;
        }
        self.byte(b']');
    }

    /// Infinite bounds are left out, as JSON has none.
    const fn number(&mut self, key: &str, value: Option<f64>) {
        let Some(value) = value else { return };
        if !value.is_finite() {
            return;
        }
        self.key(key);
        if value < 0.0 {
            self.byte(b'-');
        }
        let value = value.abs();
        let (mut decimals, mut scale) = (0, 1.0);
        loop {
            assert!(
                decimals <= 9 && value * scale < (1u64 << 53) as f64,
                "a number of a description must be below 2^53, with at most 9 decimals"
            );
            let below = (value * scale) as u64;
            let digits = below + (value * scale - below as f64 >= 0.5) as u64;
            // Whoever reads the decimal number gets the same value.
            if digits as f64 / scale == value {
                return self.decimal(digits, decimals);
            }
            decimals += 1;
            scale *= 10.0;
        }
    }

    /// `number` with a decimal point before its last `decimals` digits.
    const fn decimal(&mut self, number: u64, decimals: u32) {
        let mut unit = 1;
        let mut left = 0;
        while left < decimals || number / unit >= 10 {
            unit *= 10;
            left += 1;
        }
        loop {
            self.byte(b'0' + (number / unit % 10) as u8);
            if left == 0 {
                return;
            }
            if left == decimals {
                self.byte(b'.');
            }
            unit /= 10;
            left -= 1;
        }
    }

    const fn whole(&mut self, key: &str, value: u64) {
        self.key(key);
        self.decimal(value, 0);
    }

    const fn component(&mut self, it: &ComponentDescription) {
        self.open();
        if !matches!(it.goal, GoalRule::Any) {
            self.key("goal");
            self.open();
            self.goal(&it.goal);
            self.close();
        }
        self.pair("about", it.about);
        if !it.examples.is_empty() {
            self.texts("examples", it.examples);
        }
        if !it.streams.is_empty() {
            self.texts("streams", it.streams);
        }
        self.pair("result", it.result);
        if !it.can_abort {
            self.key("abort");
            self.raw("false");
        }
        if let Some(ms) = it.usually_ms {
            self.whole("usually_ms", ms as u64);
        }
        self.close();
    }

    /// The pairs of a goal.
    const fn goal(&mut self, it: &GoalRule) {
        match it {
            GoalRule::Any => self.pair("type", Some("any")),
            GoalRule::Nothing => self.pair("type", Some("nothing")),
            GoalRule::Text { longest } => {
                self.pair("type", Some("text"));
                if let Some(longest) = longest {
                    self.whole("longest", *longest as u64);
                }
            }
            GoalRule::Number {
                whole,
                least,
                most,
                step,
                unit,
            } => {
                self.pair("type", Some(if *whole { "whole" } else { "number" }));
                self.number("least", *least);
                self.number("most", *most);
                self.number("step", *step);
                self.pair("unit", *unit);
            }
            GoalRule::Bool => self.pair("type", Some("truth")),
            GoalRule::OneOf(words) => self.texts("one-of", words),
            GoalRule::ListOf(item) => {
                self.key("list-of");
                self.open();
                self.goal(item.0);
                self.close();
            }
            GoalRule::Fields(fields) => {
                self.key("fields");
                self.byte(b'[');
                let mut rest: &[Field] = fields;
                while let [field, behind @ ..] = rest {
                    self.field(field);
                    if !behind.is_empty() {
                        self.byte(b',');
                    }
                    rest = behind;
                }
                self.byte(b']');
            }
        }
    }

    const fn field(&mut self, it: &Field) {
        self.open();
        self.pair("name", Some(it.name));
        self.goal(&it.rule);
        if it.optional {
            self.key("optional");
            self.raw("true");
        }
        self.pair("default", it.default);
        self.close();
    }
}

#[cfg(test)]
mod tests {
    use std::string::ToString;

    use super::*;

    const FIELDS: &[Field] = &[
        Field {
            name: "list",
            rule: GoalRule::list(&GoalRule::Number {
                whole: false,
                least: Some(-0.001),
                most: Some(1e300 * 1e300),
                step: Some(0.25),
                unit: Some("mm"),
            }),
            optional: true,
            default: Some("[]"),
        },
        Field {
            name: "which",
            rule: GoalRule::words(&["on", "off"]),
            optional: false,
            default: None,
        },
        Field {
            name: "text",
            rule: GoalRule::Text { longest: Some(10) },
            optional: false,
            default: None,
        },
    ];

    const FULL: ComponentDescription = ComponentDescription {
        about: Some("says \"it\" \\ \u{7} grüßt"),
        examples: &["a", "b"],
        result: Some("where it is"),
        streams: &["/pose"],
        can_abort: false,
        usually_ms: Some(1500),
        goal: GoalRule::fields(FIELDS),
    };

    #[test]
    fn the_compiler_writes_what_the_model_writes() {
        const FULL_TEXT: &str = description!(FULL);
        let fields = FULL
            .json()
            .to_string()
            .replace(", ", ",")
            .replace(": ", ":");
        assert_eq!(FULL_TEXT, fields);
        assert_eq!(description!(ComponentDescription::new(GoalRule::Any)), "{}");
        let (of_bool, of_nothing, of_whole) = (
            description!(ComponentDescription::new(GoalRule::Bool)),
            description!(ComponentDescription::new(GoalRule::Nothing)),
            description!(ComponentDescription::new(GoalRule::Number {
                whole: true,
                least: None,
                most: Some(9_007_199_254_740_991.0),
                step: None,
                unit: None,
            })),
        );
        assert_eq!(of_bool, r#"{"goal":{"type":"truth"}}"#);
        assert_eq!(of_nothing, r#"{"goal":{"type":"nothing"}}"#);
        let whole = r#"{"goal":{"type":"whole","most":9007199254740991}}"#;
        assert_eq!(of_whole, whole);
    }

    #[test]
    fn numbers_are_read_back_as_they_were() {
        for value in [
            0.0,
            1.0,
            10.0,
            0.1,
            100.25,
            3.6e6,
            0.000_000_001,
            -90.0,
            1.57,
        ] {
            let written = ComponentDescription::new(GoalRule::Number {
                whole: false,
                least: Some(value),
                most: None,
                step: None,
                unit: None,
            });
            let bytes: [u8; 100] = text(&written);
            let text = core::str::from_utf8(&bytes[..text_len(&written)]).unwrap();
            let (_, number) = text.split_once("\"least\":").unwrap();
            let number = number.trim_end_matches('}');
            assert_eq!(number.parse(), Ok(value), "{number}");
            assert!(!number.ends_with(".0"), "{number}");
        }
    }
}
