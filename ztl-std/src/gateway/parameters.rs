//! What clients ask about the parameters of a device, and the answers, as `ztl param` shows them.

use serde::{Deserialize, Serialize};
use ztl_core::goal;
use ztl_core::link::parameter::{Domain, Kept};
use ztl_link::{DeviceInfo, ParameterInfo, ParameterValue};
use ztl_yaml::closest;

use crate::terminal::quoted;

/// The component of a device under which its gateway answers requests about parameters. Its goals are the
/// [`ParameterGoal`]s.
pub const PARAMETERS: &str = "$param";

/// A request about the parameters of a device, as a goal: `list`, `save`, `{'get': 'finger.speed'}`,
/// `{'set': ['finger.speed', '80']}`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ParameterGoal {
    /// All of them; the result is a list of [`ParameterReport`]s in JSON.
    List,
    /// The one of this name; the result is a [`ParameterReport`] in JSON.
    Get(String),
    /// Set the one of this name to this value; the result is as for [`Get`](Self::Get).
    Set(String, String),
    /// Save all values, so that a restart of the device keeps them.
    Save,
}

impl ParameterGoal {
    /// The goal's text.
    #[must_use]
    pub fn to_text(&self) -> String {
        let mut text = Vec::new();
        // It has two levels at most.
        let _ = goal::to_sink(self, &mut |bytes: &[u8]| text.extend_from_slice(bytes));
        String::from_utf8_lossy(&text).into_owned()
    }

    /// Reads a goal.
    ///
    /// # Errors
    /// What would be right.
    pub(super) fn parse(text: &str) -> Result<Self, String> {
        let mut scratch = vec![0; text.len() * 2];
        goal::from_str_with(text, &mut scratch).map_err(|error| {
            format!(
                "{PARAMETERS} takes list, save, {{'get': NAME}} or {{'set': [NAME, VALUE]}}: {error}"
            )
        })
    }
}

/// A parameter, as its device describes it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ParameterReport {
    /// Its name with its component, such as `finger.speed`; without a component if it belongs to the firmware as a whole.
    pub name: String,
    /// `bool`, `u32`, `i32`, `f32` or `text`.
    #[serde(rename = "type")]
    pub kind: String,
    /// The smallest number that it takes.
    pub least: Option<ReportedValue>,
    /// The largest number that it takes, or the greatest length of a text in bytes.
    pub most: Option<ReportedValue>,
    /// Unit of the numbers.
    pub unit: String,
    /// Its value until it is set.
    pub default: ReportedValue,
    /// Its value now.
    pub value: ReportedValue,
    /// What happens to the value when the device restarts: `saved`, it is kept; `changed`, the value saved before replaces
    /// it; `never`, the default replaces it. `replaced`: it is the default already, because the saved value did not fit.
    pub kept: String,
    /// What it means.
    pub about: String,
}

/// A value in JSON.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum ReportedValue {
    /// A switch.
    Bool(bool),
    /// A whole number.
    Whole(i64),
    /// A number that is finite.
    Number(f32),
    /// A text, or a number that is not finite.
    Text(String),
}

impl std::fmt::Display for ReportedValue {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Bool(on) => on.fmt(f),
            Self::Whole(number) => number.fmt(f),
            Self::Number(number) => number.fmt(f),
            Self::Text(text) => text.fmt(f),
        }
    }
}

impl From<f32> for ReportedValue {
    fn from(number: f32) -> Self {
        if number.is_finite() {
            Self::Number(number)
        } else {
            Self::Text(number.to_string())
        }
    }
}

impl From<&ParameterValue> for ReportedValue {
    fn from(value: &ParameterValue) -> Self {
        match value {
            ParameterValue::Bool(on) => Self::Bool(*on),
            ParameterValue::U32(number) => Self::Whole((*number).into()),
            ParameterValue::I32(number) => Self::Whole((*number).into()),
            ParameterValue::F32(number) => (*number).into(),
            ParameterValue::Text(text) => Self::Text(text.clone()),
        }
    }
}

impl ParameterReport {
    pub(super) fn new(device: &DeviceInfo, info: &ParameterInfo) -> Self {
        let whole = |number: i64| Some(ReportedValue::Whole(number));
        let (kind, least, most) = match info.domain {
            Domain::Bool => ("bool", None, None),
            Domain::U32 { least, most } => ("u32", whole(least.into()), whole(most.into())),
            Domain::I32 { least, most } => ("i32", whole(least.into()), whole(most.into())),
            Domain::F32 { least, most } => ("f32", Some(least.into()), Some(most.into())),
            Domain::Text { longest } => ("text", None, whole(longest.into())),
        };
        let kept = match info.kept {
            Kept::Never => "never",
            Kept::Saved => "saved",
            Kept::Changed => "changed",
            Kept::Replaced => "replaced",
        };
        Self {
            name: full_name(device, info),
            kind: kind.to_owned(),
            least,
            most,
            unit: info.unit.clone(),
            default: (&info.default).into(),
            value: (&info.value).into(),
            kept: kept.to_owned(),
            about: info.about.clone(),
        }
    }
}

/// A parameter's name with its component.
pub(super) fn full_name(device: &DeviceInfo, info: &ParameterInfo) -> String {
    let component = info
        .component
        .and_then(|index| device.components.get(index));
    match component {
        Some(component) => format!("{}.{}", component.name, info.name),
        None => info.name.clone(),
    }
}

