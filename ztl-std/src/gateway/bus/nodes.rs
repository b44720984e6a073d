//! The nodes of a shared line: their names, and what is wrong with their addresses.

use std::sync::Arc;

use ztl_core::Instant;
use ztl_core::link::{ADDR_MOST, ADDR_NONE};
use ztl_link::bus::{Found, LastSearch};

use crate::gateway::config::name_mistake;
use crate::gateway::seat::Seat;
use crate::time::now;

/// The most nodes of a line while the gateway runs, also those that are gone: a node that says another id at each search
/// fills no memory.
const MOST: usize = 64;
/// So many searches in a row must miss a node until it no longer shares its address or its id, as answers collide, and
/// must find it without an address until it is said to take none.
const MISSES: u32 = 3;

/// A node that was found at some time.
#[derive(Debug)]
pub(super) struct Node {
    id: u64,
    /// Its name in its firmware.
    firmware: String,
    /// Its name on the line, which it keeps.
    pub(super) name: String,
    pub(super) seat: Arc<Seat>,
    /// Why it is not served.
    pub(super) problem: Option<String>,
}

/// What a search has changed.
#[derive(Debug, Default, PartialEq, Eq)]
pub(super) struct Changes {
    /// New nodes by their place in the list.
    pub(super) new: Vec<usize>,
    /// Nodes by their ids that are not served at these addresses any more, and why.
    pub(super) closed: Vec<(u64, u8, String)>,
    /// The same for nodes that share their address or their id. One that has tasks is still asked, so that they can be
    /// aborted.
    pub(super) shared: Vec<(u64, u8, String)>,
}

/// All nodes that were found.
#[derive(Debug, Default)]
pub(super) struct Nodes {
    all: Vec<Node>,
    /// What is wrong with nodes that are not served, each once.
    mistakes: Vec<String>,
    /// Nodes that share an address or an id, and how many searches in a row have missed each.
    sharing: Vec<(Found, u32)>,
    /// Nodes without an address, and how many searches in a row have found each so, up to [`MISSES`].
    unaddressed: Vec<(u64, u32)>,
    /// When the last search began.
    pub(super) begun: Instant,
}

impl Nodes {
    pub(super) fn get(&self, index: usize) -> Option<&Node> {
        self.all.get(index)
    }

    pub(super) fn of_seat(&self, seat: &Arc<Seat>) -> Option<&Node> {
        self.all.iter().find(|node| Arc::ptr_eq(&node.seat, seat))
    }

    pub(super) fn of_id(&self, id: u64) -> Option<&Node> {
        self.all.iter().find(|node| node.id == id)
    }

    /// Whether the node with this name on the line is served.
    pub(super) fn is_served(&self, name: &str) -> bool {
        let mut all = self.all.iter();
        all.any(|node| node.name == name && node.problem.is_none())
    }

    /// Whether a node may have missed the offer of an address.
    pub(super) fn has_unaddressed(&self) -> bool {
        let mut all = self.unaddressed.iter();
        all.any(|(_, searches)| *searches < MISSES)
    }

    /// Leaves out nodes that have no address yet: they may have missed the offer, and the next search repeats it.
    fn without_unaddressed(&mut self, mut found: Vec<Found>) -> Vec<Found> {
        let before = std::mem::take(&mut self.unaddressed);
        found.retain(|one| {
            let takes_none = one.address == ADDR_NONE && !doubled(one);
            let earlier = before.iter().find(|(id, _)| *id == one.id);
            let searches = earlier.map_or(1, |(_, searches)| searches + 1);
            if takes_none {
                self.unaddressed.push((one.id, searches.min(MISSES)));
            }
            !takes_none || searches >= MISSES
        });
        found
    }

    /// What is wrong with the addresses.
    pub(super) fn mistakes(&self) -> &[String] {
        &self.mistakes
    }

