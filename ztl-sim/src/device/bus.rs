//! A simulated shared line: several nodes, of which one at a time may speak.

use std::fs::File;
use std::io::{self, Write};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::time::Duration;

use ztl_core::Instant;
use ztl_core::manifest::{Parsed, Version};
use ztl_std::time::now;

use super::Machine;
use super::buttons::Buttons;
use super::input::{Input, OnLine};
use super::kind::Kind;
use super::power::{self, Seat, Settings, Updates};
use super::record::Record;
use super::slots::Verify;
use ztl_std::gateway::BAUD;

/// A node of a simulated shared line.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct BusNode {
    /// Its name in its firmware.
    pub name: String,
    /// What it is.
    pub kind: Kind,
    /// Its address, 1 to 32; 0 if the gateway is to give it one.
    pub address: u8,
}

/// A shared line to simulate. Nodes that speak at once damage each other's frames.
#[derive(Debug)]
pub struct Bus {
    nodes: Vec<BusNode>,
    baud: u32,
    record: Option<File>,
    updates: Option<Updates>,
}

impl Bus {
    /// A line of 115,200 bits a second with these nodes.
    #[must_use]
    pub const fn new(nodes: Vec<BusNode>) -> Self {
        Self {
            nodes,
            baud: BAUD,
            record: None,
            updates: None,
        }
    }

    /// Lets all nodes take firmware updates, like [`Device::with_updates`](super::Device::with_updates).
    #[must_use]
    pub fn with_updates(
        mut self,
        version: Version,
        verify: impl Fn(&Parsed<'_>) -> bool + Send + Sync + 'static,
    ) -> Self {
        self.updates = Some(Updates {
            version,
            verify: Verify(Arc::new(verify)),
        });
        self
    }

    /// Sets the line rate in bits per second, ten per byte.
    #[must_use]
    pub const fn with_baud(mut self, baud: u32) -> Self {
        self.baud = baud;
        self
    }

    /// Records what the nodes do, like [`Device::with_record`](super::Device::with_record), with components as `NODE.finger`.
    #[must_use]
    pub fn with_record(mut self, file: File) -> Self {
        self.record = Some(file);
        self
    }

    /// Starts it on a pty, like [`Device::on_pty`](super::Device::on_pty).
    ///
    /// # Errors
    /// The same.
    #[cfg(unix)]
    pub fn on_pty(self, link: Option<std::path::PathBuf>) -> io::Result<(super::Running, String)> {
        self.machine()?.on_pty(link)
    }

    /// Starts it on a TCP listener, like [`Device::on_tcp`](super::Device::on_tcp).
    ///
    /// # Errors
    /// The same.
    pub fn on_tcp(self, address: &str) -> io::Result<(super::Running, std::net::SocketAddr)> {
        self.machine()?.on_tcp(address)
    }

    fn machine(self) -> io::Result<Machine> {
        let record = self.record.map(Record::new);
        let byte_time = Duration::from_nanos(10_000_000_000 / u64::from(self.baud.max(1)));
        let mut nodes = Vec::new();
        for (id, node) in (1..).zip(self.nodes) {
            let (inputs, inbox) = channel();
            let settings = Settings {
                kind: node.kind,
                baud: None,
                record: record.as_ref().map(|record| record.of(&node.name)),
                seat: Some(Seat {
                    name: node.name.clone(),
                    id: unique(&node.name, id),
                    address: node.address,
                }),
                updates: self.updates.clone(),
            };
            std::thread::Builder::new()
                .name(format!("ztl-sim-{}", node.name))
                .spawn(move || power::run(&settings, &inbox))?;
            nodes.push(Node {
                name: node.name,
                inputs,
                on: true,
            });
        }
        let run = move |inbox: &Receiver<Input>, inputs: &Sender<Input>| {
            for (number, node) in nodes.iter().enumerate() {
                let inputs = inputs.clone();
                let writer = Writer { number, inputs };
                let _ = node.inputs.send(Input::Line(Some(Box::new(writer))));
            }
            let line = Line {
                nodes,
                byte_time,
                gateway: None,
                speaking: Vec::new(),
                since: Instant::ZERO,
            };
            line.run(inbox);
        };
        Ok(Machine {
            name: "bus".to_owned(),
            run: Box::new(run),
        })
    }
}

/// An id, spread over all bits, as those of chips are. Nodes of several simulated lines that are joined have different ones
/// if they have different names.
fn unique(name: &str, number: u64) -> u64 {
    let fold = |id: u64, byte: u8| (id ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01B3);
    name.bytes().fold(0xCBF2_9CE4_8422_2325, fold) ^ number.wrapping_mul(0x9E37_79B9_7F4A_7C15)
}

/// A node's end of the line.
struct Writer {
    number: usize,
    inputs: Sender<Input>,
}

impl Write for Writer {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let spoken = OnLine::Spoken(self.number, bytes.to_vec());
        let _ = self.inputs.send(Input::OnLine(spoken));
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

struct Node {
    name: String,
    inputs: Sender<Input>,
    on: bool,
}

struct Line {
    nodes: Vec<Node>,
    byte_time: Duration,
    gateway: Option<Box<dyn Write + Send>>,
    /// Who speaks, and what; `None` is the gateway.
    speaking: Vec<(Option<usize>, Vec<u8>)>,
    /// When the first of them began.
    since: Instant,
}

impl Line {
    /// Runs until the power is cut.
    fn run(mut self, inbox: &Receiver<Input>) {
        loop {
            let wait = match self.speaking.is_empty() {
                true => Duration::from_secs(60),
                false => self.end().since(now()),
            };
            match inbox.recv_timeout(wait) {
                Ok(Input::Bytes(bytes)) => self.speak(None, &bytes),
                Ok(Input::Line(gateway)) => self.gateway = gateway,
                Ok(Input::OnLine(event)) => self.on_event(event),
                Ok(Input::Reset) => self.tell(|| Input::Reset),
                Ok(Input::Push(..)) | Err(RecvTimeoutError::Timeout) => {}
                Ok(Input::Stop) | Err(RecvTimeoutError::Disconnected) => {
                    return self.tell(|| Input::Stop);
                }
            }
            if !self.speaking.is_empty() && now() >= self.end() {
                self.deliver();
            }
        }
    }

