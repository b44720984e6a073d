//! Simulated devices: `ztl-mcu`'s real node with simulated motors, on a real byte stream.

use std::io::{self, Read, Write};
use std::net::{SocketAddr, TcpListener};
#[cfg(unix)]
use std::path::PathBuf;
use std::str::FromStr;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::thread::JoinHandle;
use std::time::Duration;

use ztl_mcu::link::{Busy, GoalShape, Loss, Offer};
use ztl_mcu::{Component, Identity, Instant, Node, Refused, Report, Run};

use crate::clock::now;
use crate::gateway::{EndpointError, Line, is_pause};
#[cfg(unix)]
use crate::pty::{Link, Pty};
use crate::random;

/// Which device is simulated.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// `finger`: its opening in percent, 0 to 100, at 50 percent a second.
    Gripper,
    /// `pan`: degrees from -90 to 90, or left, straight, right, at 90 degrees a second.
    Head,
}

impl Kind {
    /// Every simulated device.
    pub const ALL: [Self; 2] = [Self::Gripper, Self::Head];

    /// Its name, as in `sim:gripper`.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Gripper => "gripper",
            Self::Head => "head",
        }
    }

    fn axis(self) -> Axis {
        match self {
            Self::Gripper => Axis::new(&FINGER),
            Self::Head => Axis::new(&PAN),
        }
    }
}

impl std::fmt::Display for Kind {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for Kind {
    type Err = EndpointError;

    fn from_str(text: &str) -> Result<Self, EndpointError> {
        Self::ALL
            .into_iter()
            .find(|kind| kind.name() == text)
            .ok_or_else(|| EndpointError::Simulation {
                found: text.to_owned(),
                known: Self::ALL.map(Self::name).join(", "),
            })
    }
}

/// What an axis can do.
#[derive(Debug)]
struct AxisKind {
    name: &'static str,
    range: (f32, f32),
    unit: &'static str,
    /// Units a second.
    speed: f32,
    words: &'static str,
    /// The positions that the words stand for.
    places: &'static [(&'static str, f32)],
    /// What is said about any other goal.
    takes: &'static str,
}

const FINGER: AxisKind = AxisKind {
    name: "finger",
    range: (0.0, 100.0),
    unit: "percent",
    speed: 50.0,
    words: "",
    places: &[],
    takes: "finger takes 0 to 100 percent",
};

const PAN: AxisKind = AxisKind {
    name: "pan",
    range: (-90.0, 90.0),
    unit: "degrees",
    speed: 90.0,
    words: "left straight right",
    places: &[("left", 90.0), ("straight", 0.0), ("right", -90.0)],
    takes: "pan takes -90 to 90 degrees, or left, straight, right",
};

/// A motor that moves at constant speed.
#[derive(Debug)]
struct Axis {
    kind: &'static AxisKind,
    /// Where it began to move, and when.
    from: (f32, Instant),
    target: f32,
    stopped: bool,
}

impl Axis {
    fn new(kind: &'static AxisKind) -> Self {
        Self {
            kind,
            from: (0.0, Instant::ZERO),
            target: 0.0,
            stopped: false,
        }
    }

    fn position(&self, now: Instant) -> f32 {
        let (start, at) = self.from;
        let way = self.kind.speed * now.since(at).as_secs_f32();
        if self.target >= start {
            (start + way).min(self.target)
        } else {
            (start - way).max(self.target)
        }
    }

    fn move_to(&mut self, now: Instant, target: f32) {
        self.from = (self.position(now), now);
        self.target = target;
    }

    fn target_of(&self, goal: &str) -> Option<f32> {
        let word = self.kind.places.iter().find(|(word, _)| *word == goal);
        word.map(|(_, place)| *place)
            .or_else(|| goal.trim().parse().ok())
            .filter(|target| (self.kind.range.0..=self.kind.range.1).contains(target))
    }

