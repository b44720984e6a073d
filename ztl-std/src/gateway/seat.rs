//! Places on shared lines.

use std::sync::atomic::{AtomicBool, AtomicU8, Ordering};
use std::sync::{Mutex, MutexGuard, OnceLock, PoisonError};

use ztl_link::BusNeeds;
use ztl_link::bus::LastSearch;

/// A node's place on a shared line.
#[derive(Debug, Default)]
pub(super) struct Seat {
    address: AtomicU8,
    /// The name of its firmware, as a search has found it.
    firmware: OnceLock<String>,
    needs: Mutex<BusNeeds>,
    board: Mutex<Board>,
    /// Whether a search is to begin as soon as possible.
    wants_search: AtomicBool,
    /// Whether its id was found at several addresses.
    doubt: AtomicBool,
}

/// What searches have found at a node's address.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct Board {
    /// How many searches have ended.
    pub(super) searches: u64,
    /// The last one.
    pub(super) search: LastSearch,
    /// Why the node takes no tasks, although it still has some.
    pub(super) conflict: Option<String>,
    /// Whether the last search has found another board at the address, and not this one.
    pub(super) replaced: bool,
}

impl Seat {
    /// The node's address.
    pub(super) fn address(&self) -> u8 {
        self.address.load(Ordering::Acquire)
    }

    pub(super) fn set_address(&self, address: u8) {
        self.address.store(address, Ordering::Release);
    }

    /// Sets the name of its firmware, once.
    pub(super) fn set_firmware(&self, name: &str) {
        let _ = self.firmware.set(name.to_owned());
    }

    /// The name that its firmware must have. Another board at its address is not it.
    pub(super) fn firmware(&self) -> Option<&str> {
        self.firmware.get().map(String::as_str)
    }

    /// What searches have found.
    pub(super) fn board(&self) -> Board {
        self.locked_board().clone()
    }

    fn locked_board(&self) -> MutexGuard<'_, Board> {
        self.board.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A search has ended.
    pub(super) fn on_search(&self, search: LastSearch, conflict: Option<String>, replaced: bool) {
        let mut board = self.locked_board();
        board.searches += 1;
        (board.search, board.conflict, board.replaced) = (search, conflict, replaced);
    }

    /// Sets whether its id was found at several addresses, which a search checks.
    pub(super) fn set_doubt(&self, doubt: bool) {
        self.doubt.store(doubt, Ordering::Release);
    }

    /// Why the node takes no tasks.
    pub(super) fn conflict(&self) -> Option<String> {
        let doubt = self.doubt.load(Ordering::Acquire);
        let doubt = doubt.then(|| "its id answers at another address, too".to_owned());
        self.board().conflict.or(doubt)
    }

    /// Asks for a search, because another boot answers.
    pub(super) fn want_search(&self) {
        self.wants_search.store(true, Ordering::Release);
    }

    pub(super) fn take_wanted(&self) -> bool {
        self.wants_search.swap(false, Ordering::AcqRel)
    }

    pub(super) fn needs(&self) -> BusNeeds {
        *self.needs.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Sets what the node's session needs, before what it transmits.
    pub(super) fn set_needs(&self, needs: BusNeeds) {
        *self.needs.lock().unwrap_or_else(PoisonError::into_inner) = needs;
    }
}
