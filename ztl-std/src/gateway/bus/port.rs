//! The ports of a shared line's thread: for a node's device, its port is a line like any other.

use std::collections::BTreeMap;
use std::io::{self, Read, Write};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, SyncSender, sync_channel};
use std::sync::{Arc, OnceLock};

use super::Input;
use crate::gateway::endpoint::{Line, READ_TIMEOUT};
use crate::gateway::seat::Seat;

/// Most frames that wait for a device. Further ones are lost, as on any line.
const FRAMES: usize = 64;

struct Port {
    number: u64,
    seat: Arc<Seat>,
    frames: SyncSender<Vec<u8>>,
    /// Why it was closed.
    why: Arc<OnceLock<String>>,
}

/// The open ports by their address.
pub(super) struct Ports {
    pub(super) inputs: Sender<Input>,
    number: u64,
    open: BTreeMap<u8, Port>,
}

impl Ports {
    pub(super) fn new(inputs: Sender<Input>) -> Self {
        Self {
            inputs,
            number: 0,
            open: BTreeMap::new(),
        }
    }

    /// Opens the port of a node, instead of one that is open at its address.
    pub(super) fn open(&mut self, seat: Arc<Seat>) -> Line {
        self.number += 1;
        let (frames, inbox) = sync_channel(FRAMES);
        let why = Arc::<OnceLock<String>>::default();
        let port = Port {
            number: self.number,
            seat: Arc::clone(&seat),
            frames,
            why: Arc::clone(&why),
        };
        let address = seat.address();
        self.close(address, "another node is served at its address now");
        self.open.insert(address, port);
        let writer = Writer {
            number: self.number,
            inputs: self.inputs.clone(),
        };
        let reader = Reader {
            frames: inbox,
            rest: Vec::new(),
            why,
        };
        Line::new(reader, writer)
    }

    pub(super) fn is_empty(&self) -> bool {
        self.open.is_empty()
    }

    /// The address of the port with this number, if it is still open.
    pub(super) fn address(&self, number: u64) -> Option<u8> {
        let mut ports = self.open.iter();
        let port = ports.find(|(_, port)| port.number == number);
        port.map(|(address, _)| *address)
    }

    pub(super) fn seats(&self) -> impl Iterator<Item = (u8, &Seat)> {
        self.open
            .iter()
            .map(|(address, port)| (*address, &*port.seat))
    }

    /// Whether devices of nodes ask for a search, which is one for all of them.
    pub(super) fn want_search(&self) -> bool {
        let wanted = self.open.values().filter(|port| port.seat.take_wanted());
        wanted.count() > 0
    }

    /// Whether the node at an address may hold tasks.
    pub(super) fn is_busy(&self, address: u8) -> bool {
        let port = self.open.get(&address);
        port.is_some_and(|port| port.seat.needs().busy)
    }

    pub(super) fn seat(&self, address: u8) -> Option<&Arc<Seat>> {
        self.open.get(&address).map(|port| &port.seat)
    }

    /// Whether the port at an address is that of this node.
    pub(super) fn has(&self, address: u8, seat: &Arc<Seat>) -> bool {
        self.seat(address).is_some_and(|its| Arc::ptr_eq(its, seat))
    }

    pub(super) fn put(&self, address: u8, frame: Vec<u8>) {
        if let Some(port) = self.open.get(&address) {
            let _ = port.frames.try_send(frame);
        }
    }

    /// Closes a port. Its device sees the end of its line, and is told why.
    pub(super) fn close(&mut self, address: u8, why: &str) {
        if let Some(port) = self.open.remove(&address) {
            let _ = port.why.set(why.to_owned());
        }
    }

    pub(super) fn close_all(&mut self, why: &str) {
        for port in std::mem::take(&mut self.open).into_values() {
            let _ = port.why.set(why.to_owned());
        }
    }
}

struct Reader {
    frames: Receiver<Vec<u8>>,
    /// What did not fit the last buffer.
    rest: Vec<u8>,
    why: Arc<OnceLock<String>>,
}

impl Read for Reader {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        if self.rest.is_empty() {
            self.rest = match self.frames.recv_timeout(READ_TIMEOUT) {
                Ok(frame) => frame,
                Err(RecvTimeoutError::Timeout) => return Err(io::ErrorKind::TimedOut.into()),
                Err(RecvTimeoutError::Disconnected) => {
                    let why = self.why.get().cloned();
                    return why.map_or(Ok(0), |why| Err(io::Error::other(why)));
                }
            };
        }
        let count = self.rest.as_slice().read(buffer)?;
        self.rest.drain(..count);
        Ok(count)
    }
}

struct Writer {
    number: u64,
    inputs: Sender<Input>,
}

impl Write for Writer {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let sent = self.inputs.send(Input::Frames(self.number, bytes.to_vec()));
        match sent {
            Ok(()) => Ok(bytes.len()),
            Err(_) => Err(io::ErrorKind::UnexpectedEof.into()),
        }
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl Drop for Writer {
    fn drop(&mut self) {
        let _ = self.inputs.send(Input::Close(self.number));
    }
}
