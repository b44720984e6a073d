//! A node on a shared line: it handles frames with its address, and sends when it has the turn.

use ztl_core::Instant;
use ztl_core::link::{ADDR_ALL, ADDR_ONLY_NODE, BusMessage, NO_SEQ, NO_SESSION, Turn};

use super::link_state::LinkState;
use super::{Node, count};
use crate::component::Components;

impl<C: Components, const TASKS: usize, const FRAME: usize> Node<'_, C, TASKS, FRAME> {
    /// Handles what only a node on a shared line handles: frames for others, and messages of the bus. Returns `false` for a
    /// frame of the link.
    pub(super) fn on_bus_frame(&mut self, now: Instant) -> bool {
        let Some(bus) = self.state.runner.components.bus_mut() else {
            return false;
        };
        bus.end_turn();
        let Some(address) = self.decoder.address() else {
            return false;
        };
        if !bus.is_for(address) {
            return true;
        }
        if let Some((_, turn)) = self.decoder.turn() {
            if turn == Turn::Poll {
                bus.ask(now);
            }
        } else if let Ok((ADDR_ALL, message)) = self.decoder.bus_message() {
            bus.handle(now, message);
        } else {
            return false;
        }
        count(&mut self.counters.frames);
        true
    }

    /// Another end has sent since the node was asked.
    pub(super) fn end_turn(&mut self) {
        if let Some(bus) = self.state.runner.components.bus_mut() {
            bus.end_turn();
        }
    }
}

impl<C: Components, const TASKS: usize, const FRAME: usize> LinkState<'_, C, TASKS, FRAME> {
    /// The address of the frames that the node sends and handles.
    pub(super) fn address(&self) -> u8 {
        match self.runner.components.bus() {
            Some(bus) => bus.address(),
            None => ADDR_ONLY_NODE,
        }
    }

    /// A command asks for an answer.
    pub(super) fn ask(&mut self, now: Instant) {
        if let Some(bus) = self.runner.components.bus_mut() {
            bus.ask(now);
        }
    }

    /// When the node may speak, on a shared line.
    pub(super) fn next_turn(&self, now: Instant) -> Option<Instant> {
        let bus = self.runner.components.bus()?;
        let speaks = !self.frame_out.pending().is_empty() || bus.has_turn(now);
        Some(if speaks { now } else { Instant::NEVER })
    }

    /// Takes the turn, and answers a question that only the bus has. Returns whether to choose a frame of the link.
    pub(super) fn take_turn(&mut self, now: Instant) -> bool {
        let Some(bus) = self.runner.components.bus_mut() else {
            return true;
        };
        let id = bus.id();
        match bus.take_turn(now) {
            None => return false,
            Some(true) => {
                let name = self.name;
                let address = self.address();
                self.frame_out.encode(address, NO_SESSION, NO_SEQ, |frame| {
                    BusMessage::Here { id, name }.put(frame);
                });
                return false;
            }
            Some(false) => {}
        }
        // Without a session: announces itself at once, in one frame.
        self.flushed = true;
        self.awake_due = Instant::ZERO;
        true
    }

    /// Answers that there is nothing to send.
    pub(super) fn end_turn(&mut self) {
        if self.runner.components.bus().is_some() && self.frame_out.pending().is_empty() {
            self.frame_out.put(&Turn::Idle.encode(self.address()));
        }
    }
}
