//! The service manager's end of the notification socket.

use std::os::unix::net::{SocketAddr, UnixDatagram};
use std::path::Path;
use std::process::Command;
use std::time::Instant;

use super::{PATIENCE, Process, Scratch, built};

/// Stands in for systemd and receives a service's notifications.
#[derive(Debug)]
pub struct ServiceManager {
    socket: UnixDatagram,
    messages: Vec<String>,
}

impl ServiceManager {
    /// Binds the notification socket.
    #[track_caller]
    pub fn at(address: &SocketAddr) -> Self {
        let socket = UnixDatagram::bind_addr(address).expect("a socket");
        socket.set_read_timeout(Some(PATIENCE)).expect("a limit");
        Self {
            socket,
            messages: Vec::new(),
        }
    }

    /// Waits until `times` messages have a line that starts with `begin`, and returns the last of them.
    #[track_caller]
    pub fn wait_for(&mut self, begin: &str, times: usize) -> String {
        let mut buffer = [0xA5; 4096];
        let start = Instant::now();
        loop {
            let matches = |message: &&String| message.lines().any(|line| line.starts_with(begin));
            let mut found = self.messages.iter().filter(matches);
            if let Some(message) = found.nth(times - 1) {
                return message.clone();
            }
            assert!(
                start.elapsed() < PATIENCE,
                "no '{begin}' in {:?}",
                self.messages
            );
            let count = self.socket.recv(&mut buffer).expect("a message");
            let message = String::from_utf8_lossy(&buffer[..count]).into_owned();
            self.messages.push(message);
        }
    }

    /// All messages so far.
    pub fn messages(&self) -> &[String] {
        &self.messages
    }
}

/// Has systemd verify a unit of the examples as if `ztl` were installed.
///
/// # Panics
/// When something is wrong with it.
#[track_caller]
pub fn verify_unit(unit: &Path) {
    let scratch = Scratch::new();
    let name = unit.file_name().expect("its name");
    let text = std::fs::read_to_string(unit).expect("the unit");
    let installed = "/usr/local/bin/ztl";
    assert!(text.contains(installed), "{text}");
    // How it ends when systemd stops it.
    assert!(text.contains("\nSuccessExitStatus=143\n"), "{text}");
    // The tests use the built program instead.
    let text = text.replace(installed, &built("ztl").display().to_string());
    let path = scratch.path(name);
    std::fs::write(&path, text).expect("to write");
    let ended = Process::run(Command::new("systemd-analyze").arg("verify").arg(path));
    // It may find something in the units of this machine, too.
    let name = name.to_string_lossy();
    let ours = ended.stderr.lines().any(|line| line.contains(&*name));
    assert!(!ours && ended.code == Some(0), "{ended:?}");
}
