//! A shared, half-duplex line between several real ends.

use std::io::{self, Read, Write};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use ztl_core::time::earliest;
use ztl_std::gateway::{READ_TIMEOUT, is_pause};
use ztl_std::time::now;

use super::{CableError, End, Links, RETRY, Socket, open, prepare};
use crate::line::faults::{Counts, Faults, FaultyLine};
use crate::line::half_duplex::HalfDuplex;

/// Longest delay added to collect bytes, so that few wake-ups carry many.
const BURST: Duration = Duration::from_millis(1);
/// Bytes read at once.
const PIECE: usize = 1024;

/// Several ends on one half-duplex line, until this is dropped: each hears what the others send, and ends that send at once
/// damage each other's bytes.
///
/// An end that breaks is reopened, like one of a [`Cable`](super::Cable).
pub struct SharedCable {
    shared: Arc<Shared>,
    addresses: Vec<String>,
    stop: Arc<AtomicBool>,
    threads: Vec<JoinHandle<()>>,
    links: Links,
}

impl std::fmt::Debug for SharedCable {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("SharedCable")
            .field("addresses", &self.addresses)
            .finish_non_exhaustive()
    }
}

struct Wires {
    line: HalfDuplex,
    /// From the line to each end.
    hears: Vec<FaultyLine>,
}

impl Wires {
    /// Moves what was heard until now to the ends. Returns whether there was anything.
    fn advance(&mut self) -> bool {
        let time = now();
        let heard = self.line.poll(time);
        for heard in &heard {
            for (end, hears) in self.hears.iter_mut().enumerate() {
                if !heard.senders.contains(&end) {
                    hears.handle_bytes(time, &heard.bytes);
                }
            }
        }
        !heard.is_empty()
    }
}

struct Shared {
    wires: Mutex<Wires>,
    /// Signals that bytes were added or moved.
    changed: Condvar,
    /// The end that hears; `None` while it is closed.
    outs: Vec<Mutex<Option<Box<dyn Write + Send>>>>,
}

impl SharedCable {
    /// Joins the ends by a line of this rate. What each end hears has these faults and this latency besides.
    ///
    /// # Errors
    /// [`CableError`] if an end cannot be set up. An end that cannot be opened yet is not an error: the cable keeps trying.
    pub fn lay(
        ends: Vec<End>,
        baud: u32,
        (faults, latency): (Faults, Duration),
        seed: u64,
    ) -> Result<Self, CableError> {
        let hears = (1..).map(|end: u64| {
            let seed = seed.wrapping_add(end.wrapping_mul(0x9E37_79B9_7F4A_7C15));
            FaultyLine::new(faults, seed).with_latency(latency)
        });
        let shared = Arc::new(Shared {
            wires: Mutex::new(Wires {
                line: HalfDuplex::new(baud, seed),
                hears: hears.take(ends.len()).collect(),
            }),
            changed: Condvar::new(),
            outs: ends.iter().map(|_| Mutex::new(None)).collect(),
        });
        let mut cable = Self {
            shared: Arc::clone(&shared),
            addresses: Vec::new(),
            stop: Arc::default(),
            threads: Vec::new(),
            links: Links::default(),
        };
        for (number, end) in ends.into_iter().enumerate() {
            let (socket, address) = prepare(end, &mut cable.links)?;
            cable.addresses.push(address);
            let (line, stop) = (Arc::clone(&shared), Arc::clone(&cable.stop));
            cable.spawn("out", move || line.carry(number, &stop))?;
            let (line, stop) = (Arc::clone(&shared), Arc::clone(&cable.stop));
            cable.spawn("in", move || line.serve(number, socket, &stop))?;
        }
        Ok(cable)
    }

    /// How others reach each end, as [`Cable::addresses`](super::Cable::addresses).
    #[must_use]
    pub fn addresses(&self) -> &[String] {
        &self.addresses
    }

    /// Statistics of the bytes that each end has heard.
    #[must_use]
    pub fn counts(&self) -> Vec<Counts> {
        let wires = self.shared.wires();
        wires.hears.iter().map(FaultyLine::counts).collect()
    }

