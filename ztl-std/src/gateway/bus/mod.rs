//! Shared lines: a thread for each line, whose nodes are devices like others. A node's device has the line's thread instead
//! of a line of its own.

mod nodes;
mod port;
mod worker;

use std::io;
use std::sync::mpsc::{Sender, channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use ztl_link::bus::Bus;

use super::device::LineEvent;
use super::endpoint::{BAUD, Line};
use super::opener::Opener;
use super::report::DeviceReport;
use super::seat::Seat;
use port::Ports;
use worker::Worker;

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

/// Adds a node that was found as a device of this name. Returns why that is not possible.
pub(super) type AddNode = dyn Fn(&str, Opener, &LineStatus) -> Result<(), String> + Send;

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
    /// Starts the thread. It adds the nodes that it finds, as `name.NODE`.
    pub(super) fn spawn(
        name: &str,
        opener: Opener,
        wait: Duration,
        add_node: Box<AddNode>,
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
            add_node,
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
