//! The node: alone on its line, or on a shared one.

use ztl_core::Instant;
use ztl_mcu::bus::OnBus;
use ztl_mcu::describe::Described;
use ztl_mcu::{Acting, Identity, Node, Reason};

use super::motor::Motor;

/// The place of a board on a shared line.
#[derive(Debug, Clone, Copy)]
pub(super) struct Place {
    pub(super) address: u8,
    pub(super) id: u64,
}

type Motors = Acting<Described<[Motor; 2]>>;

/// A node with two motors.
pub(super) enum SomeNode {
    Alone(Node<'static, Motors, 4, 160>),
    Shared(Node<'static, OnBus<Motors>, 4, 160>),
}

/// Calls a method of either node.
macro_rules! either {
    ($node:expr, $name:ident => $call:expr) => {
        match $node {
            Self::Alone($name) => $call,
            Self::Shared($name) => $call,
        }
    };
}

impl SomeNode {
    /// A node in this boot, alone or on a shared line.
    pub(super) fn new(motors: [Motor; 2], boot: u32, place: Option<Place>) -> Self {
        let motors = Acting::new(Described(motors));
        let identity = Identity::new("lab", "1", boot);
        match place {
            None => Self::Alone(Node::new(identity, motors)),
            Some(Place { address, id }) => {
                Self::Shared(Node::new(identity, OnBus::new(motors, id, address)))
            }
        }
    }

    pub(super) fn handle_bytes(&mut self, now: Instant, bytes: &[u8]) {
        either!(self, node => node.handle_bytes(now, bytes));
    }

    pub(super) fn handle_timeout(&mut self, now: Instant) {
        either!(self, node => node.handle_timeout(now));
    }

    pub(super) fn poll_timeout(&self, now: Instant) -> Instant {
        either!(self, node => node.poll_timeout(now))
    }

    pub(super) fn poll_transmit(&mut self, now: Instant, buffer: &mut [u8]) -> usize {
        either!(self, node => node.poll_transmit(now, buffer))
    }

    pub(super) fn report_event(&mut self, now: Instant, text: &str) {
        either!(self, node => drop(node.report_event(now, text)));
    }

    pub(super) fn start_here(&mut self, now: Instant, motor: u8, goal: &str) -> Result<(), Reason> {
        either!(self, node => node.start_here(now, motor, goal).map(drop))
    }
}

/// The id of a second board at this address.
pub(super) const fn second_id(address: u8) -> u64 {
    !id(address)
}

/// The unique id of a node. Those of the first two differ in the last bits only.
pub(super) const fn id(address: u8) -> u64 {
    let differs = if address == 1 { 2 } else { address };
    (differs as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15) ^ address as u64
}
