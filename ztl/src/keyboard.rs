//! Single keys from the terminal, read by a thread.

use std::io;
use std::sync::mpsc::{self, Receiver};
use std::time::Instant;

use crate::signals;
#[cfg(unix)]
use crate::terminal_mode as mode;

/// The bytes of one read: one key, however many bytes it has.
#[derive(Debug, Clone)]
pub(crate) struct KeyBytes {
    /// At least one byte.
    pub(crate) bytes: Vec<u8>,
    /// When they were read.
    pub(crate) at: Instant,
}

/// Takes the terminal for single keys, until it is dropped.
#[derive(Debug)]
pub(crate) struct Keyboard {
    keys: Receiver<KeyBytes>,
}

impl Keyboard {
    /// Takes the terminal. A thread calls `wake` after each key. If the terminal vanishes, the thread acts as
    /// SIGHUP does.
    ///
    /// # Errors
    /// If stdin is not a terminal.
    pub(crate) fn open(wake: impl Fn() + Send + 'static) -> io::Result<Self> {
        mode::take(mode::Mode::Keys)?;
        let (sender, keys) = mpsc::channel();
        let keyboard = Self { keys };
        std::thread::Builder::new()
            .name("ztl-keys".to_owned())
            .spawn(move || {
                let mut bytes = [0; 64];
                while let Ok(len @ 1..) = mode::read(&mut bytes) {
                    let bytes = bytes.get(..len).unwrap_or_default().to_vec();
                    let key = KeyBytes {
                        bytes,
                        at: Instant::now(),
                    };
                    if sender.send(key).is_err() {
                        return;
                    }
                    wake();
                }
                if !mode::is_restored() {
                    signals::hang_up(true);
                }
            })?;
        Ok(keyboard)
    }

    /// The next key, if one was pressed.
    pub(crate) fn next(&self) -> Option<KeyBytes> {
        self.keys.try_recv().ok()
    }

    /// Drops keys pressed until now, so that they do not answer the next question.
    pub(crate) fn clear(&self) {
        drop_input();
        while self.keys.try_recv().is_ok() {}
    }
}

/// Drops what was typed on the terminal and is not read yet.
pub(crate) fn drop_input() {
    mode::drop_input();
}

impl Drop for Keyboard {
    fn drop(&mut self) {
        mode::restore();
    }
}

#[cfg(not(unix))]
mod mode {
    use std::io;

    pub(super) enum Mode {
        Keys,
    }

    pub(super) fn take(_mode: Mode) -> io::Result<()> {
        Err(io::Error::new(
            io::ErrorKind::Unsupported,
            "single keys are not supported on this system; use --yes",
        ))
    }

    pub(super) fn restore() {}

    pub(super) fn is_restored() -> bool {
        true
    }

    pub(super) fn drop_input() {}

    pub(super) fn read(_bytes: &mut [u8]) -> io::Result<usize> {
        Ok(0)
    }
}
