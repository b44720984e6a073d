//! The values that a pickle remembers for later use.

use std::collections::BTreeMap;

use crate::Error;
use crate::chunks::Chunks;
use crate::graph::Ref;
use crate::limits::Account;

/// Values for later use. Python numbers them from 0 or 1 without gaps; other numbers are legal.
pub(crate) struct Memo {
    dense: Chunks<Ref>,
    sparse: BTreeMap<u64, Ref>,
    /// How many are set.
    len: u64,
    most: usize,
}

impl Memo {
    /// What an entry of a map takes at most.
    const SPARSE: usize = 64;

    pub(crate) const fn new(most: usize) -> Self {
        Self {
            dense: Chunks::new(),
            sparse: BTreeMap::new(),
            len: 0,
            most,
        }
    }

    /// How many are set, which is the number that Python gives the next one.
    pub(crate) const fn len(&self) -> u64 {
        self.len
    }

    pub(crate) fn get(&self, index: u64) -> Option<Ref> {
        let dense = usize::try_from(index)
            .ok()
            .and_then(|index| self.dense.get(index));
        dense
            .filter(|value| *value != Ref::VACANT)
            .or_else(|| self.sparse.get(&index).copied())
    }

    pub(crate) fn put(
        &mut self,
        index: u64,
        value: Ref,
        account: &mut Account,
    ) -> Result<(), Error> {
        if self.get(index).is_none() {
            self.len += 1;
            if self.len > self.most as u64 {
                let (limit, most) = ("memo", self.most);
                return Err(Error::TooLarge { limit, most });
            }
        }
        if self.dense.len() == 0 && index == 1 {
            self.dense.push(Ref::VACANT, account)?;
        }
        match usize::try_from(index) {
            Ok(index) if index == self.dense.len() => self.dense.push(value, account)?,
            Ok(index) if index < self.dense.len() => {
                if let Some(place) = self.dense.get_mut(index) {
                    *place = value;
                }
            }
            _ => {
                account.charge(Self::SPARSE)?;
                self.sparse.insert(index, value);
            }
        }
        Ok(())
    }

    pub(crate) fn allocated(&self) -> usize {
        self.dense.allocated()
    }
}
