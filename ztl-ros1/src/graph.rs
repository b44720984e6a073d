//! What the master's lists say: types of topics, actions, and which nodes are those of `ztl`.

use std::collections::BTreeMap;

use crate::action::wire::STATUS_TYPE;
use crate::xmlrpc::Value;

/// Whether a node is one of `ztl`, of this or another process: such a node moves no robot.
pub(crate) fn is_ztl(node: &str) -> bool {
    let mut parts = node.rsplitn(3, '_');
    let is = |part: Option<&str>, fits: fn(char) -> bool| {
        part.is_some_and(|part| !part.is_empty() && part.chars().all(fits))
    };
    is(parts.next(), |c| c.is_ascii_hexdigit())
        && is(parts.next(), |c| c.is_ascii_digit())
        && parts
            .next()
            .is_some_and(|name| name == "/ztl" || name.starts_with("/ztl_"))
}

/// Reads a list of topics or services, each with a list of nodes.
pub(crate) fn lists(value: &Value) -> BTreeMap<String, Vec<String>> {
    let row = |row: &Value| match row.as_array()? {
        [name, nodes] => {
            let nodes = nodes.as_array()?.iter();
            let nodes = nodes.filter_map(|node| node.as_str().map(str::to_owned));
            Some((name.as_str()?.to_owned(), nodes.collect()))
        }
        _ => None,
    };
    let rows = value.as_array().unwrap_or_default();
    rows.iter().filter_map(row).collect()
}

/// Reads a list of pairs.
pub(crate) fn pairs(value: &Value) -> BTreeMap<String, String> {
    let pair = |row: &Value| match row.as_array()? {
        [name, ty] => Some((name.as_str()?.to_owned(), ty.as_str()?.to_owned())),
        _ => None,
    };
    value
        .as_array()
        .unwrap_or_default()
        .iter()
        .filter_map(pair)
        .collect()
}

/// The actions among published topics: those with a status of actionlib, and their types.
pub(crate) fn actions(topics: &BTreeMap<String, String>) -> BTreeMap<String, String> {
    let of = |(topic, ty): (&String, &String)| {
        let name = topic
            .strip_suffix("/status")
            .filter(|_| ty == STATUS_TYPE)?;
        let parts = [("/result", "Result"), ("/feedback", "Feedback")];
        let types = parts.iter().filter_map(|(part, suffix)| {
            topics.get(&format!("{name}{part}"))?.strip_suffix(suffix)
        });
        Some((
            name.to_owned(),
            types.into_iter().next().unwrap_or("*").to_owned(),
        ))
    };
    topics.iter().filter_map(of).collect()
}

/// The actions among published topics, as text.
pub(crate) fn action_names(topics: &BTreeMap<String, String>) -> Vec<String> {
    actions(topics)
        .into_iter()
        .map(|(name, ty)| format!("{name} ({ty})"))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nodes_of_ztl_are_known_by_their_names() {
        for name in ["/ztl_1_0000abcd", "/ztl_doctor_77_deadbeef"] {
            assert!(is_ztl(name), "{name}");
        }
        for name in [
            "/ztl",
            "/ztl_base",
            "/base_1_0000abcd",
            "/ztl_x_0000abcd",
            "/ztlx_1_0a",
        ] {
            assert!(!is_ztl(name), "{name}");
        }
    }

    #[test]
    fn actions_are_found_among_topics() {
        let topics = [
            ("/arm/move/status", STATUS_TYPE),
            (
                "/arm/move/result",
                "control_msgs/FollowJointTrajectoryActionResult",
            ),
            ("/odd/status", STATUS_TYPE),
            ("/battery/status", "std_msgs/String"),
        ];
        let topics = topics.map(|(name, ty)| (name.to_owned(), ty.to_owned()));
        assert_eq!(
            action_names(&topics.into()),
            [
                "/arm/move (control_msgs/FollowJointTrajectoryAction)",
                "/odd (*)"
            ]
        );
    }
}
