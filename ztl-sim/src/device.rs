//! Simulated devices: the real node of `ztl-mcu` with simulated motors, on a real byte stream.

mod axis;
mod bus;
mod buttons;
mod input;
pub(crate) mod kind;
mod power;
mod record;
mod sensor;
mod slots;

use std::fs::File;
use std::io::{self, Read};
use std::net::{SocketAddr, TcpListener};
#[cfg(unix)]
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::thread::JoinHandle;
use std::time::Duration;

#[cfg(unix)]
use crate::pty::{Link, Pty};
pub use bus::{Bus, BusNode, Switches};
pub use buttons::Buttons;
use input::Input;
use kind::{Kind, UnknownKind};
use power::{Settings, Updates};
use record::Record;
pub use slots::BOARD;
use slots::Verify;
use ztl_core::manifest::{Parsed, Version};
#[cfg(unix)]
use ztl_std::gateway::{BAUD, READ_TIMEOUT};
use ztl_std::gateway::{Endpoint, EndpointError, InProcess, Line, is_pause};

/// Where a device is, with `sim:gripper` for one that is simulated in this process.
///
/// # Errors
/// What is wrong with the text, and what would be right.
pub fn endpoint(text: &str) -> Result<Endpoint, String> {
    if let Some(kind) = text.strip_prefix("sim:") {
        let kind: Kind = kind
            .parse()
            .map_err(|error: UnknownKind| error.to_string())?;
        return Ok(Endpoint::InProcess(InProcess::new(text, move || {
            line(kind)
        })));
    }
    text.parse().map_err(|error| match error {
        EndpointError::Scheme { .. } => format!("{error}, or sim:gripper for a simulated device"),
        error => error.to_string(),
    })
}

/// A device to simulate.
///
/// ```no_run
/// use ztl_sim::{Device, Kind};
///
/// # fn main() -> std::io::Result<()> {
/// let (running, address) = Device::new(Kind::Gripper).on_tcp("127.0.0.1:0")?;
/// println!("ztl gateway --device gripper=tcp:{address} -p 12345 -s /lab");
/// # drop(running);
/// # Ok(())
/// # }
/// ```
#[derive(Debug, Clone)]
pub struct Device(Settings);

impl Device {
    /// Creates a device that sends as fast as its line accepts.
    #[must_use]
    pub const fn new(kind: Kind) -> Self {
        Self(Settings {
            kind,
            baud: None,
            record: None,
            seat: None,
            updates: None,
        })
    }

    /// Sets the rate at which it sends, in bits per second, ten per byte.
    #[must_use]
    pub const fn with_baud(mut self, baud: u32) -> Self {
        self.0.baud = Some(baud);
        self
    }

    /// Writes a line to `file` when a task really begins or ends, and at each reset: seconds, component,
    /// event, goal, such as `12.345678 finger begins '40'`.
    #[must_use]
    pub fn with_record(mut self, file: File) -> Self {
        self.0.record = Some(Record::new(file));
        self
    }

