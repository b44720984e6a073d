//! Goals of other processes of `ztl`, which may have been killed.

use std::collections::HashMap;
use std::time::{Duration, Instant};

use crate::graph::is_ztl;

/// How often is asked whether the process that owns a goal lives.
const AGAIN: Duration = Duration::from_secs(5);

/// Goals that are remembered.
const MOST: usize = 256;

/// When the owner of each goal may be asked for again.
#[derive(Debug, Default)]
pub(crate) struct Foreign(HashMap<String, Instant>);

impl Foreign {
    /// The node to ask whether it lives, if the goal is one of another process of `ztl`. `prefix` begins our own ids: the name
    /// of the node and that of the action.
    pub(crate) fn owner_to_ask<'i>(
        &mut self,
        now: Instant,
        id: &'i str,
        prefix: &str,
    ) -> Option<&'i str> {
        let node = owner(id, prefix)?;
        if self.0.get(id).is_some_and(|again| *again > now) {
            return None;
        }
        self.0.retain(|_, again| *again > now);
        if self.0.len() < MOST {
            self.0.insert(id.to_owned(), now + AGAIN);
            return Some(node);
        }
        None
    }
}

/// The node in an id of the form `/ztl_12_00c0ffee/arm/move-7`.
fn owner<'i>(id: &'i str, prefix: &str) -> Option<&'i str> {
    let end = |text: &str| text.get(1..)?.find('/').map(|end| end + 1);
    let (node, rest) = id.split_at_checked(end(id)?)?;
    let (ours, action) = prefix.split_at_checked(end(prefix)?)?;
    let (of, number) = rest.rsplit_once('-')?;
    let is_number = number.parse::<u32>().is_ok();
    (of == action && node != ours && is_number && is_ztl(node)).then_some(node)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_goals_of_other_processes_of_ours_are_asked_for() {
        let prefix = "/ztl_1_0000abcd/arm/move";
        assert_eq!(
            owner("/ztl_12_00c0ffee/arm/move-7", prefix),
            Some("/ztl_12_00c0ffee")
        );
        for id in [
            "",
            "/",
            "/ztl_1_0000abcd/arm/move-7",
            "/ztl_12_00c0ffee/arm/other-7",
            "/ztl_12_00c0ffee/arm/move",
            "/ztl_12_00c0ffee/arm/move-",
            "/ztl_12_00c0ffee/arm/move-x",
            "/move_base-7-1234.5",
            "/ztl_tool/arm/move-7",
        ] {
            assert_eq!(owner(id, prefix), None, "{id}");
        }
    }

    #[test]
    fn an_owner_is_asked_for_from_time_to_time() {
        let (prefix, id) = ("/ztl_1_0000abcd/arm", "/ztl_12_00c0ffee/arm-7");
        let mut foreign = Foreign::default();
        let now = Instant::now();
        assert!(foreign.owner_to_ask(now, id, prefix).is_some());
        assert!(foreign.owner_to_ask(now, id, prefix).is_none());
        assert!(foreign.owner_to_ask(now + AGAIN, id, prefix).is_some());
        for number in 0..1000 {
            let id = format!("/ztl_12_00c0ffee/arm-{number}");
            foreign.owner_to_ask(now, &id, prefix);
        }
        assert!(foreign.0.len() <= MOST);
    }
}
