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
    /// Topics with their types; the type of a topic without publishers may be `*`.
    pub topics: BTreeMap<String, String>,
    /// Actions with their types, such as `control_msgs/FollowJointTrajectoryAction`.
    pub actions: BTreeMap<String, String>,
    /// The names of the nodes that publish a topic.
    pub publishers: BTreeMap<String, Vec<String>>,
    /// Services.
    pub services: Vec<String>,
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
        let topics = pairs(&self.ask_master("getTopicTypes", &[])?);
        let published = pairs(&self.ask_master("getPublishedTopics", &["".into()])?);
        let state = self.ask_master("getSystemState", &[])?;
        let parts = state.as_array().unwrap_or_default();
        let lists: Vec<_> = parts.iter().map(lists).collect();
        let names: BTreeSet<_> = lists.iter().flat_map(BTreeMap::values).flatten().collect();
        let names: Vec<_> = names.into_iter().collect();
        let nodes = names.chunks(AT_ONCE);
        let nodes = nodes.flat_map(|names| self.look_at(names)).collect();
        let list = |index: usize| lists.get(index).cloned().unwrap_or_default();
        Ok(Survey {
            actions: actions(&published),
            publishers: list(0),
            services: list(2).into_keys().collect(),
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
