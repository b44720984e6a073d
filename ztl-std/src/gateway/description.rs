//! What the components of a device say of themselves.

use std::collections::BTreeMap;
use std::sync::Arc;

use ztl_link::{ComponentInfo, DeviceInfo};

use crate::describe::{self, ComponentDescription, GoalRule, described};

/// The descriptions of a device's components by name.
pub(super) type DeviceDescriptions = BTreeMap<String, ComponentDescription>;

/// What the components of the device `name` say of themselves.
pub(super) fn of_device(name: &str, device: &DeviceInfo) -> DeviceDescriptions {
    let all = device.components.iter().filter_map(|component| {
        let is = of_component(name, component)?;
        Some((component.name.clone(), is))
    });
    all.collect()
}

/// Completes what a component says by what it offers. One that says nothing is described if it offers only numbers, or
/// publishes something.
fn of_component(device: &str, offer: &ComponentInfo) -> Option<ComponentDescription> {
    let told = serde_json::from_slice(&offer.description).ok();
    let mut is = match told.as_ref().and_then(describe::component) {
        Some(is) => is,
        None if offer.range.is_some() && offer.words.is_empty() => described(GoalRule::Number {
            whole: false,
            least: None,
            most: None,
            step: None,
            unit: None,
        }),
        None if !offer.topics.is_empty() => described(GoalRule::Any),
        None => return None,
    };
    if let GoalRule::Number {
        least, most, unit, ..
    } = &mut is.goal
    {
        if least.is_none() && most.is_none() {
            let bounds = offer.range.map(|(least, most)| (exact(least), exact(most)));
            (*least, *most) = bounds.unzip();
        }
        if unit.is_none() && !offer.unit.is_empty() {
            *unit = Some(offer.unit.as_str().into());
        }
    }
    if is.streams.is_empty() {
        let topics = offer.topics.iter();
        let topics = topics.map(|topic| Arc::from(format!("{device}/{}/{topic}", offer.name)));
        is.streams = topics.collect();
    }
    Some(is)
}

/// The number that a person wrote: 0.1, not 0.10000000149.
fn exact(number: f32) -> f64 {
    number.to_string().parse().unwrap_or_else(|_| number.into())
}

#[cfg(test)]
mod tests {
    use ztl_core::link::{Busy, Loss};

    use super::*;

    fn shown(range: Option<(f32, f32)>, words: &str, description: &str) -> Option<String> {
        let offer = ComponentInfo {
            name: "pan".to_owned(),
            range,
            unit: "degrees".to_owned(),
            words: words.split_whitespace().map(str::to_owned).collect(),
            busy: Busy::Refuse,
            loss: Loss::Abort,
            topics: Vec::new(),
            description: description.as_bytes().to_vec(),
        };
        of_component("head", &offer).map(|is| is.json().to_string())
    }

    #[test]
    fn a_description_is_completed_by_the_offer() {
        let range = Some((-0.1, 90.0));
        let number = r#"{"goal":{"type":"number"},"about":"turns"}"#;
        let completed = r#"{"goal": {"type": "number", "least": -0.1, "most": 90, "unit": "degrees"}, "about": "turns"}"#;
        assert_eq!(shown(range, "", number).as_deref(), Some(completed));
        let own = r#"{"goal":{"type":"number","most":7,"unit":"turns"}}"#;
        let kept = r#"{"goal": {"type": "number", "most": 7, "unit": "turns"}}"#;
        assert_eq!(shown(range, "", own).as_deref(), Some(kept));
        let words = r#"{"goal":{"one-of":["left","right"]}}"#;
        let read = r#"{"goal": {"one-of": ["left", "right"]}}"#;
        assert_eq!(shown(range, "left right", words).as_deref(), Some(read));
    }

    #[test]
    fn a_component_that_says_nothing_is_described_if_it_offers_only_numbers() {
        let number = r#"{"goal": {"type": "number", "least": 0, "most": 1.5, "unit": "degrees"}}"#;
        // Also if what it says arrives in part, or is not a description.
        for nothing in ["", r#"{"goal":{"type":"te"#, "[7]", "\u{0}"] {
            assert_eq!(
                shown(Some((0.0, 1.5)), "", nothing).as_deref(),
                Some(number)
            );
            assert_eq!(shown(Some((0.0, 1.5)), "home", nothing), None);
            assert_eq!(shown(None, "on off", nothing), None);
        }
    }

    #[test]
    fn the_topics_of_readings_are_streams() {
        let offer = ComponentInfo {
            name: "probe".to_owned(),
            range: None,
            unit: String::new(),
            words: Vec::new(),
            busy: Busy::Refuse,
            loss: Loss::Abort,
            topics: vec!["heat".to_owned(), "light".to_owned()],
            description: Vec::new(),
        };
        let is = of_component("desk", &offer).expect("a description");
        let json =
            r#"{"goal": {"type": "any"}, "streams": ["desk/probe/heat", "desk/probe/light"]}"#;
        assert_eq!(is.json().to_string(), json);
    }
}
