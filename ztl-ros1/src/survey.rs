//! What is there: the nodes, topics, actions and services that a master knows.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::mpsc::Receiver;

use crate::action::wire::STATUS_TYPE;
use crate::node::{CallError, Node};
use crate::xmlrpc::Value;

/// Nodes that are asked at once.
const AT_ONCE: usize = 64;

/// What a master knows.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Survey {
    /// Topics with their types; the type of a topic without publishers may be `*`. Those that only `ztl` uses are left out.
    pub topics: BTreeMap<String, String>,
    /// Actions with their types, such as `control_msgs/FollowJointTrajectoryAction`.
    pub actions: BTreeMap<String, String>,
    /// The names of the nodes that publish a topic, without those of `ztl`.
    pub publishers: BTreeMap<String, Vec<String>>,
    /// The names of the nodes that subscribe to a topic, without those of `ztl`.
    pub subscribers: BTreeMap<String, Vec<String>>,
    /// Services, with the names of their nodes.
    pub servers: BTreeMap<String, Vec<String>>,
    /// Nodes with the addresses of their APIs, and what is wrong with each: its host name cannot be resolved here, or
    /// it does not answer.
    pub nodes: BTreeMap<String, (String, Option<String>)>,
}

impl Node {
    /// Asks the master what is there, and each node whether it lives. Blocks for up to some seconds for each 64 nodes of
    /// which one does not answer.
    ///
    /// # Errors
    /// If the master does not answer.
    pub fn survey(&self) -> Result<Survey, CallError> {
        let mut topics = pairs(&self.ask_master("getTopicTypes", &[])?);
        let mut published = pairs(&self.ask_master("getPublishedTopics", &["".into()])?);
        let state = self.ask_master("getSystemState", &[])?;
        let parts = state.as_array().unwrap_or_default();
        let lists: Vec<_> = parts.iter().map(lists).collect();
        let names: BTreeSet<_> = lists.iter().flat_map(BTreeMap::values).flatten().collect();
        let names: Vec<_> = names.into_iter().collect();
        let nodes = names.chunks(AT_ONCE);
        let nodes = nodes.flat_map(|names| self.look_at(names)).collect();
        let list = |index: usize| {
            let mut list = lists.get(index).cloned().unwrap_or_default();
            list.values_mut()
                .for_each(|nodes| nodes.retain(|node| !is_ztl(node)));
            list.retain(|_, nodes| !nodes.is_empty());
            list
        };
        let (publishers, subscribers) = (list(0), list(1));
        // The master remembers the types of topics that nobody uses any more.
        topics.retain(|topic, _| publishers.contains_key(topic) || subscribers.contains_key(topic));
        published.retain(|topic, _| publishers.contains_key(topic));
        Ok(Survey {
            actions: actions(&published),
            publishers,
            subscribers,
            servers: list(2),
            topics,
            nodes,
        })
    }

    /// The addresses of nodes, and what is wrong with each; asks all at once.
    fn look_at(&self, names: &[&String]) -> Vec<(String, (String, Option<String>))> {
        let answer =
            |of: Receiver<Result<Value, CallError>>| of.recv().unwrap_or(Err(CallError::Stopped));
        let find = |name: &&String| self.ask_soon(None, "lookupNode", &[name[..].into()]);
        let found: Vec<_> = names.iter().map(find).collect();
        let ask = |found| {
            let uri = answer(found)?.as_str().unwrap_or_default().to_owned();
            let lives = self.ask_soon(Some(uri.clone()), "getPid", &[]);
            Ok((uri, lives))
        };
        let asked: Vec<Result<_, CallError>> = found.into_iter().map(ask).collect();
        let state = |asked| match asked {
            Ok((uri, lives)) => (uri, answer(lives).err().map(|error| error.to_string())),
            Err(error) => (String::new(), Some(CallError::to_string(&error))),
        };
        let names = names.iter().map(|name| (*name).clone());
        names.zip(asked.into_iter().map(state)).collect()
    }
}

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
fn lists(value: &Value) -> BTreeMap<String, Vec<String>> {
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
fn actions(topics: &BTreeMap<String, String>) -> BTreeMap<String, String> {
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
