//! Parameters in the keys of a script: `step (wait=no, delay=2)` (wire specification 8.3), and the
//! defaults file.

use std::ops::RangeInclusive;
use std::path::Path;
use std::time::Duration;

use ztl_core::integer::Integer;
use ztl_yaml::{Diagnostics, closest};

use crate::model::{Defaults, OnFailure, OperatorGone};

/// Longest delay or limit, in seconds: a century or so.
const LONGEST: f64 = 4e9;

/// Shortest time that is not taken for a slip, in seconds.
const SHORTEST: f64 = 0.001;

/// How many seconds nobody may operate until something is stopped. A page is heard every 2 s.
const GONE: RangeInclusive<u64> = 5..=3600;

/// Most retries of a step.
const MOST_RETRIES: u32 = 100;

/// Names of parameters, which stand in parentheses.
pub(super) const NAMES: [&str; 7] = [
    "operator_gone",
    "delay",
    "wait",
    "timeout",
    "parallel",
    "on_failure",
    "remote",
];

/// What takes this parameter.
pub(super) fn taken_by(name: &str) -> Option<&'static str> {
    Some(match name {
        "delay" => "scene, step or component",
        "wait" | "timeout" => "step or component",
        "parallel" | "on_failure" => "step",
        "remote" => "handler",
        "operator_gone" => "scene or cue",
        "key" => "cue",
        _ => return None,
    })
}

/// A parsed key.
#[derive(Debug, Default)]
pub(super) struct Key<'k> {
    /// Before the parentheses, not trimmed.
    pub(super) name: &'k str,
    /// The parameters.
    pub(super) pieces: Vec<Piece<'k>>,
    /// What is wrong with the parentheses.
    pub(super) doubt: Option<&'static str>,
}

/// One parameter as it was written.
#[derive(Debug, Clone, Copy)]
pub(super) struct Piece<'k> {
    /// The whole of it, trimmed.
    pub(super) text: &'k str,
    /// `None` if it is neither `name` nor `name=value`.
    pub(super) name: Option<&'k str>,
    /// `None` without a `=`.
    pub(super) value: Option<&'k str>,
}

/// Splits a key at its parentheses as the original does, and the parameters at `,` or `;`.
pub(super) fn parse(key: &str) -> Key<'_> {
    let (open, close) = (key.find('('), key.find(')'));
    let (Some(open), Some(close)) = (open.filter(|o| *o > 0), close.filter(|c| *c > 0)) else {
        let doubt = match (open, close) {
            (Some(_), None) => Some(
                "the ')' is missing, so this is a part of the name; within { } write ';' between parameters, not ','",
            ),
            (None, None) if key.contains(['（', '）']) => {
                Some("these are not the parentheses ( and ), so this is a part of the name")
            }
            (None, Some(_)) => Some("the '(' is missing, so this is a part of the name"),
            (Some(0), _) => Some("nothing stands before the '(', so this is the name"),
            _ => None,
        };
        return Key {
            name: key,
            pieces: Vec::new(),
            doubt,
        };
    };
    let mut doubt = None;
    if close < open {
        doubt = Some("the ')' stands before the '(', so nothing is between them");
    } else if !key.get(close + 1..).unwrap_or_default().trim().is_empty() {
        doubt = Some("what stands after the ')' is dropped");
    }
    let text = key.get(open + 1..close).unwrap_or_default();
    let pieces = text
        .split([',', ';'])
        .map(str::trim)
        .filter(|text| !text.is_empty());
    let pieces = pieces.map(|text| match text.split_once('=') {
        None => Piece {
            text,
            name: Some(text),
            value: None,
        },
        Some((_, value)) if value.contains('=') => Piece {
            text,
            name: None,
            value: None,
        },
        Some((name, value)) => Piece {
            text,
            name: Some(name.trim()),
            value: Some(value.trim()),
        },
    });
    Key {
        name: key.get(..open).unwrap_or_default(),
        pieces: pieces.collect(),
        doubt,
    }
}

/// `2`, `1.5`: seconds, also below 0.
pub(super) fn seconds(text: &str) -> Result<f64, String> {
    let wrong = || format!("'{text}' is not a number of seconds; write 2 or 1.5");
    let whole = Integer::parse(text).is_ok();
    // Without the words that Python's float() takes: `inf`, `nan`, `infinity`.
    let plain: String = text.trim().chars().filter(|c| *c != '_').collect();
    let digits = plain
        .bytes()
        .all(|c| c.is_ascii_digit() || b".eE+-".contains(&c));
    let fraction = digits && !text.contains('_');
    let seconds: f64 = plain.parse().map_err(|_| wrong())?;
    if !whole && !fraction {
        return Err(wrong());
    }
    if seconds > LONGEST {
        return Err(format!("'{text}' seconds are more than a century"));
    }
    Ok(seconds)
}

/// A time to wait: zero for a negative one.
pub(super) fn delay(seconds: f64) -> Duration {
    Duration::try_from_secs_f64(seconds.max(0.0)).unwrap_or_default()
}

/// Whether a time is above 0, and too short to have been meant.
pub(super) fn is_too_short(seconds: f64) -> bool {
    seconds > 0.0 && seconds < SHORTEST
}

