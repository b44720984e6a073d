//! The real bus of the gateway, or its copy with mutants if one is switched on.

use ztl_core::Instant;
use ztl_link::BusNeeds;
use ztl_link::bus::{Bus, BusEvent, TURNAROUND};

use super::gateway::BAUD;
use crate::broken;
use crate::broken::ends::link as copy;

pub(super) enum Master {
    Real(Bus),
    Copy(copy::bus::Bus),
}

/// Calls a method of either bus.
macro_rules! either {
    ($bus:expr, $name:ident => $call:expr) => {
        match $bus {
            Self::Real($name) => $call,
            Self::Copy($name) => $call,
        }
    };
}

impl Master {
    /// With nodes at the addresses from 1 to this.
    pub(super) fn new(now: Instant, nodes: u8) -> Self {
        let mut new = if broken::is_on() {
            Self::Copy(copy::bus::Bus::new(BAUD, TURNAROUND))
        } else {
            Self::Real(Bus::new(BAUD, TURNAROUND))
        };
        for address in 1..=nodes {
            either!(&mut new, bus => bus.add(now, address));
        }
        new
    }

    pub(super) fn queue(&mut self, now: Instant, address: u8, bytes: &[u8]) {
        either!(self, bus => bus.queue(now, address, bytes));
    }

    pub(super) fn set_needs(&mut self, address: u8, needs: BusNeeds) {
        let BusNeeds {
            busy,
            urgent,
            patience,
        } = needs;
        match self {
            Self::Real(bus) => bus.set_needs(address, needs),
            Self::Copy(bus) => {
                let needs = copy::BusNeeds {
                    busy,
                    urgent,
                    patience,
                };
                bus.set_needs(address, needs);
            }
        }
    }

    pub(super) fn search(&mut self, now: Instant) {
        either!(self, bus => bus.search(now));
    }

    pub(super) fn handle_bytes(&mut self, now: Instant, bytes: &[u8]) {
        either!(self, bus => bus.handle_bytes(now, bytes));
    }

    pub(super) fn handle_timeout(&mut self, now: Instant) {
        either!(self, bus => bus.handle_timeout(now));
    }

    pub(super) fn poll_transmit(&mut self, now: Instant) -> Option<Vec<u8>> {
        either!(self, bus => bus.poll_transmit(now))
    }

    pub(super) fn poll_frame(&mut self) -> Option<(u8, Vec<u8>)> {
        either!(self, bus => bus.poll_frame())
    }

    /// The nodes that a search has found, by id and address, if one has ended.
    pub(super) fn poll_found(&mut self) -> Option<Vec<(u64, u8)>> {
        match self {
            Self::Real(bus) => loop {
                match bus.poll_event()? {
                    BusEvent::Found(found) => {
                        return Some(found.iter().map(|it| (it.id, it.address)).collect());
                    }
                    BusEvent::Noise => return Some(Vec::new()),
                    _ => {}
                }
            },
            Self::Copy(bus) => loop {
                match bus.poll_event()? {
                    copy::bus::BusEvent::Found(found) => {
                        return Some(found.iter().map(|it| (it.id, it.address)).collect());
                    }
                    copy::bus::BusEvent::Noise => return Some(Vec::new()),
                    _ => {}
                }
            },
        }
    }

    pub(super) fn poll_timeout(&self) -> Option<Instant> {
        either!(self, bus => bus.poll_timeout())
    }
}