    /// Lets it take firmware updates into memory: it runs `version` at first, and takes images for the board [`BOARD`] whose
    /// signature is valid by `verify`. The image is a text. Each of its lines may be `self-test: GOAL`, with which the new
    /// firmware tests its component, or `trial: MILLISECONDS`, how long it waits for a confirmation.
    #[must_use]
    pub fn with_updates(
        mut self,
        version: Version,
        verify: impl Fn(&Parsed<'_>) -> bool + Send + Sync + 'static,
    ) -> Self {
        self.0.updates = Some(Updates {
            version,
            verify: Verify(Arc::new(verify)),
        });
        self
    }

    /// Starts it on a pty and returns the path of the other end. With `link`, that is a link to it, which is
    /// removed with the device.
    ///
    /// # Errors
    /// If the system has no more ptys or threads, or the link cannot be created.
    #[cfg(unix)]
    pub fn on_pty(self, link: Option<PathBuf>) -> io::Result<(Running, String)> {
        self.machine().on_pty(link)
    }

    /// Starts it on a TCP listener, which accepts one connection at a time, and returns the address.
    ///
    /// # Errors
    /// If it cannot listen on `address`.
    pub fn on_tcp(self, address: &str) -> io::Result<(Running, SocketAddr)> {
        self.machine().on_tcp(address)
    }

    fn machine(self) -> Machine {
        Machine {
            name: self.0.kind.name().to_owned(),
            run: Box::new(move |inbox, _| power::run(&self.0, inbox)),
        }
    }
}

/// What runs at the end of a line, on a thread.
struct Machine {
    name: String,
    run: Box<RunMachine>,
}

/// Runs on what is received; the sender is for its parts.
type RunMachine = dyn FnOnce(&Receiver<Input>, &Sender<Input>) + Send;

impl Machine {
    #[cfg(unix)]
    fn on_pty(self, link: Option<PathBuf>) -> io::Result<(Running, String)> {
        let name = self.name.clone();
        let pty = Pty::new()?;
        let mut path = pty.path().to_owned();
        let link = link
            .map(|link| {
                path = link.display().to_string();
                Link::new(link, pty.path())
            })
            .transpose()?;
        let line = pty.line()?;
        let mut running = Running::power_on(self)?;
        running._pty = Some((pty, link));
        let _ = running.inputs.send(Input::Line(Some(line.writer)));
        let (inputs, stop) = (running.inputs.clone(), Arc::clone(&running.stop));
        let pump = std::thread::Builder::new()
            .name(format!("ztl-sim-{name}-line"))
            .spawn(move || forward(line.reader, &inputs, &stop))?;
        running.threads.push(pump);
        Ok((running, path))
    }

    fn on_tcp(self, address: &str) -> io::Result<(Running, SocketAddr)> {
        let name = self.name.clone();
        let listener = TcpListener::bind(address)?;
        let address = listener.local_addr()?;
        // Must not block in accept, so that it can be stopped.
        listener.set_nonblocking(true)?;
        let mut running = Running::power_on(self)?;
        let (inputs, stop) = (running.inputs.clone(), Arc::clone(&running.stop));
        let serve = std::thread::Builder::new()
            .name(format!("ztl-sim-{name}-tcp"))
            .spawn(move || serve_tcp(&listener, &inputs, &stop))?;
        running.threads.push(serve);
        Ok((running, address))
    }
}

/// A running simulated device; dropping it cuts its power.
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
    fn power_on(machine: Machine) -> io::Result<Self> {
        let (inputs, inbox) = channel();
        let of_parts = inputs.clone();
        let node = std::thread::Builder::new()
            .name(format!("ztl-sim-{}", machine.name))
            .spawn(move || (machine.run)(&inbox, &of_parts))?;
        Ok(Self {
            inputs,
            stop: Arc::new(AtomicBool::new(false)),
            threads: vec![node],
            #[cfg(unix)]
            _pty: None,
        })
    }

    /// Its buttons.
    #[must_use]
    pub fn buttons(&self) -> Buttons {
        Buttons(self.inputs.clone())
    }

    /// The nodes, if it is a shared line.
    #[must_use]
    pub fn switches(&self) -> Switches {
        Switches(self.inputs.clone())
    }

    /// Returns a function that resets the device, or all nodes: its power is cut and restored, its line stays.
    pub fn reset(&self) -> impl Fn() + Send + use<> {
        let inputs = self.inputs.clone();
        move || {
            let _ = inputs.send(Input::Reset);
        }
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

/// Starts a device in this process and returns its line: a pty, as for a real device. Without ptys, as in a
/// container without `/dev/ptmx`, TCP on this machine.
///
/// # Errors
/// If the system has no more threads, or it cannot listen.
fn line(kind: Kind) -> io::Result<Line> {
    #[cfg(unix)]
    if let Ok((running, path)) = Device::new(kind).on_pty(None) {
        let port = serialport::new(path, BAUD).timeout(READ_TIMEOUT).open()?;
        let mut line = Line::serial(port)?;
        line.device = Some(Box::new(running));
        return Ok(line);
    }
    let (running, address) = Device::new(kind).on_tcp("127.0.0.1:0")?;
    let mut line = Line::tcp(std::net::TcpStream::connect(address)?)?;
    line.device = Some(Box::new(running));
    Ok(line)
}

/// Forwards received bytes until the stream ends.
fn forward(mut reader: impl Read, inputs: &Sender<Input>, stop: &AtomicBool) {
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
        forward(line.reader, inputs, stop);
        let _ = inputs.send(Input::Line(None));
    }
}