/// The index of the parameter of this name: with its component, or without if no other has the same. While the device has
/// more parameters than are known, that of the next to read.
///
/// # Errors
/// Which there are.
pub(super) fn find(device: &DeviceInfo, name: &str) -> Result<usize, String> {
    let known = &device.known_parameters;
    let full: Vec<String> = known.iter().map(|info| full_name(device, info)).collect();
    if let Some(index) = full.iter().position(|full| full == name) {
        return Ok(index);
    }
    if known.is_empty() || known.len() < device.parameters.into() {
        return Ok(known.len());
    }
    let mut same =
        (0..known.len()).filter(|index| known.get(*index).is_some_and(|it| it.name == name));
    let names = full.iter().map(String::as_str);
    match (same.next(), same.next()) {
        (Some(index), None) => Ok(index),
        (Some(_), Some(_)) => {
            let same = names.filter(|full| full.ends_with(&format!(".{name}")));
            let same: Vec<&str> = same.collect();
            Err(format!(
                "'{name}' is ambiguous; there are: {}",
                same.join(", ")
            ))
        }
        (None, _) => {
            let short = known.iter().map(|info| info.name.as_str());
            let hint = match closest(name, names.clone().chain(short)) {
                Some(meant) => format!("did you mean '{meant}'?"),
                None => format!("there are: {}", names.collect::<Vec<_>>().join(", ")),
            };
            Err(format!("no parameter '{}'; {hint}", quoted(name)))
        }
    }
}

/// Reads a value for a parameter.
///
/// # Errors
/// What would be right.
pub(super) fn read_value(
    name: &str,
    info: &ParameterInfo,
    text: &str,
) -> Result<ParameterValue, String> {
    let read = match info.domain {
        Domain::Bool => goal::from_str(text).ok().map(ParameterValue::Bool),
        Domain::U32 { .. } => goal::from_str(text).ok().map(ParameterValue::U32),
        Domain::I32 { .. } => goal::from_str(text).ok().map(ParameterValue::I32),
        Domain::F32 { .. } => goal::from_str(text).ok().map(ParameterValue::F32),
        Domain::Text { .. } => Some(ParameterValue::Text(text.to_owned())),
    };
    let fits = |value: &ParameterValue| info.domain.check(&value.as_value()).is_ok();
    read.filter(fits).ok_or_else(|| {
        let unit = &info.unit;
        let takes = match info.domain {
            Domain::Bool => "true or false".to_owned(),
            Domain::U32 { least, most } => format!("a whole number from {least} to {most} {unit}"),
            Domain::I32 { least, most } => format!("a whole number from {least} to {most} {unit}"),
            Domain::F32 { least, most } => format!("a number from {least} to {most} {unit}"),
            Domain::Text { longest } => format!("a text of at most {longest} bytes"),
        };
        format!("{name} takes {}, not '{}'", takes.trim_end(), quoted(text))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn info(component: Option<usize>, name: &str, domain: Domain) -> ParameterInfo {
        ParameterInfo {
            component,
            name: name.to_owned(),
            unit: "mm".to_owned(),
            about: String::new(),
            kept: Kept::Saved,
            domain,
            default: ParameterValue::Bool(false),
            value: ParameterValue::Bool(false),
        }
    }

    #[test]
    fn goals_are_read_as_they_are_written() {
        for (goal, text) in [
            (ParameterGoal::List, "list"),
            (ParameterGoal::Save, "save"),
            (ParameterGoal::Get("a.b".to_owned()), "{'get': 'a.b'}"),
            (
                ParameterGoal::Set("a".to_owned(), "it's \"1\"\n".to_owned()),
                r#"{'set': ['a', 'it\'s "1"\n']}"#,
            ),
        ] {
            assert_eq!(goal.to_text(), text);
            assert_eq!(ParameterGoal::parse(text), Ok(goal));
        }
        let typed = ParameterGoal::parse("{set: [speed, 80]}");
        assert_eq!(
            typed,
            Ok(ParameterGoal::Set("speed".to_owned(), "80".to_owned()))
        );
        let wrong = ParameterGoal::parse("reset").expect_err("no such goal");
        assert!(
            wrong.starts_with("$param takes list, save, {'get': NAME}"),
            "{wrong}"
        );
    }

    #[test]
    fn a_value_that_does_not_fit_says_what_does() {
        let percent = Domain::F32 {
            least: 0.5,
            most: 100.0,
        };
        for (domain, text, value) in [
            (percent, "0.5", Ok(ParameterValue::F32(0.5))),
            (percent, "1e2", Ok(ParameterValue::F32(100.0))),
            (percent, "nan", Err("a number from 0.5 to 100 mm")),
            (percent, "fast", Err("a number from 0.5 to 100 mm")),
            (Domain::Bool, "on", Ok(ParameterValue::Bool(true))),
            (Domain::Bool, "1", Err("true or false")),
            (
                Domain::U32 { least: 1, most: 9 },
                "9",
                Ok(ParameterValue::U32(9)),
            ),
            (
                Domain::U32 { least: 1, most: 9 },
                "-1",
                Err("a whole number from 1 to 9 mm"),
            ),
            (
                Domain::I32 { least: -1, most: 9 },
                "-1",
                Ok(ParameterValue::I32(-1)),
            ),
            (
                Domain::I32 { least: -1, most: 9 },
                "1.0",
                Err("a whole number from -1 to 9 mm"),
            ),
            (
                Domain::Text { longest: 3 },
                "on",
                Ok(ParameterValue::Text("on".to_owned())),
            ),
            (
                Domain::Text { longest: 3 },
                "offs",
                Err("a text of at most 3 bytes"),
            ),
        ] {
            let takes = |takes| format!("it takes {takes}, not '{text}'");
            let read = read_value("it", &info(None, "it", domain), text);
            assert_eq!(read, value.map_err(takes));
        }
    }
}