    /// What a search has found, and nodes that it may have missed.
    fn with_missed(&mut self, found: &[Found]) -> Vec<Found> {
        let mut all = found.to_vec();
        let there = |id| found.iter().any(|one| one.id == id);
        let mut missed = std::mem::take(&mut self.sharing);
        missed.retain_mut(|(node, misses)| {
            *misses += 1;
            let known = match doubled(node) {
                true => found.contains(node),
                false => found.iter().any(|one| one.id == node.id),
            };
            *misses < MISSES && !known
        });
        // One of several nodes with one id may answer alone.
        all.retain(|one| {
            !missed
                .iter()
                .any(|(node, _)| doubled(node) && node.id == one.id)
        });
        all.extend(missed.iter().map(|(node, _)| node.clone()));
        let conflicts = |all: &[Found], one: &Found| doubled(one) || sharing(all, one).len() > 1;
        let before = all.clone();
        all.retain(|one| there(one.id) || conflicts(&before, one));
        all.sort_by_key(|one| one.id);
        for one in all.iter().filter(|one| conflicts(&all, one)) {
            let misses = missed.iter().find(|(node, _)| node.id == one.id);
            let misses = misses.map_or(0, |(_, misses)| *misses);
            self.sharing.push((one.clone(), misses));
        }
        all
    }

    /// Takes what a search has found.
    pub(super) fn update(&mut self, found: &[Found]) -> Changes {
        let mut changes = Changes::default();
        let found = self.with_missed(found);
        let found = &self.without_unaddressed(found)[..];
        self.mistakes = mistakes(found);
        let there = |id: u64| found.iter().any(|node| node.id == id);
        for one in found {
            let address = one.address;
            let problem = mistake(found, one);
            let replaced = |node: &&mut Node| {
                // Another board with the same firmware and address.
                !there(node.id) && node.seat.address() == address && node.firmware == one.name
            };
            let index = self.all.iter().position(|node| node.id == one.id);
            let known = match index {
                Some(index) => self.all.get_mut(index),
                None => self.all.iter_mut().find(replaced),
            };
            let Some(node) = known else {
                if self.all.len() >= MOST {
                    let text = format!(
                        "'{}' (id {:016x}) is not served: more than {MOST} nodes were found; restart the gateway",
                        one.name, one.id
                    );
                    if self.mistakes.is_empty() {
                        self.mistakes.push(text);
                    }
                } else if problem.is_none() {
                    let name = self.name_for(found, one);
                    changes.new.push(self.all.len());
                    let seat = Arc::<Seat>::default();
                    seat.set_address(address);
                    seat.set_firmware(&one.name);
                    self.all.push(Node {
                        id: one.id,
                        firmware: one.name.clone(),
                        name,
                        seat,
                        problem,
                    });
                }
                continue;
            };
            let before = node.seat.address();
            match &problem {
                Some(problem) if before == address || doubled(one) => {
                    changes.shared.push((one.id, before, problem.clone()));
                }
                None if before == address => {}
                _ => {
                    let moved = format!("the node has moved from address {before} to {address}");
                    let why = problem.clone().unwrap_or(moved);
                    changes.closed.push((one.id, before, why));
                }
            }
            node.id = one.id;
            node.problem = problem;
            if address != ADDR_NONE {
                node.seat.set_address(address);
            }
        }
        for node in self.all.iter_mut().filter(|node| !there(node.id)) {
            let address = node.seat.address();
            if let Some(other) = found.iter().find(|one| one.address == address) {
                let (name, id) = (&other.name, other.id);
                let text = format!("'{name}' (id {id:016x}) has its address {address} now");
                // Once: the other node is served there from then on.
                if node.problem.as_ref() != Some(&text) {
                    node.problem = Some(text.clone());
                    changes.closed.push((node.id, address, text));
                }
            }
        }
        for node in &self.all {
            let address = node.seat.address();
            let at: Vec<u64> = found
                .iter()
                .filter_map(|one| (one.address == address).then_some(one.id))
                .collect();
            let search = LastSearch {
                id: node.id,
                alone: at == [node.id],
                begun: self.begun,
                ended: now(),
            };
            let replaced = !at.is_empty() && !there(node.id);
            node.seat.on_search(search, node.problem.clone(), replaced);
        }
        changes
    }

