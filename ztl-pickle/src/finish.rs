//! The checks of a whole graph: depth, names in it, and keys.

use std::collections::HashMap;

use crate::Error;
use crate::chunks::Chunks;
use crate::graph::{Chain, Graph, Node, Ref, Rest};
use crate::key::Keys;
use crate::limits::{Account, Limits};

/// A node whose items are being visited.
const OPEN: u32 = u32::MAX;

#[derive(Clone, Copy)]
struct Frame {
    value: Ref,
    rest: Rest,
    /// The height of the highest item.
    highest: u32,
}

/// Visits each value below `root` once, and its items before it.
pub(crate) fn finish(
    graph: &mut Graph,
    root: Ref,
    limits: &Limits,
    input: usize,
    account: &mut Account,
) -> Result<(), Error> {
    account.charge(graph.len() * size_of::<u32>())?;
    // How many collections are nested in each; 0 before the visit.
    let mut heights = vec![0; graph.len()];
    let mut frames: Chunks<Frame> = Chunks::new();
    let mut keys = Keys::new(input);
    // Whether the nesting is too deep, with so many below.
    let check = |frames: &Chunks<Frame>, below: u32| {
        let (limit, most) = ("depth", limits.depth);
        match frames.len().saturating_add(below as usize) > most {
            true => Err(Error::TooLarge { limit, most }),
            false => Ok(()),
        }
    };
    let mut next = Some(root);
    loop {
        if let Some(value) = next.take() {
            let node = graph.node(value);
            if let Node::Global(global) = node {
                return Err(global.refused());
            }
            let place = value
                .index()
                .and_then(|index| heights.get_mut(index as usize));
            let height = match (node.chain(), place) {
                (None, _) => 0,
                (Some(_), None) => 1,
                (Some(chain), Some(height)) if *height == 0 => {
                    *height = OPEN;
                    let rest = graph.items(chain);
                    let highest = 0;
                    let frame = Frame {
                        value,
                        rest,
                        highest,
                    };
                    frames.push(frame, account)?;
                    0
                }
                (_, Some(height)) if *height == OPEN => 0,
                (_, Some(height)) => *height,
            };
            check(&frames, height)?;
            raise(&mut frames, height);
        }
        let Some(frame) = frames.last_mut() else {
            return Ok(());
        };
        if let Some((item, rest)) = graph.split(frame.rest) {
            frame.rest = rest;
            next = Some(item);
            continue;
        }
        let Frame { value, highest, .. } = *frame;
        frames.pop();
        let place = value
            .index()
            .and_then(|index| heights.get_mut(index as usize));
        if let Some(height) = place {
            *height = highest + 1;
        }
        raise(&mut frames, highest + 1);
        unite(graph, value, &mut keys, account)?;
    }
}

/// Notes an item of this height for the last frame.
fn raise(frames: &mut Chunks<Frame>, height: u32) {
    if let Some(frame) = frames.last_mut() {
        frame.highest = frame.highest.max(height);
    }
}

/// Unites equal keys of a set or dict, as Python: the first key stays, with the last value.
fn unite(
    graph: &mut Graph,
    value: Ref,
    keys: &mut Keys,
    account: &mut Account,
) -> Result<(), Error> {
    let node = graph.node(value);
    let (chain, step) = match node {
        Node::Set(chain) | Node::FrozenSet(chain) => (chain, 1),
        Node::Dict(chain) | Node::OrderedDict(chain) => (chain, 2),
        _ => return Ok(()),
    };
    let count = chain.len as usize / step;
    let charged = count * size_of::<u128>();
    account.charge(charged)?;
    // The fingerprint of each key, with its cell in the lowest 32 bits. Later keys have higher cells.
    let mut entries: Vec<u128> = Vec::with_capacity(count);
    let mut rest = graph.items(chain);
    while let Some((key, after)) = graph.split(rest) {
        let fingerprint = keys.fingerprint(graph, key, account)?;
        entries.push(fingerprint & !CELL | u128::from(rest.cell));
        rest = skip(graph, after, step - 1);
    }
    entries.sort_unstable();
    let same = |one: &u128, other: &u128| one & !CELL == other & !CELL;
    let is_unique = entries
        .iter()
        .zip(entries.iter().skip(1))
        .all(|(one, next)| !same(one, next));
    if !is_unique {
        let mut kept: HashMap<u32, u32> = HashMap::new();
        account.charge(count * 32)?;
        for equal in entries.chunk_by(same) {
            if let (Some(first), Some(last)) = (equal.first(), equal.last()) {
                kept.insert(*first as u32, *last as u32);
            }
        }
        let chain = rebuilt(graph, chain, step, &kept, account)?;
        graph.set_chain(value, chain);
        account.release(count * 32);
    }
    if let Node::FrozenSet(mut chain) = graph.node(value) {
        entries.dedup_by(|one, other| same(one, other));
        let sum = entries
            .iter()
            .fold(0_u128, |sum, entry| sum.wrapping_add(entry & !CELL));
        chain.last = keys.put_set(sum, entries.len(), account)?;
        graph.set_chain(value, chain);
    }
    drop(entries);
    account.release(charged);
    Ok(())
}

/// The bits that a fingerprint leaves to the number of a cell.
const CELL: u128 = u32::MAX as u128;

fn skip(graph: &Graph, rest: Rest, count: usize) -> Rest {
    (0..count).fold(rest, |rest, _| {
        graph.split(rest).map_or(rest, |(_, after)| after)
    })
}

/// The chain with only the kept keys, each with the value of the cell that is given for it.
fn rebuilt(
    graph: &mut Graph,
    chain: Chain,
    step: usize,
    kept: &HashMap<u32, u32>,
    account: &mut Account,
) -> Result<Chain, Error> {
    // Values by the cells of their keys; a later key stands before its value.
    let mut values: HashMap<u32, Ref> = HashMap::new();
    let mut rest = graph.items(chain);
    account.charge(chain.len as usize * 32)?;
    while let Some((item, after)) = graph.split(rest) {
        let value = if step == 2 {
            graph.split(after).map_or(item, |(value, _)| value)
        } else {
            item
        };
        values.insert(rest.cell, value);
        rest = skip(graph, after, step - 1);
    }
    let mut united = Chain::EMPTY;
    let mut rest = graph.items(chain);
    while let Some((key, after)) = graph.split(rest) {
        if let Some(value) = kept.get(&rest.cell).and_then(|last| values.get(last)) {
            graph.link(&mut united, key, account)?;
            if step == 2 {
                graph.link(&mut united, *value, account)?;
            }
        }
        rest = skip(graph, after, step - 1);
    }
    account.release(chain.len as usize * 32);
    Ok(united)
}
