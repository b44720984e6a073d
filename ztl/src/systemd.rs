//! Notifies systemd: `sd_notify(3)` over a datagram socket.

use std::sync::mpsc::{RecvTimeoutError, Sender, channel};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use ztl_std::gateway::DeviceReports;
use ztl_std::server::ServerHandle;

use crate::signals;
use crate::terminal::{flat, line};

/// How often to check for a new status.
const LOOK: Duration = Duration::from_secs(1);

/// Notifies the service manager until this is dropped. Does nothing without one.
pub(crate) struct Service {
    manager: Manager,
    /// Dropping it ends the thread that notifies.
    _attending: Sender<()>,
}

impl Service {
    /// Notifies that the server is ready, then of each new status, and that the server's thread is alive.
    pub(crate) fn ready(
        server: ServerHandle,
        tell: impl Fn() -> String + Send + 'static,
    ) -> std::io::Result<Self> {
        let manager = Manager::from_environment();
        let (attending, ended) = channel();
        if !manager.is_there() {
            return Ok(Self {
                manager,
                _attending: attending,
            });
        }
        // The status must be one line.
        let now = move || flat(&tell()).into_owned();
        let mut status = now();
        manager.tell(&format!("READY=1\nSTATUS={status}"));
        let teller = manager.clone();
        let watchdog = watchdog();
        // Half of the limit, as systemd advises.
        let pause = watchdog.map_or(LOOK, |limit| (limit / 2).min(LOOK));
        std::thread::Builder::new()
            .name("ztl-service".to_owned())
            .spawn(move || {
                let mut told = Instant::now();
                while ended.recv_timeout(pause) == Err(RecvTimeoutError::Timeout) {
                    let new = now();
                    if new != status {
                        status = new;
                        teller.tell(&format!("STATUS={status}"));
                    }
                    let due = watchdog.is_some_and(|limit| told.elapsed() + pause >= limit / 2);
                    if due && server.responds_within(pause) {
                        told = Instant::now();
                        teller.tell("WATCHDOG=1");
                    }
                }
            })?;
        Ok(Self {
            manager,
            _attending: attending,
        })
    }

    /// Calls `stop` at a signal, and notifies that.
    pub(crate) fn stops(self, stop: impl Fn() + Send + 'static) {
        let service = Mutex::new(Some(self));
        signals::then(move || {
            let mut service = service.lock().unwrap_or_else(PoisonError::into_inner);
            if let Some(service) = service.take() {
                service.manager.tell("STOPPING=1\nSTATUS=Stopping.");
            }
            line("Stopping; another Ctrl-C or SIGTERM exits at once.");
            stop();
        });
    }
}

/// The status of a gateway: one line for all devices.
pub(crate) fn of_devices(devices: &DeviceReports) -> String {
    let ready = devices.values().filter(|device| device.ready).count();
    let mut text = format!("{ready} of {} devices ready", devices.len());
    for (name, device) in devices.iter().filter(|(_, device)| !device.ready) {
        let problem = device.problem.as_deref().unwrap_or("not ready yet");
        text.push_str(&format!("; {name}: {problem}"));
    }
    text
}

/// After how long without a notification systemd restarts this process.
fn watchdog() -> Option<Duration> {
    let variable = |name| std::env::var(name).ok();
    let limit: u64 = variable("WATCHDOG_USEC")?.parse().ok()?;
    let pid = variable("WATCHDOG_PID").and_then(|pid| pid.parse().ok());
    let meant = pid.is_none_or(|pid: u32| pid == std::process::id());
    (meant && limit > 0).then(|| Duration::from_micros(limit))
}

#[cfg(unix)]
#[derive(Clone)]
struct Manager(
    Option<
        std::sync::Arc<(
            std::os::unix::net::UnixDatagram,
            std::os::unix::net::SocketAddr,
        )>,
    >,
);

#[cfg(unix)]
impl Manager {
    fn from_environment() -> Self {
        use std::os::unix::net::{SocketAddr, UnixDatagram};

        let address = std::env::var_os("NOTIFY_SOCKET").and_then(|name| {
            match name.as_encoded_bytes().split_first() {
                Some((b'@', name)) => in_abstract_namespace(name),
                Some((b'/', _)) => SocketAddr::from_pathname(&name).ok(),
                _ => None,
            }
        });
        let found = address.and_then(|address| Some((UnixDatagram::unbound().ok()?, address)));
        Self(found.map(std::sync::Arc::new))
    }

    fn is_there(&self) -> bool {
        self.0.is_some()
    }

    fn tell(&self, state: &str) {
        if let Some((socket, address)) = self.0.as_deref() {
            // Serve even if the manager does not listen.
            let _ = socket.send_to_addr(state.as_bytes(), address);
        }
    }
}

#[cfg(target_os = "linux")]
fn in_abstract_namespace(name: &[u8]) -> Option<std::os::unix::net::SocketAddr> {
    use std::os::linux::net::SocketAddrExt;

    std::os::unix::net::SocketAddr::from_abstract_name(name).ok()
}

#[cfg(all(unix, not(target_os = "linux")))]
fn in_abstract_namespace(_name: &[u8]) -> Option<std::os::unix::net::SocketAddr> {
    None
}

/// This system has no systemd.
#[cfg(not(unix))]
#[derive(Clone)]
struct Manager;

#[cfg(not(unix))]
impl Manager {
    fn from_environment() -> Self {
        Self
    }

    fn is_there(&self) -> bool {
        false
    }

    fn tell(&self, _state: &str) {}
}
