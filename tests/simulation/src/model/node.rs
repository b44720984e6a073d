//! The node: alone on its line, with parameters or without, or on a shared one.

use ztl_core::Instant;

use super::ends::mcu::bus::OnBus;
use super::ends::mcu::parameters::Tuned;
use super::ends::mcu::{Acting, Identity, Node};
use super::motor::Motor;
use super::words::{Act, Scenario};

type Motors = Acting<[Motor; 2]>;

/// A node with two motors.
#[derive(Debug, Clone)]
pub(super) enum SomeNode {
    Alone(Node<'static, Motors, 2, 128>),
    Tuned(Node<'static, Acting<Tuned<[Motor; 2]>>, 2, 128>),
    Shared(Node<'static, OnBus<Motors>, 2, 128>),
}

/// Calls a method of the node.
macro_rules! any {
    ($node:expr, $name:ident => $call:expr) => {
        match $node {
            Self::Alone($name) => $call,
            Self::Tuned($name) => $call,
            Self::Shared($name) => $call,
        }
    };
}

impl SomeNode {
    /// A node in this boot; with an address it is on a shared line.
    pub(super) fn new(scenario: &Scenario, boot: u32, address: Option<u8>) -> Self {
        let motor = |place| Motor {
            place,
            kind: scenario.motors[place],
            run: None,
            value: 0,
        };
        let motors = [motor(0), motor(1)];
        let identity = Identity::new("lab", "1", boot);
        let sets = scenario
            .acts
            .iter()
            .any(|act| matches!(act, Act::Set { .. }));
        match address {
            None if sets => Self::Tuned(Node::new(identity, Acting::new(Tuned::new(motors)))),
            None => Self::Alone(Node::new(identity, Acting::new(motors))),
            Some(address) => {
                let shared = OnBus::new(Acting::new(motors), address.into(), address);
                Self::Shared(Node::new(identity, shared))
            }
        }
    }

    pub(super) fn handle_bytes(&mut self, now: Instant, bytes: &[u8]) {
        any!(self, node => node.handle_bytes(now, bytes));
    }

    pub(super) fn handle_timeout(&mut self, now: Instant) {
        any!(self, node => node.handle_timeout(now));
    }

    pub(super) fn poll_timeout(&self, now: Instant) -> Instant {
        any!(self, node => node.poll_timeout(now))
    }

    pub(super) fn poll_transmit(&mut self, now: Instant, buffer: &mut [u8]) -> usize {
        any!(self, node => node.poll_transmit(now, buffer))
    }

    /// Starts a task at the node. Returns whether it has begun.
    pub(super) fn start_here(&mut self, now: Instant, motor: u8, goal: &str) -> bool {
        any!(self, node => node.start_here(now, motor, goal).is_ok())
    }
}