    /// A name on the line. Nodes whose firmware has the same name are told apart by their address.
    fn name_for(&self, found: &[Found], one: &Found) -> String {
        let name = match name_mistake(&one.name) {
            None => one.name.as_str(),
            Some(_) => "node",
        };
        let others = found.iter().filter(|other| other.id != one.id);
        let shared = others.into_iter().any(|other| other.name == one.name)
            || self.all.iter().any(|node| node.name == name);
        if shared || name != one.name {
            let mut unique = format!("{name}-{}", one.address);
            // It was the name of a node that has another address now.
            while self.all.iter().any(|node| node.name == unique) {
                unique.push_str(&format!("-{:016x}", one.id));
            }
            return unique;
        }
        name.to_owned()
    }
}

/// Whether several nodes have this id.
fn doubled(one: &Found) -> bool {
    one.address == ADDR_NONE && one.name.is_empty()
}

/// Nodes with the same address.
fn sharing<'a>(found: &'a [Found], one: &Found) -> Vec<&'a Found> {
    let same = |other: &&Found| other.address == one.address && one.address != ADDR_NONE;
    found.iter().filter(same).collect()
}

/// Why a node cannot be served.
fn mistake(found: &[Found], one: &Found) -> Option<String> {
    let (name, id) = (&one.name, one.id);
    if one.address == ADDR_NONE {
        return Some(match doubled(one) {
            true => format!("several nodes have the id {id:016x}; give each its own"),
            false => format!("'{name}' (id {id:016x}) has no address and takes none"),
        });
    }
    if one.address > ADDR_MOST {
        let address = one.address;
        return Some(format!(
            "'{name}' (id {id:016x}) has the address {address}; addresses go from 1 to {ADDR_MOST}"
        ));
    }
    let sharing = sharing(found, one);
    (sharing.len() > 1).then(|| {
        let nodes: Vec<String> = sharing
            .iter()
            .map(|node| format!("'{}' (id {:016x})", node.name, node.id))
            .collect();
        let (nodes, address) = (nodes.join(" and "), one.address);
        format!("{nodes} have the same address {address}; give each its own")
    })
}

/// All mistakes, each once.
fn mistakes(found: &[Found]) -> Vec<String> {
    let mut mistakes: Vec<String> = Vec::new();
    for one in found {
        let mistake = mistake(found, one).filter(|mistake| !mistakes.contains(mistake));
        mistakes.extend(mistake);
    }
    mistakes
}

