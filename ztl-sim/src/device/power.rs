//! The firmware's main loop, from reset to reset.

use std::cell::RefCell;
use std::collections::HashMap;
use std::io::Write;
use std::sync::mpsc::{Receiver, RecvTimeoutError};
use std::time::Duration;

use ztl_core::link::LINK_TIMEOUT;
use ztl_core::manifest::Version;
use ztl_mcu::bus::OnBus;
use ztl_mcu::parameters::{SaveError, Storage, Tunable, Tuned, Tuning};
use ztl_mcu::update::Updatable;
use ztl_mcu::{Acting, Component, Components, Identity, Instant, Node};

use super::axis::{Axis, FINGER, PAN};
use super::buttons::on_push;
use super::input::Input;
use super::kind::Kind;
use super::record::{Record, Recorded};
use super::sensor::{self, Sensor};
use super::slots::{SlotUpdater, Slots, Verify};
use crate::random::random;
use ztl_std::time::now;

/// The link timeout of a node on a shared line.
const SHARED_LINK_TIMEOUT: Duration = Duration::from_secs(5);

/// What is simulated, and how.
#[derive(Debug, Clone)]
pub(super) struct Settings {
    pub(super) kind: Kind,
    pub(super) baud: Option<u32>,
    pub(super) record: Option<Record>,
    /// Its seat, if it is on a shared line.
    pub(super) seat: Option<Seat>,
    /// Its firmware, if it takes updates.
    pub(super) updates: Option<Updates>,
}

/// Firmware that takes updates.
#[derive(Debug, Clone)]
pub(super) struct Updates {
    /// Its version at first.
    pub(super) version: Version,
    /// Which signatures it accepts.
    pub(super) verify: Verify,
}

/// Whom a shared line knows as this node.
#[derive(Debug, Clone)]
pub(super) struct Seat {
    pub(super) name: String,
    pub(super) id: u64,
    pub(super) address: u8,
}

/// Bytes that the node produces at once.
const PIECE: usize = 32;
/// A whole frame: on a shared line nothing may come between its bytes.
const WHOLE: usize = 320;
/// Bytes that its serial port buffers, like a small ring in firmware.
const AHEAD: u64 = 3 * PIECE as u64;
/// The same in nanoseconds, for a line so fast that the ring would run empty before a busy system polls it
/// again.
const AHEAD_NS: u64 = 4_000_000;

/// Where the node's output goes, and when it may send more.
struct Port {
    /// `None` if the cable is unplugged: the bytes are lost.
    line: Option<Box<dyn Write + Send>>,
    /// Duration of a byte in nanoseconds; 0 means no delay.
    byte_ns: u64,
    /// When the last byte will have been sent, in nanoseconds.
    sent_ns: u64,
}

impl Port {
    fn new(baud: Option<u32>) -> Self {
        Self {
            line: None,
            byte_ns: baud.map_or(0, |baud| 10_000_000_000 / u64::from(baud.max(1))),
            sent_ns: 0,
        }
    }

    /// When it accepts another piece.
    fn ready(&self) -> Instant {
        let ahead = (AHEAD * self.byte_ns).max(AHEAD_NS);
        Instant::from_micros(self.sent_ns.saturating_sub(ahead) / 1000)
    }

    fn send(&mut self, now: Instant, bytes: &[u8]) {
        let begin = self.sent_ns.max(now.as_micros().saturating_mul(1000));
        self.sent_ns = begin + self.byte_ns * bytes.len() as u64;
        if let Some(line) = &mut self.line {
            let _ = line.write_all(bytes);
        }
    }
}

/// The flash of a device, which keeps saved parameters when it is reset.
type Flash = RefCell<HashMap<u64, Vec<u8>>>;

/// Most parameters of a device.
const SAVED: usize = 4;

struct Saved<'f>(&'f Flash);

impl Storage for Saved<'_> {
    fn read(&mut self, key: u64, buffer: &mut [u8]) -> Result<Option<usize>, SaveError> {
        let flash = self.0.borrow();
        let Some(value) = flash.get(&key) else {
            return Ok(None);
        };
        let room = buffer.get_mut(..value.len()).ok_or(SaveError::Failed)?;
        room.copy_from_slice(value);
        Ok(Some(value.len()))
    }

    fn write(&mut self, key: u64, bytes: &[u8]) -> Result<(), SaveError> {
        self.0.borrow_mut().insert(key, bytes.to_vec());
        Ok(())
    }
}

/// The only component of a device, its parameters, and its description.
struct Part<'f, C> {
    component: Tuned<(C,), (), Saved<'f>, SAVED>,
    description: &'static str,
}

impl<C: Component + Tunable> Components for Part<'_, C> {
    const DESCRIBED: bool = true;
    const PARAMETER_COUNT: u8 = <Tuned<(C,), (), Saved<'static>, SAVED>>::PARAMETER_COUNT;

    fn count(&self) -> usize {
        1
    }

    fn component(&self, index: usize) -> Option<&dyn Component> {
        self.component.component(index)
    }

    fn component_mut(&mut self, index: usize) -> Option<&mut dyn Component> {
        self.component.component_mut(index)
    }

    fn description(&self, _index: usize) -> &str {
        self.description
    }

    fn tuning(&self) -> Option<&dyn Tuning> {
        self.component.tuning()
    }

    fn tuning_mut(&mut self) -> Option<&mut dyn Tuning> {
        self.component.tuning_mut()
    }
}

