//! Shared lines: a thread for each line, whose nodes are devices like others. A node's device has the line's thread instead
//! of a line of its own.

mod nodes;
mod port;
mod worker;

use std::io;
use std::sync::atomic::{AtomicU8, Ordering};
use std::sync::mpsc::{Sender, channel};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};
use std::time::Duration;

use ztl_link::BusNeeds;
use ztl_link::bus::Bus;

use super::device::LineEvent;
use super::devices::Devices;
use super::endpoint::{BAUD, Line};
use super::opener::Opener;
use super::report::DeviceReport;
use port::Ports;
use worker::Worker;

/// A node's place on a shared line.
#[derive(Debug, Default)]
pub(super) struct Seat {
    address: AtomicU8,
    /// The name of its firmware, as a search has found it.
    firmware: OnceLock<String>,
    needs: Mutex<BusNeeds>,
    board: Mutex<Board>,
}

/// What searches have found at a node's address.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct Board {
    /// The id of the board that is served.
    pub(super) id: u64,
    /// How many searches have ended, and whether the last one found this board alone at the address.
    pub(super) searches: u64,
    pub(super) alone: bool,
    /// Why the node takes no tasks, although it still has some.
    pub(super) conflict: Option<String>,
}

impl Seat {
    /// The node's address.
    pub(super) fn address(&self) -> u8 {
        self.address.load(Ordering::Acquire)
    }

    fn set_address(&self, address: u8) {
        self.address.store(address, Ordering::Release);
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

    fn on_search(&self, id: u64, alone: bool, conflict: Option<String>) {
        let mut board = self.locked_board();
        board.searches += 1;
        (board.id, board.alone, board.conflict) = (id, alone, conflict);
    }

    fn needs(&self) -> BusNeeds {
        *self.needs.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Sets what the node's session needs, before what it transmits.
    pub(super) fn set_needs(&self, needs: BusNeeds) {
        *self.needs.lock().unwrap_or_else(PoisonError::into_inner) = needs;
    }
}

/// A message to a line's thread.
enum Input {
    /// Of the opened line with this number.
    Line(u64, LineEvent),
    /// A node's device wants its port.
    Open(Arc<Seat>, Sender<io::Result<Line>>),
    /// What a node's session transmits at the port with this number.
    Frames(u64, Vec<u8>),
    /// The port with this number is not used any more.
    Close(u64),
    /// Close the line when no port is in use.
    Retire,
}

#[derive(Debug, Default)]
struct Status {
    ready: bool,
    problem: Option<String>,
}

/// What is wrong with a line, for other threads.
#[derive(Debug, Clone, Default)]
pub(super) struct LineStatus(Arc<Mutex<Status>>);

impl LineStatus {
    fn lock(&self) -> MutexGuard<'_, Status> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// A line's thread. Dropping it ends the thread when all ports are closed.
#[derive(Debug)]
pub(super) struct SharedLine {
    url: String,
    inputs: Sender<Input>,
    status: LineStatus,
    /// The devices of its nodes.
    pub(super) devices: Vec<String>,
}

impl SharedLine {
    /// Starts the thread. It adds the nodes that it finds to `devices`, as `name.NODE`.
    pub(super) fn spawn(
        name: &str,
        opener: Opener,
        wait: Duration,
        devices: Devices,
    ) -> io::Result<Self> {
        let (inputs, inbox) = channel();
        let (url, status) = (opener.label.clone(), LineStatus::default());
        let bus = Bus::new(opener.baud.unwrap_or(BAUD), wait);
        let mut worker = Worker::new(
            name,
            opener,
            bus,
            Ports::new(inputs.clone()),
            status.clone(),
            devices,
        );
        std::thread::Builder::new()
            .name(format!("ztl-bus-{name}"))
            .spawn(move || worker.run(&inbox))?;
        Ok(Self {
            url,
            inputs,
            status,
            devices: Vec::new(),
        })
    }

    /// Whether it is the line whose thread has this status.
    pub(super) fn is(&self, status: &LineStatus) -> bool {
        Arc::ptr_eq(&self.status.0, &status.0)
    }

    pub(super) fn report(&self) -> DeviceReport {
        let status = self.status.lock();
        DeviceReport::of_line(self.url.clone(), status.ready, status.problem.clone())
    }
}

impl Drop for SharedLine {
    fn drop(&mut self) {
        let _ = self.inputs.send(Input::Retire);
    }
}
