//! The node: alone on its line, or on a shared one.

use ztl_core::Instant;
use ztl_mcu::bus::OnBus;
use ztl_mcu::describe::Described;
use ztl_mcu::{Acting, Identity, Node, Reason};

use super::motor::Motor;

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
    /// A node in this boot; with an address it is on a shared line.
    pub(super) fn new(motors: [Motor; 2], boot: u32, address: Option<u8>) -> Self {
        let motors = Acting::new(Described(motors));
        let identity = Identity::new("lab", "1", boot);
        match address {
            None => Self::Alone(Node::new(identity, motors)),
            Some(address) => Self::Shared(Node::new(
                identity,
                OnBus::new(motors, id(address), address),
            )),
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

/// The unique id of a node. Those of the first two differ in the last bits only.
pub(super) const fn id(address: u8) -> u64 {
    let differs = if address == 1 { 2 } else { address };
    (differs as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15) ^ address as u64
}
