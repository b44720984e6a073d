//! Pseudo terminals: virtual serial ports.

use std::io;
use std::path::PathBuf;

use serialport::{SerialPort, TTYPort};

use ztl_std::gateway::{Line, READ_TIMEOUT};

/// A pty. This process uses one end; others open the other end as a serial port.
pub(crate) struct Pty {
    master: TTYPort,
    /// Held open, so that our end does not hang up while nobody else has it open.
    _slave: TTYPort,
    path: String,
}

impl Pty {
    pub(crate) fn new() -> io::Result<Self> {
        let (mut master, slave) = TTYPort::pair()?;
        master.set_timeout(READ_TIMEOUT)?;
        let path = slave
            .name()
            .ok_or_else(|| io::Error::new(io::ErrorKind::Unsupported, "the pty has no name"))?;
        Ok(Self {
            master,
            _slave: slave,
            path,
        })
    }

    /// The path by which others open it.
    pub(crate) fn path(&self) -> &str {
        &self.path
    }

    /// This process's end.
    pub(crate) fn line(&self) -> io::Result<Line> {
        Ok(Line::new(
            self.master.try_clone_native()?,
            self.master.try_clone_native()?,
        ))
    }
}

/// A link to a pty, removed on drop.
#[derive(Debug)]
pub(crate) struct Link(PathBuf);

impl Link {
    /// Creates the link. Replaces a stale link, but never another kind of file.
    pub(crate) fn new(link: PathBuf, to: &str) -> io::Result<Self> {
        if link.is_symlink() {
            let _ = std::fs::remove_file(&link);
        }
        std::os::unix::fs::symlink(to, &link).map_err(|error| {
            let text = format!("cannot make the link {}: {error}", link.display());
            io::Error::new(error.kind(), text)
        })?;
        Ok(Self(link))
    }
}

impl Drop for Link {
    fn drop(&mut self) {
        let _ = std::fs::remove_file(&self.0);
    }
}
