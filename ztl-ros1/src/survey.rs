//! What is there: the nodes, topics, actions and services that a master knows.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::mpsc::Receiver;

use crate::graph::{actions, is_ztl, lists, pairs};
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