    /// How many bytes were sent while another end sent.
    #[must_use]
    pub fn collided(&self) -> u64 {
        self.shared.wires().line.collided()
    }

    fn spawn(&mut self, name: &str, run: impl FnOnce() + Send + 'static) -> Result<(), CableError> {
        let thread = std::thread::Builder::new()
            .name(format!("ztl-cable-{name}"))
            .spawn(run)
            .map_err(CableError::Thread)?;
        self.threads.push(thread);
        Ok(())
    }
}

impl Drop for SharedCable {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Release);
        for thread in self.threads.drain(..) {
            let _ = thread.join();
        }
    }
}

impl Shared {
    fn wires(&self) -> MutexGuard<'_, Wires> {
        self.wires.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn set_out(&self, end: usize, to: Option<Box<dyn Write + Send>>) {
        if let Some(out) = self.outs.get(end) {
            *out.lock().unwrap_or_else(PoisonError::into_inner) = to;
        }
    }

    /// Keeps an end open, and puts what it sends on the line.
    fn serve(&self, end: usize, mut socket: Socket, stop: &AtomicBool) {
        while !stop.load(Ordering::Acquire) {
            if let Some(line) = open(&mut socket) {
                self.set_out(end, Some(line.writer));
                let _ = self.take(end, line.reader, stop);
                self.set_out(end, None);
            }
            std::thread::sleep(RETRY);
        }
    }

    /// Reads from an end until it breaks, no faster than the line rate.
    fn take(&self, end: usize, mut reader: impl Read, stop: &AtomicBool) -> io::Result<()> {
        let mut buffer = [0; PIECE];
        while !stop.load(Ordering::Acquire) {
            let wires = self.wires();
            let room = wires.line.room(end).min(PIECE);
            if room == 0 {
                drop(self.changed.wait_timeout(wires, BURST));
                continue;
            }
            drop(wires);
            match reader.read(buffer.get_mut(..room).unwrap_or_default()) {
                Ok(0) => return Ok(()),
                Ok(count) => {
                    let bytes = buffer.get(..count).unwrap_or_default();
                    self.wires().line.send(now(), end, bytes);
                    self.changed.notify_all();
                }
                Err(error) if is_pause(&error) => {}
                Err(error) => return Err(error),
            }
        }
        Ok(())
    }

    /// Passes on what an end hears, when it is due.
    fn carry(&self, end: usize, stop: &AtomicBool) {
        let mut buffer = [0; PIECE];
        while !stop.load(Ordering::Acquire) {
            let count = self.wait_bytes(end, &mut buffer);
            let bytes = buffer.get(..count).unwrap_or_default();
            if !bytes.is_empty() && !self.write(end, bytes) {
                let mut wires = self.wires();
                if let Some(hears) = wires.hears.get_mut(end) {
                    hears.count_lost(count);
                }
            }
        }
    }

    /// Writes the bytes; returns `false` if there is no receiver.
    fn write(&self, end: usize, bytes: &[u8]) -> bool {
        let Some(out) = self.outs.get(end) else {
            return false;
        };
        let mut out = out.lock().unwrap_or_else(PoisonError::into_inner);
        out.as_mut().is_some_and(|out| out.write_all(bytes).is_ok())
    }

    /// Returns bytes that an end hears. If there are none, waits briefly.
    fn wait_bytes(&self, end: usize, buffer: &mut [u8]) -> usize {
        let mut wires = self.wires();
        let due = wires.line.poll_timeout(BURST);
        if due.is_some_and(|due| due <= now()) && wires.advance() {
            self.changed.notify_all();
        }
        let Some(hears) = wires.hears.get_mut(end) else {
            return 0;
        };
        let count = hears.poll_bytes(now(), buffer);
        if count == 0 {
            let hears = hears.poll_timeout(Duration::ZERO);
            let due = earliest(wires.line.poll_timeout(BURST), hears);
            let wait = due.map_or(READ_TIMEOUT, |due| due.since(now()).min(READ_TIMEOUT));
            drop(self.changed.wait_timeout(wires, wait));
        }
        count
    }
}