    fn stop(&mut self, now: Instant) {
        self.move_to(now, self.position(now));
        self.stopped = true;
    }
}

impl Component for Axis {
    fn offer(&self) -> Offer<'_> {
        Offer {
            name: self.kind.name,
            goal: GoalShape {
                range: Some(self.kind.range),
                unit: self.kind.unit,
                words: self.kind.words,
            },
            busy: Busy::Refuse,
            loss: Loss::Abort,
            topics: "",
        }
    }

    fn check(&self, goal: &str, why: &mut Report<'_>) -> Result<(), Refused> {
        self.target_of(goal).map(drop).ok_or_else(|| {
            why.text(self.kind.takes);
            Refused
        })
    }

    fn start(&mut self, now: Instant, goal: &str, _: &mut Report<'_>) -> Result<(), Refused> {
        let target = self.target_of(goal).ok_or(Refused)?;
        self.stopped = false;
        self.move_to(now, target);
        Ok(())
    }

    fn poll(&mut self, now: Instant, report: &mut Report<'_>) -> Run {
        let position = self.position(now);
        report.number(position, 1);
        if self.stopped {
            Run::Aborted
        } else if position == self.target {
            Run::Completed
        } else {
            Run::Running
        }
    }

    fn abort(&mut self, now: Instant) {
        self.stop(now);
    }

    fn make_safe(&mut self, now: Instant) {
        self.stop(now);
    }
}

enum Input {
    Bytes(Vec<u8>),
    /// Where the node's bytes go from now on.
    Line(Option<Box<dyn Write + Send>>),
    Stop,
}

/// A simulated device; its power is cut when this is dropped.
pub struct Running {
    inputs: Sender<Input>,
    stop: Arc<AtomicBool>,
    threads: Vec<JoinHandle<()>>,
    #[cfg(unix)]
    _pty: Option<(Pty, Option<Link>)>,
}

impl std::fmt::Debug for Running {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Running")
    }
}

impl Running {
    fn power_on(kind: Kind) -> io::Result<Self> {
        let (inputs, inbox) = channel();
        let node = std::thread::Builder::new()
            .name(format!("ztl-sim-{kind}"))
            .spawn(move || run_node(kind, &inbox))?;
        Ok(Self {
            inputs,
            stop: Arc::new(AtomicBool::new(false)),
            threads: vec![node],
            #[cfg(unix)]
            _pty: None,
        })
    }

    /// Starts a device on one end of a pty, and gives the path of the other: of the link to it,
    /// where one is wanted, which goes when the device goes.
    ///
    /// # Errors
    /// When the system has no more ptys or threads, or when the link cannot be made.
    #[cfg(unix)]
    pub fn on_pty(kind: Kind, link: Option<PathBuf>) -> io::Result<(Self, String)> {
        let pty = Pty::new()?;
        let mut path = pty.path().to_owned();
        let link = link
            .map(|link| {
                path = link.display().to_string();
                Link::new(link, pty.path())
            })
            .transpose()?;
        let line = pty.line()?;
        let mut running = Self::power_on(kind)?;
        running._pty = Some((pty, link));
        let _ = running.inputs.send(Input::Line(Some(line.writer)));
        let (inputs, stop) = (running.inputs.clone(), Arc::clone(&running.stop));
        let pump = std::thread::Builder::new()
            .name(format!("ztl-sim-{kind}-line"))
            .spawn(move || pass_on(line.reader, &inputs, &stop))?;
        running.threads.push(pump);
        Ok((running, path))
    }