/// Runs until it is stopped.
pub(super) fn run(device: &Settings, inbox: &Receiver<Input>) {
    let mut port = Port::new(device.baud);
    let pause = match device.baud {
        Some(_) => Duration::ZERO,
        None => Duration::from_millis(1),
    };
    let flash = Flash::default();
    let updates = device.updates.as_ref();
    let slots = updates.map(|it| RefCell::new(Slots::new(it.version, it.verify.clone())));
    let slots = slots.as_ref();
    let mut run = || match device.kind {
        Kind::Gripper => {
            let finger = (Axis::new(&FINGER), FINGER.description);
            run_until_reset(device, finger, inbox, (&mut port, &flash, slots))
        }
        Kind::Head => {
            let pan = (Axis::new(&PAN), PAN.description);
            run_until_reset(device, pan, inbox, (&mut port, &flash, slots))
        }
        Kind::Sensor => {
            let probe = (Sensor::new(pause), sensor::DESCRIPTION);
            run_until_reset(device, probe, inbox, (&mut port, &flash, slots))
        }
    };
    while run() {
        if let Some(record) = &device.record {
            record.write(device.kind.name(), "reset", "");
        }
    }
}

/// Returns `true` if it was reset, `false` if it was stopped.
fn run_until_reset(
    device: &Settings,
    (component, description): (impl Component + Tunable, &'static str),
    inbox: &Receiver<Input>,
    (port, flash, slots): (&mut Port, &Flash, Option<&RefCell<Slots>>),
) -> bool {
    let component = Recorded::new(component, device.record.clone());
    let component = Part {
        component: Tuned::new((component,)).load(Saved(flash)),
        description,
    };
    let name = match &device.seat {
        Some(seat) => &seat.name,
        None => device.kind.name(),
    };
    let version = slots.map(|slots| {
        slots.borrow_mut().boot();
        slots.borrow().version()
    });
    let version = version.as_deref().unwrap_or(env!("CARGO_PKG_VERSION"));
    let identity = Identity {
        // Its sensor sends as much as the line takes.
        reading_interval: Duration::ZERO,
        link_timeout: match device.seat {
            // A turn of the line waits for all nodes, whose threads are late on a busy system.
            Some(_) => SHARED_LINK_TIMEOUT,
            None => LINK_TIMEOUT,
        },
        ..Identity::new(name, version, random())
    };
    let components = Acting::new(component);
    let restarts = || slots.is_some_and(|slots| slots.borrow_mut().take_restart());
    match (&device.seat, slots) {
        (None, None) => serve(
            Node::new(identity, components),
            PIECE,
            inbox,
            port,
            restarts,
        ),
        (None, Some(slots)) => {
            let components = Updatable::new(components, SlotUpdater::new(slots));
            serve(
                Node::new(identity, components),
                PIECE,
                inbox,
                port,
                restarts,
            )
        }
        (Some(seat), None) => {
            let components = OnBus::new(components, seat.id, seat.address);
            serve(
                Node::new(identity, components),
                WHOLE,
                inbox,
                port,
                restarts,
            )
        }
        (Some(seat), Some(slots)) => {
            let components = OnBus::new(components, seat.id, seat.address);
            let components = Updatable::new(components, SlotUpdater::new(slots));
            serve(
                Node::new(identity, components),
                WHOLE,
                inbox,
                port,
                restarts,
            )
        }
    }
}

fn serve(
    mut node: Node<'_, impl Components, 4, 256>,
    piece: usize,
    inbox: &Receiver<Input>,
    port: &mut Port,
    restarts: impl Fn() -> bool,
) -> bool {
    let mut pressed = None;
    let mut buffer = vec![0; piece];
    loop {
        node.handle_timeout(now());
        if restarts() {
            return true;
        }
        let time = now();
        let wait = if time < port.ready() {
            // Output waits for the port.
            port.ready().since(time)
        } else {
            // One piece at a time: a full line or endless readings must not delay input.
            match node.poll_transmit(time, &mut buffer) {
                0 => node.poll_timeout(time).since(time),
                count => {
                    port.send(time, buffer.get(..count).unwrap_or_default());
                    Duration::ZERO
                }
            }
        };
        match inbox.recv_timeout(wait) {
            Ok(Input::Bytes(bytes)) => node.handle_bytes(now(), &bytes),
            Ok(Input::Line(other)) => port.line = other,
            Ok(Input::Push(push, done)) => {
                let _ = done.send(on_push(&mut node, now(), &mut pressed, &push));
            }
            Ok(Input::Reset) => return true,
            Ok(Input::OnLine(_)) => {}
            Err(RecvTimeoutError::Timeout) => {}
            Ok(Input::Stop) | Err(RecvTimeoutError::Disconnected) => return false,
        }
    }
}