    fn tell(&self, input: impl Fn() -> Input) {
        for node in &self.nodes {
            let _ = node.inputs.send(input());
        }
    }

    /// When everybody has ended.
    fn end(&self) -> Instant {
        let longest = self.speaking.iter().map(|(_, bytes)| bytes.len()).max();
        self.since + self.byte_time * u32::try_from(longest.unwrap_or(0)).unwrap_or(u32::MAX)
    }

    fn speak(&mut self, who: Option<usize>, bytes: &[u8]) {
        if self.speaking.is_empty() {
            self.since = now();
        }
        match self.speaking.iter_mut().find(|(known, _)| *known == who) {
            Some((_, begun)) => begun.extend_from_slice(bytes),
            None => self.speaking.push((who, bytes.to_vec())),
        }
    }

    /// All but the speakers hear what was spoken; noise if there were several.
    fn deliver(&mut self) {
        let mut speaking = std::mem::take(&mut self.speaking);
        let speaks = |who| speaking.iter().any(|(known, _)| *known == who);
        let (to_gateway, silent): (bool, Vec<bool>) = (
            !speaks(None),
            (0..self.nodes.len())
                .map(|number| !speaks(Some(number)))
                .collect(),
        );
        let longest = speaking.iter().map(|(_, bytes)| bytes.len()).max();
        let heard = match (speaking.pop(), speaking.is_empty()) {
            (Some((_, bytes)), true) => bytes,
            _ => {
                let mut noise = vec![0xff; longest.unwrap_or(0)];
                noise.push(0);
                noise
            }
        };
        for (node, _) in self.nodes.iter().zip(silent).filter(|(_, silent)| *silent) {
            if node.on {
                let _ = node.inputs.send(Input::Bytes(heard.clone()));
            }
        }
        if let Some(gateway) = self.gateway.as_mut().filter(|_| to_gateway) {
            let _ = gateway.write_all(&heard);
        }
    }

    fn on_event(&mut self, event: OnLine) {
        match event {
            OnLine::Spoken(number, bytes) => {
                if self.nodes.get(number).is_some_and(|node| node.on) {
                    self.speak(Some(number), &bytes);
                }
            }
            OnLine::Power(name, on, done) => {
                let named = self.nodes.iter_mut().find(|node| node.name == name);
                let answer = match named {
                    None => Err(self.no_node(&name)),
                    Some(node) => {
                        node.on = on;
                        let _ = node.inputs.send(Input::Reset);
                        Ok(())
                    }
                };
                let _ = done.send(answer);
            }
            OnLine::Find(name, answer) => {
                let node = self.nodes.iter().find(|node| node.name == name);
                let _ = answer.send(node.map(|node| node.inputs.clone()));
            }
        }
    }

    fn no_node(&self, name: &str) -> String {
        let names: Vec<&str> = self.nodes.iter().map(|node| node.name.as_str()).collect();
        format!("no node '{name}'; there are: {}", names.join(", "))
    }
}

/// The nodes of a running simulated line.
#[derive(Debug, Clone)]
pub struct Switches(pub(super) Sender<Input>);

impl Switches {
    /// Switches the first node with this name on or off. It loses what it was doing.
    ///
    /// # Errors
    /// If there is no such node.
    pub fn power(&self, name: &str, on: bool) -> Result<(), String> {
        let (done, answer) = channel();
        let power = OnLine::Power(name.to_owned(), on, done);
        let _ = self.0.send(Input::OnLine(power));
        answer
            .recv()
            .unwrap_or_else(|_| Err("the line is switched off".to_owned()))
    }

    /// The buttons of the first node with this name.
    #[must_use]
    pub fn buttons(&self, name: &str) -> Option<Buttons> {
        let (done, answer) = channel();
        let asked = OnLine::Find(name.to_owned(), done);
        let _ = self.0.send(Input::OnLine(asked));
        answer.recv().ok().flatten().map(Buttons)
    }
}
