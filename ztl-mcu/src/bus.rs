//! A node on a shared, half-duplex line such as RS-485: it sends only when the gateway asks it.
//!
//! ```
//! use ztl_mcu::bus::OnBus;
//! use ztl_mcu::{Component, Identity, Node};
//!
//! # fn strap() -> u8 { 3 }
//! # fn unique_id() -> u64 { 1 }
//! fn node<A: Component>(arm: A, boot: u32) -> Node<'static, OnBus<(A,)>, 2, 128> {
//!     // `OnBus` wraps the components. It takes a unique id of the chip, and an address from a switch or a parameter; 0: none.
//!     Node::new(Identity::new("arm", "1.0.0", boot), OnBus::new((arm,), unique_id(), strap()))
//! }
//! ```
//!
//! The gateway asks each node in turn. A node answers with one frame, within [`TURN`]: call
//! [`Pump::turn`](crate::pump::Pump::turn) at least every millisecond. `DriverEnable` (feature `components`) switches the transceiver.

use core::time::Duration;

use ztl_core::Instant;
use ztl_core::link::{ADDR_ALL, ADDR_MOST, ADDR_NONE, BusMessage};

use crate::component::{Components, forward};

/// A node does not answer later than this after the question, because the gateway may have asked another node by then.
pub const TURN: Duration = Duration::from_millis(4);

/// What the node has been asked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
enum Question {
    /// The node was not asked.
    None,
    /// Its most urgent frame.
    Frame,
    /// Its id.
    Identity,
}

/// The state of a node on a shared line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct BusState {
    id: u64,
    address: u8,
    /// The round of the search in which the node was found.
    found: Option<u8>,
    question: Question,
    /// Until when it may begin to answer.
    until: Instant,
}

impl BusState {
    /// The node's address; 0 if it has none.
    #[must_use]
    pub const fn address(&self) -> u8 {
        self.address
    }

    /// The node's unique id.
    #[must_use]
    pub(crate) const fn id(&self) -> u64 {
        self.id
    }

    /// Whether a frame with this address is for this node.
    pub(crate) const fn is_for(&self, address: u8) -> bool {
        address == ADDR_ALL || address == self.address && address != ADDR_NONE
    }

    /// The gateway has asked for a frame.
    pub(crate) fn ask(&mut self, now: Instant) {
        self.question = Question::Frame;
        self.until = now + TURN;
    }

    /// Another end sends, so the turn is over.
    pub(crate) const fn end_turn(&mut self) {
        self.question = Question::None;
    }

    /// Whether the node may speak now.
    pub(crate) fn has_turn(&self, now: Instant) -> bool {
        self.question != Question::None && now <= self.until
    }

    /// Uses the turn up. Returns `None` without one, else whether the identity was asked for.
    pub(crate) fn take_turn(&mut self, now: Instant) -> Option<bool> {
        let has = self.has_turn(now);
        let question = core::mem::replace(&mut self.question, Question::None);
        has.then_some(question == Question::Identity)
    }

    /// Handles a message to all.
    pub(crate) fn handle(&mut self, now: Instant, message: BusMessage<'_>) {
        let identity = match message {
            BusMessage::Search {
                round,
                bits,
                prefix,
            } => self.found != Some(round) && BusMessage::matches(self.id, bits, prefix),
            BusMessage::Assign { round, id, address } => {
                let own = id == self.id && address <= ADDR_MOST;
                if own {
                    self.found = Some(round);
                }
                if own && address != ADDR_NONE {
                    self.address = address;
                }
                own
            }
            BusMessage::Here { .. } => false,
        };
        if identity {
            self.question = Question::Identity;
            self.until = now + TURN;
        }
    }
}

/// Components of a node on a shared line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct OnBus<C> {
    components: C,
    state: BusState,
}

impl<C> OnBus<C> {
    /// The components of a node with this unique id. The address is 1 to 32; any other means that the gateway gives it one
    /// ([`address`](Self::address)).
    #[must_use]
    pub const fn new(components: C, id: u64, address: u8) -> Self {
        Self {
            components,
            state: BusState {
                id,
                address: if address <= ADDR_MOST {
                    address
                } else {
                    ADDR_NONE
                },
                found: None,
                question: Question::None,
                until: Instant::ZERO,
            },
        }
    }

    /// The node's address; 0 if it has none. If the gateway has assigned it, the firmware should keep it over resets.
    #[must_use]
    pub const fn address(&self) -> u8 {
        self.state.address
    }
}

impl<C: Components> Components for OnBus<C> {
    forward!(components: parts descriptions own_work parameters updates);

    fn bus(&self) -> Option<&BusState> {
        Some(&self.state)
    }

    fn bus_mut(&mut self) -> Option<&mut BusState> {
        Some(&mut self.state)
    }
}

/// Switches a transceiver to sending before the first byte, and back when the port has been flushed. The port's `flush` must
/// wait for the last stop bit.
#[cfg(feature = "components")]
#[derive(Debug)]
pub struct DriverEnable<W, P> {
    port: W,
    enable: P,
}

#[cfg(feature = "components")]
impl<W, P: embedded_hal::digital::OutputPin> DriverEnable<W, P> {
    /// A port whose transceiver sends while `enable` is high.
    ///
    /// # Errors
    /// Those of the pin, which is set low.
    pub fn new(port: W, mut enable: P) -> Result<Self, P::Error> {
        enable.set_low()?;
        Ok(Self { port, enable })
    }
}

#[cfg(feature = "components")]
impl<W: embedded_io::ErrorType, P> embedded_io::ErrorType for DriverEnable<W, P> {
    type Error = W::Error;
}

#[cfg(feature = "components")]
impl<W, P> embedded_io::Write for DriverEnable<W, P>
where
    W: embedded_io::Write,
    P: embedded_hal::digital::OutputPin,
{
    /// Writes nothing if the pin fails.
    fn write(&mut self, bytes: &[u8]) -> Result<usize, W::Error> {
        match self.enable.set_high() {
            Ok(()) => self.port.write(bytes),
            Err(_) => Ok(0),
        }
    }

    fn flush(&mut self) -> Result<(), W::Error> {
        let flushed = self.port.flush();
        // If the pin fails, the transceiver may keep sending; nothing here can stop it.
        let _ = self.enable.set_low();
        flushed
    }
}

#[cfg(test)]
mod tests;
