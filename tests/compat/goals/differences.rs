//! The listed differences between our reader and the two that it replaces, with the reasons.

use serde_json::{Value as Json, json};

use super::value::Value;

pub enum Reader {
    /// `ast.literal_eval`
    Python,
    /// `yaml.safe_load`
    Yaml,
}

/// A reader's result for a text.
pub enum Read {
    Refused,
    Nothing,
    Bool(bool),
    Integer(i64),
    Float(&'static str),
    Text(&'static str),
    /// As JSON with types.
    Told(&'static str),
}

pub struct Difference {
    pub why: &'static str,
    pub reader: Reader,
    /// A text, the other reader's result, and ours.
    pub examples: &'static [(&'static str, Read, Read)],
    /// Whether the text of this value may be read differently for this reason.
    pub excuses: fn(&Value) -> bool,
}

impl Read {
    /// Our expected result, with types.
    pub fn value(&self) -> Option<Json> {
        Some(match self {
            Self::Refused => return None,
            Self::Nothing => Json::Null,
            Self::Bool(value) => json!(value),
            Self::Integer(value) => json!({"int": value.to_string()}),
            Self::Float(text) => json!({"float": text}),
            Self::Text(text) => json!(text),
            Self::Told(told) => serde_json::from_str(told).expect("JSON"),
        })
    }