/// Mistakes as one text; of many, the first ones.
pub(super) fn joined(mistakes: &[String]) -> Option<String> {
    const SHOWN: usize = 4;
    let (shown, more) = mistakes.split_at(mistakes.len().min(SHOWN));
    let text = shown.join("; ");
    match (shown, more.len()) {
        ([], _) => None,
        (_, 0) => Some(text),
        (_, more) => Some(format!("{text}; and {more} more")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn found(id: u64, address: u8, name: &str) -> Found {
        let name = name.to_owned();
        Found { id, address, name }
    }

    fn problem(nodes: &Nodes) -> Option<String> {
        joined(nodes.mistakes())
    }

    /// Addresses without why.
    fn closed(changes: &Changes) -> Vec<u8> {
        let closed = changes.closed.iter();
        closed.map(|(_, address, _)| *address).collect()
    }

    fn names(nodes: &Nodes) -> Vec<&str> {
        nodes.all.iter().map(|node| node.name.as_str()).collect()
    }

    #[test]
    fn nodes_with_one_name_are_told_apart_by_address_and_keep_their_names() {
        let mut nodes = Nodes::default();
        let changes = nodes.update(&[
            found(1, 4, "finger"),
            found(2, 5, "finger"),
            found(3, 6, "pan"),
            found(4, 7, "a b"),
        ]);
        assert_eq!(changes.new, [0, 1, 2, 3]);
        assert_eq!(names(&nodes), ["finger-4", "finger-5", "pan", "node-7"]);
        let changes = nodes.update(&[found(1, 4, "finger"), found(5, 8, "pan")]);
        assert_eq!(changes.new, [4]);
        assert_eq!(nodes.all[4].name, "pan-8");
        assert_eq!(problem(&nodes), None);
    }

    #[test]
    fn two_nodes_with_one_address_are_named_and_neither_is_served() {
        let mut nodes = Nodes::default();
        nodes.update(&[found(1, 4, "finger")]);
        let both = [found(1, 4, "finger"), found(2, 4, "pan")];
        let changes = nodes.update(&both);
        let shared = changes.shared.iter().map(|(_, address, _)| *address);
        assert_eq!((changes.new, shared.collect()), (vec![], vec![4]));
        let text = "'finger' (id 0000000000000001) and 'pan' (id 0000000000000002) have the same address 4; give each its own";
        assert_eq!(problem(&nodes).as_deref(), Some(text));
        assert_eq!(nodes.all[0].problem.as_deref(), Some(text));
        let changes = nodes.update(&[found(1, 4, "finger"), found(2, 5, "pan")]);
        assert_eq!(changes.new, [1]);
        assert_eq!((problem(&nodes), &nodes.all[0].problem), (None, &None));
    }

    #[test]
    fn a_search_that_misses_a_node_does_not_end_a_conflict() {
        let mut nodes = Nodes::default();
        let both = [found(1, 4, "finger"), found(2, 4, "pan")];
        nodes.update(&both);
        let told = problem(&nodes);
        assert!(told.is_some());
        // Their answers collide, so that a search may miss either; in another order, they are the same two.
        for missing in [
            &both[1..],
            &both[..1],
            &[],
            &[both[1].clone(), both[0].clone()],
        ] {
            assert!(nodes.update(missing).new.is_empty());
            assert_eq!(problem(&nodes), told);
        }
        for _ in 1..MISSES {
            nodes.update(&both[..1]);
            assert_eq!(problem(&nodes), told);
        }
        assert_eq!(nodes.update(&both[..1]).new, [0]);
        assert_eq!(problem(&nodes), None);
        // One that has another address is not missing.
        nodes.update(&both);
        nodes.update(&[found(1, 5, "finger")]);
        assert_eq!(problem(&nodes), None);
    }

    #[test]
    fn a_new_board_with_the_same_firmware_and_address_takes_the_place_of_the_old_one() {
        let mut nodes = Nodes::default();
        nodes.update(&[found(1, 4, "finger")]);
        assert_eq!(nodes.update(&[found(9, 4, "finger")]), Changes::default());
        assert_eq!(names(&nodes), ["finger"]);
        // Another firmware is another device.
        let changes = nodes.update(&[found(7, 4, "pan")]);
        assert_eq!(
            (&changes.new[..], &closed(&changes)[..]),
            (&[1][..], &[4][..])
        );
        assert!(nodes.all[0].problem.as_ref().unwrap().contains("'pan'"));
        // The next search closes nothing again.
        assert_eq!(nodes.update(&[found(7, 4, "pan")]), Changes::default());
    }

    #[test]
    fn a_node_with_an_address_that_no_node_can_have_is_named_and_not_served() {
        for address in [33, 254] {
            let mut nodes = Nodes::default();
            let changes = nodes.update(&[found(1, address, "finger"), found(2, 4, "pan")]);
            assert_eq!(changes.new, [0], "{address}");
            assert_eq!(names(&nodes), ["pan"]);
            let text = format!(
                "'finger' (id 0000000000000001) has the address {address}; addresses go from 1 to 32"
            );
            assert_eq!(problem(&nodes), Some(text));
        }
        // Also one that was served before.
        let mut nodes = Nodes::default();
        nodes.update(&[found(1, 4, "finger")]);
        let changes = nodes.update(&[found(1, 40, "finger")]);
        assert_eq!(closed(&changes), [4]);
    }

    #[test]
    fn of_many_mistakes_only_the_first_are_told() {
        let mut nodes = Nodes::default();
        let many: Vec<Found> = (0..64).map(|id| found(id, 0, "")).collect();
        nodes.update(&many);
        let told = problem(&nodes).expect("it is told");
        assert!(told.ends_with("; and 60 more"), "{told}");
    }

    #[test]
    fn a_node_that_says_another_id_at_each_search_fills_no_memory() {
        let mut nodes = Nodes::default();
        for id in 0..1000 {
            nodes.update(&[found(id, 4, &format!("node{id}"))]);
        }
        assert_eq!(nodes.all.len(), MOST);
        let told = problem(&nodes).expect("it is told");
        assert!(told.starts_with("'node999' "), "{told}");
        // Nodes that are known are served.
        assert!(nodes.update(&[found(0, 4, "node0")]).new.is_empty());
        assert_eq!(problem(&nodes), None);
    }

    #[test]
    fn a_node_that_moved_is_served_at_its_new_address() {
        let mut nodes = Nodes::default();
        nodes.update(&[found(1, 4, "finger")]);
        let changes = nodes.update(&[found(1, 6, "finger")]);
        let moved = "the node has moved from address 4 to 6".to_owned();
        assert_eq!(changes.closed, [(1, 4, moved)]);
        assert_eq!(nodes.all[0].seat.address(), 6);
        let none = nodes.update(&[found(1, 0, "")]);
        assert_eq!(closed(&none), [0; 0]);
        assert_eq!((none.shared[0].0, none.shared[0].1), (1, 6));
        assert!(problem(&nodes).unwrap().contains("several nodes"));
    }

    #[test]
    fn a_node_is_said_to_take_no_address_after_several_searches() {
        let mut nodes = Nodes::default();
        nodes.update(&[found(1, 32, "head")]);
        for _ in 1..MISSES {
            assert_eq!(nodes.update(&[found(1, 0, "head")]), Changes::default());
            assert_eq!(problem(&nodes), None);
            assert!(nodes.has_unaddressed());
        }
        for _ in 0..2 {
            nodes.update(&[found(1, 0, "head")]);
            assert!(problem(&nodes).unwrap().contains("takes none"));
            assert!(!nodes.has_unaddressed());
        }
        nodes.update(&[found(1, 32, "head")]);
        nodes.update(&[found(1, 0, "head")]);
        assert_eq!(problem(&nodes), None);
    }

    #[test]
    fn an_id_of_several_nodes_stays_one_when_one_of_them_answers_alone() {
        let mut nodes = Nodes::default();
        nodes.update(&[found(1, 4, "finger")]);
        nodes.update(&[found(1, 0, "")]);
        let told = problem(&nodes);
        assert!(told.as_ref().unwrap().contains("several nodes"));
        for missing in [&[][..], &[found(1, 4, "finger")]] {
            nodes.update(missing);
            assert_eq!(
                (problem(&nodes), &nodes.all[0].problem),
                (told.clone(), &told)
            );
        }
        nodes.update(&[found(1, 4, "finger")]);
        assert_eq!((problem(&nodes), &nodes.all[0].problem), (None, &None));
        // Seen again, it stays as long again.
        nodes.update(&[found(1, 0, "")]);
        nodes.update(&[found(1, 4, "finger")]);
        nodes.update(&[found(1, 0, "")]);
        for _ in 1..MISSES {
            nodes.update(&[found(1, 4, "finger")]);
            assert_eq!(problem(&nodes), told);
        }
    }
}