    /// Starts a device that takes one TCP connection after the other, and gives its address.
    ///
    /// # Errors
    /// When nothing can listen at `address`.
    pub fn on_tcp(kind: Kind, address: &str) -> io::Result<(Self, SocketAddr)> {
        let listener = TcpListener::bind(address)?;
        let address = listener.local_addr()?;
        // To be stopped, it must not wait in accept.
        listener.set_nonblocking(true)?;
        let mut running = Self::power_on(kind)?;
        let (inputs, stop) = (running.inputs.clone(), Arc::clone(&running.stop));
        let serve = std::thread::Builder::new()
            .name(format!("ztl-sim-{kind}-tcp"))
            .spawn(move || serve_tcp(&listener, &inputs, &stop))?;
        running.threads.push(serve);
        Ok((running, address))
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Release);
        let _ = self.inputs.send(Input::Stop);
        for thread in self.threads.drain(..) {
            let _ = thread.join();
        }
    }
}

/// Starts a device in this process and gives the line to it.
///
/// # Errors
/// When the system has no more ptys or threads.
#[cfg(unix)]
pub(crate) fn line(kind: Kind) -> io::Result<Line> {
    let (running, path) = Running::on_pty(kind, None)?;
    let port = serialport::new(path, crate::gateway::BAUD)
        .timeout(crate::gateway::READ_TIMEOUT)
        .open()?;
    let mut line = Line::serial(port)?;
    line.device = Some(running);
    Ok(line)
}

/// Without ptys, over TCP on this machine.
///
/// # Errors
/// When nothing can listen there.
#[cfg(not(unix))]
pub(crate) fn line(kind: Kind) -> io::Result<Line> {
    let (running, address) = Running::on_tcp(kind, "127.0.0.1:0")?;
    let mut line = Line::tcp(std::net::TcpStream::connect(address)?)?;
    line.device = Some(running);
    Ok(line)
}

/// The firmware's main loop.
fn run_node(kind: Kind, inbox: &Receiver<Input>) {
    let identity = Identity::new(kind.name(), env!("CARGO_PKG_VERSION"), random::nonzero());
    let mut node = Node::<_, 4, 256>::new(identity, [kind.axis()]);
    let mut line: Option<Box<dyn Write + Send>> = None;
    let mut buffer = [0; 256];
    loop {
        let time = now();
        node.handle_timeout(time);
        loop {
            let count = node.poll_transmit(time, &mut buffer);
            if count == 0 {
                break;
            }
            // Nobody there: the bytes are lost, as on a cable that is not plugged in.
            if let Some(line) = &mut line {
                let _ = line.write_all(buffer.get(..count).unwrap_or_default());
            }
        }
        match inbox.recv_timeout(node.poll_timeout(time).since(time)) {
            Ok(Input::Bytes(bytes)) => node.handle_bytes(now(), &bytes),
            Ok(Input::Line(other)) => line = other,
            Err(RecvTimeoutError::Timeout) => {}
            Ok(Input::Stop) | Err(RecvTimeoutError::Disconnected) => return,
        }
    }
}

/// Passes on what arrives, until the stream ends.
fn pass_on(mut reader: impl Read, inputs: &Sender<Input>, stop: &AtomicBool) {
    let mut buffer = [0; 256];
    while !stop.load(Ordering::Acquire) {
        match reader.read(&mut buffer) {
            Ok(0) => return,
            Ok(count) => {
                let bytes = buffer.get(..count).unwrap_or_default().to_vec();
                if inputs.send(Input::Bytes(bytes)).is_err() {
                    return;
                }
            }
            Err(error) if is_pause(&error) => {}
            Err(_) => return,
        }
    }
}

fn serve_tcp(listener: &TcpListener, inputs: &Sender<Input>, stop: &AtomicBool) {
    while !stop.load(Ordering::Acquire) {
        let stream = match listener.accept() {
            Ok((stream, _)) => stream,
            Err(_) => {
                std::thread::sleep(Duration::from_millis(10));
                continue;
            }
        };
        if stream.set_nonblocking(false).is_err() {
            continue;
        }
        let Ok(line) = Line::tcp(stream) else {
            continue;
        };
        let _ = inputs.send(Input::Line(Some(line.writer)));
        pass_on(line.reader, inputs, stop);
        let _ = inputs.send(Input::Line(None));
    }
}