    /// As `generate.py` prints it.
    pub fn told(&self) -> Json {
        self.value().unwrap_or(json!({"error": null}))
    }
}

use Read::{Bool, Float, Integer, Nothing, Refused, Text, Told};
use Reader::{Python, Yaml};

pub const DIFFERENCES: &[Difference] = &[
    // Where the two read a text differently, Python wins.
    Difference {
        why: "words that Python writes for None and for floats",
        reader: Yaml,
        examples: &[
            ("None", Text("None"), Nothing),
            ("inf", Text("inf"), Float("inf")),
            ("-inf", Text("-inf"), Float("-inf")),
            ("nan", Text("nan"), Float("nan")),
        ],
        excuses: |value| {
            is_text(value, |text| {
                matches!(text, "None" | "inf" | "-inf" | "+inf" | "nan")
            })
        },
    },
    Difference {
        why: "floats of Python that YAML 1.1 takes for texts: without a point or an exponent's sign, \
              or a point right behind the sign",
        reader: Yaml,
        examples: &[
            ("1e3", Text("1e3"), Float("1000.0")),
            ("1.5e3", Text("1.5e3"), Float("1500.0")),
            ("-1e+16", Text("-1e+16"), Float("-1e+16")),
            ("-.0", Text("-.0"), Float("-0.0")),
            ("+.5", Text("+.5"), Float("0.5")),
        ],
        excuses: |value| {
            is_text(value, |text| {
                let unlike =
                    text.contains(['e', 'E']) || text.starts_with("-.") || text.starts_with("+.");
                unlike && text.replace('_', "").parse::<f64>().is_ok()
            })
        },
    },
    Difference {
        why: "integers of Python that YAML 1.1 does not know",
        reader: Yaml,
        examples: &[
            ("0o17", Text("0o17"), Integer(15)),
            ("0X1F", Text("0X1F"), Integer(31)),
            ("0B1", Text("0B1"), Integer(1)),
        ],
        excuses: |value| {
            is_text(value, |text| {
                let digits = text.trim_start_matches(['+', '-']);
                ["0o", "0O", "0X", "0B"]
                    .iter()
                    .any(|prefix| digits.starts_with(prefix))
            })
        },
    },
    Difference {
        why: "backslashes within single quotes are Python's escapes",
        reader: Yaml,
        examples: &[
            (
                r"['C:\\temp']",
                Told(r#"["C:\\\\temp"]"#),
                Told(r#"["C:\\temp"]"#),
            ),
            (r"['a\nb']", Told(r#"["a\\nb"]"#), Told(r#"["a\nb"]"#)),
            (r"['a\0']", Told(r#"["a\\0"]"#), Refused),
            (r"['a\']", Told(r#"["a\\"]"#), Refused),
        ],
        excuses: |value| is_text(value, |text| text.contains('\\')),
    },
    Difference {
        why: "parentheses make tuples, so in a plain text they come in pairs, with no comma within",
        reader: Yaml,
        examples: &[
            ("[(a), b]", Told(r#"["(a)", "b"]"#), Refused),
            ("[a), b]", Told(r#"["a)", "b"]"#), Refused),
            ("[a(, b]", Told(r#"["a(", "b"]"#), Refused),
            ("[(a, b)]", Told(r#"["(a", "b)"]"#), Told(r#"[["a", "b"]]"#)),
            ("[date(2020, 1)]", Told(r#"["date(2020", "1)"]"#), Refused),
        ],
        excuses: |value| is_text(value, |text| text.contains(['(', ')'])),
    },
    Difference {
        why: "Python's bytes are no text",
        reader: Yaml,
        examples: &[("[b'x']", Told(r#"["b'x'"]"#), Refused)],
        excuses: |value| {
            is_text(value, |text| {
                ["b'", "b\"", "B'", "B\""]
                    .iter()
                    .any(|bytes| text.starts_with(bytes))
            })
        },
    },
    // Traps of YAML 1.1, which affect the clients' YAML before a goal is sent.
    Difference {
        why: "words for bools are texts unless a bool is asked for: `on` is a fine goal",
        reader: Yaml,
        examples: &[
            ("yes", Bool(true), Text("yes")),
            ("no", Bool(false), Text("no")),
            ("[on, Off]", Told("[true, false]"), Told(r#"["on", "Off"]"#)),
        ],
        excuses: |_| false,
    },
    Difference {
        why: "numbers to the base 60, dates, and a leading 0 for octal numbers are texts",
        reader: Yaml,
        examples: &[
            ("1:30", Integer(90), Text("1:30")),
            ("1:30.5", Float("90.5"), Text("1:30.5")),
            ("010", Integer(8), Text("010")),
            ("1__0", Integer(10), Text("1__0")),
            (
                "2020-01-01",
                Told(r#"{"other": "datetime.date(2020, 1, 1)"}"#),
                Text("2020-01-01"),
            ),
        ],
        excuses: |_| false,
    },
    // What of YAML is not read.
    Difference {
        why: "keys marked by `?`, as YAML writes what is empty, long, or of several lines",
        reader: Yaml,
        examples: &[(
            "{? '' : 1}",
            Told(r#"{"dict": [["", {"int": "1"}]]}"#),
            Refused,
        )],
        excuses: |value| {
            let Value::Dict(pairs) = value else {
                return false;
            };
            let marked = |text: &str| {
                text.is_empty()
                    || text.len() > 100
                    || text.contains(['\n', '\u{85}', '\u{2028}', '\u{2029}'])
            };
            pairs.iter().any(|(key, _)| is_text(key, marked))
        },
    },
    Difference {
        why: "empty values, pairs within lists, plain texts of several lines",
        reader: Yaml,
        examples: &[
            (
                "{a: , b}",
                Told(r#"{"dict": [["a", null], ["b", null]]}"#),
                Refused,
            ),
            ("{a:1}", Told(r#"{"dict": [["a:1", null]]}"#), Refused),
            (
                "[a: 1]",
                Told(r#"[{"dict": [["a", {"int": "1"}]]}]"#),
                Refused,
            ),
            ("[a\n  b]", Told(r#"["a b"]"#), Refused),
        ],
        excuses: |_| false,
    },
    Difference {
        why: "comments, anchors, tags",
        reader: Yaml,
        examples: &[
            ("[a, # b\n c]", Told(r#"["a", "c"]"#), Refused),
            ("[&x a, *x]", Told(r#"["a", "a"]"#), Refused),
            ("[!!str 1]", Told(r#"["1"]"#), Refused),
        ],
        excuses: |_| false,
    },
    Difference {
        why: "texts stay what they are: the blanks of a goal, its empty text",
        reader: Yaml,
        examples: &[(" a ", Text("a"), Text(" a ")), ("", Nothing, Text(""))],
        excuses: |_| false,
    },
    Difference {
        why: "an escape of JSON's two halves makes the one character",
        reader: Yaml,
        // YAML's, and Python's, are two halves that no UTF-8 can hold.
        examples: &[(
            r#"["\ud83e\udd16"]"#,
            Told(r#"[{"other": "'\\ud83e\\udd16'"}]"#),
            Told(r#"["🤖"]"#),
        )],
        excuses: |_| false,
    },
    Difference {
        why: "numbers beyond 64 bits, and floats beyond the greatest",
        reader: Python,
        examples: &[
            (
                "[18446744073709551616]",
                Told(r#"[{"int": "18446744073709551616"}]"#),
                Refused,
            ),
            ("1e999", Float("inf"), Refused),
        ],
        excuses: |_| false,
    },
    Difference {
        why: "a plain text is a value",
        reader: Python,
        examples: &[
            ("[left]", Refused, Told(r#"["left"]"#)),
            ("{a b: -c}", Refused, Told(r#"{"dict": [["a b", "-c"]]}"#)),
        ],
        excuses: |_| false,
    },
    Difference {
        why: "what of Python's literals `repr` never writes",
        reader: Python,
        examples: &[
            ("[(1)]", Told(r#"[{"int": "1"}]"#), Refused),
            ("['a' 'b']", Told(r#"["ab"]"#), Refused),
            (r"['\012']", Told(r#"["\n"]"#), Refused),
            (r"['\N{BULLET}']", Told(r#"["•"]"#), Refused),
            (r#"["\d"]"#, Told(r#"["\\d"]"#), Refused),
            ("['''a''']", Told(r#"["a"]"#), Told(r#"["'a'"]"#)),
            ("[r'a']", Told(r#"["a"]"#), Told(r#"["r'a'"]"#)),
            ("[- 1]", Told(r#"[{"int": "-1"}]"#), Refused),
            (
                "[1, # b\n 2]",
                Told(r#"[{"int": "1"}, {"int": "2"}]"#),
                Refused,
            ),
        ],
        excuses: |_| false,
    },
    Difference {
        why: "within double quotes, YAML's escapes where Python has another or none",
        reader: Python,
        examples: &[
            (r#"["\012"]"#, Told(r#"["\n"]"#), Told(r#"["\u000012"]"#)),
            (r#"["\e\/"]"#, Told(r#"["\\e\\/"]"#), Told(r#"["\u001b/"]"#)),
        ],
        excuses: |_| false,
    },
    Difference {
        why: "what of Python's values serde has not",
        reader: Python,
        examples: &[
            ("{1, 2}", Told(r#"{"other": "{1, 2}"}"#), Refused),
            ("[b'x']", Told(r#"[{"other": "b'x'"}]"#), Refused),
            ("[1j]", Told(r#"[{"other": "1j"}]"#), Told(r#"["1j"]"#)),
            (
                "[...]",
                Told(r#"[{"other": "Ellipsis"}]"#),
                Told(r#"["..."]"#),
            ),
        ],
        excuses: |_| false,
    },
];

fn is_text(value: &Value, so: impl Fn(&str) -> bool) -> bool {
    matches!(value, Value::Text(text) if so(text))
}