/// A time limit: `none` and 0 mean no limit.
pub(super) fn limit(text: &str) -> Result<Option<Duration>, String> {
    if text == "none" {
        return Ok(None);
    }
    let seconds = seconds(text)?;
    if seconds < 0.0 {
        return Err(format!(
            "'{text}' is below 0; write seconds, as 30, or none"
        ));
    }
    if is_too_short(seconds) {
        return Err(format!(
            "'{text}' seconds are less than a millisecond; write seconds, as 30, or none"
        ));
    }
    Ok(Some(delay(seconds)).filter(|limit| !limit.is_zero()))
}

/// The same in a defaults file, where 0 is a mistake: it would remove the limit of every task.
fn stated_limit(text: &str) -> Result<Option<Duration>, String> {
    match limit(text)? {
        None if text != "none" => {
            Err("a limit must be above 0 seconds; write seconds, as 30, or none".to_owned())
        }
        limit => Ok(limit),
    }
}

/// Whether a text is `true 1 t y yes on` in any case, and whether it is such a word or its opposite.
pub(super) fn truth(text: &str) -> (bool, bool) {
    let text = text.to_lowercase();
    let yes = matches!(text.as_str(), "true" | "1" | "t" | "y" | "yes" | "on");
    let no = matches!(text.as_str(), "false" | "0" | "f" | "n" | "no" | "off");
    (yes, yes || no)
}

/// `go on`, `stop 10`.
pub(super) fn operator_gone(text: &str) -> Result<OperatorGone, String> {
    let plain = text.to_lowercase();
    let words: Vec<&str> = plain.split_whitespace().collect();
    let seconds = match words.as_slice() {
        ["go", "on"] | ["go-on" | "go_on"] => return Ok(OperatorGone::GoOn),
        ["stop", seconds] => seconds.parse().ok(),
        _ => None,
    };
    let seconds = seconds.filter(|seconds| GONE.contains(seconds));
    let seconds = seconds.ok_or_else(|| {
        let (least, most) = (GONE.start(), GONE.end());
        format!("'{text}' is not known here; write go on, or stop 10: whole seconds from {least} to {most}")
    })?;
    Ok(OperatorGone::Stop(Duration::from_secs(seconds)))
}

/// A letter or digit.
pub(super) fn cue_key(text: &str) -> Result<char, String> {
    let mut chars = text.chars();
    match (chars.next(), chars.next()) {
        (Some(key), None) if key.is_ascii_alphanumeric() => Ok(key.to_ascii_lowercase()),
        _ => Err(format!(
            "'{text}' is not a key of a cue; write one letter or digit, as key=w"
        )),
    }
}

/// `ask`, `stop`, `go on`, `retry 3`.
pub(super) fn on_failure(text: &str) -> Result<OnFailure, String> {
    let plain = text.to_lowercase();
    let words: Vec<&str> = plain.split_whitespace().collect();
    match words.as_slice() {
        ["ask"] => Ok(OnFailure::Ask),
        ["stop"] => Ok(OnFailure::Stop),
        ["go", "on"] | ["go-on" | "go_on"] => Ok(OnFailure::GoOn),
        ["retry"] => Ok(OnFailure::Retry(1)),
        ["retry", count @ ..] => retries(&count.join(" ")),
        _ => {
            let known = ["ask", "stop", "go on", "retry 2"];
            Err(match closest(&plain, known) {
                Some(meant) => format!("'{text}' is not known here; did you mean '{meant}'?"),
                None => format!("'{text}' is not known here; there are: ask, stop, go on, retry N"),
            })
        }
    }
}

fn retries(count: &str) -> Result<OnFailure, String> {
    let digits = count.bytes().all(|byte| byte.is_ascii_digit());
    let number = count.parse().ok().filter(|_| digits);
    match number.filter(|number| (1..=MOST_RETRIES).contains(number)) {
        Some(number) => Ok(OnFailure::Retry(number)),
        None => Err(format!(
            "'{count}': a number of retries is a whole number from 1 to {MOST_RETRIES}; write retry 2"
        )),
    }
}

impl Defaults {
    /// Reads a defaults file: `timeout`, `on_failure`, `parallel`, `operator_gone`.
    ///
    /// # Errors
    /// Every mistake in it, with its place.
    pub fn load(path: &Path) -> Result<Self, Diagnostics> {
        let document = ztl_std::files::load_yaml(path)?;
        let mut reading = document.reading();
        let mut defaults = Self::default();
        let fields = reading.fields(document.root(), "timeout: 30");
        let read = fields.map(|mut fields| {
            if let Some(node) = fields.optional("timeout") {
                let limit = reading.parsed(node, "seconds, as 30, or none", stated_limit);
                defaults.timeout = limit.flatten();
            }
            if let Some(node) = fields.optional("on_failure") {
                let words = "ask, stop, go on or retry N";
                defaults.on_failure = reading.parsed(node, words, on_failure).unwrap_or_default();
            }
            if let Some(node) = fields.optional("parallel") {
                defaults.parallel = reading.truth(node).unwrap_or_default();
            }
            if let Some(node) = fields.optional("operator_gone") {
                let gone = reading.parsed(node, "go on, or stop 10", operator_gone);
                defaults.operator_gone = gone.unwrap_or_default();
            }
            fields.finish(&mut reading);
            defaults
        });
        reading.finish(read)
    }
}
