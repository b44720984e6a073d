//! Messages to a thread that waits in `poll`.

use std::io::{self, Read, Write};
use std::os::fd::{AsFd, BorrowedFd};
use std::os::unix::net::UnixStream;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, Sender, channel};

/// The sending end.
#[derive(Debug)]
pub(super) struct Link<M> {
    messages: Sender<M>,
    bell: Arc<UnixStream>,
}

impl<M> Clone for Link<M> {
    fn clone(&self) -> Self {
        Self {
            messages: self.messages.clone(),
            bell: Arc::clone(&self.bell),
        }
    }
}

impl<M> Link<M> {
    /// A new link, and its receiving end.
    pub(super) fn new() -> io::Result<(Self, Inbox<M>)> {
        let (sender, messages) = channel();
        let (bell, ringer) = UnixStream::pair()?;
        bell.set_nonblocking(true)?;
        ringer.set_nonblocking(true)?;
        let link = Self {
            messages: sender,
            bell: Arc::new(ringer),
        };
        Ok((link, Inbox { messages, bell }))
    }

    /// Sends a message, which comes back when the thread is gone.
    pub(super) fn try_send(&self, message: M) -> Option<M> {
        let unsent = self.messages.send(message).err();
        // A bell that takes no more rings already.
        let _ = (&*self.bell).write(&[0]);
        unsent.map(|unsent| unsent.0)
    }

    pub(super) fn send(&self, message: M) {
        drop(self.try_send(message));
    }

    /// A stream that wakes the thread when something is written to it.
    pub(super) fn ringer(&self) -> io::Result<UnixStream> {
        self.bell.try_clone()
    }
}

/// The receiving end.
#[derive(Debug)]
pub(super) struct Inbox<M> {
    messages: Receiver<M>,
    bell: UnixStream,
}

impl<M> Inbox<M> {
    /// Forgets that it was woken; to be called before the messages are taken.
    pub(super) fn silence(&self) {
        let mut rings = [0; 256];
        while matches!((&self.bell).read(&mut rings), Ok(count) if count == rings.len()) {}
    }

    /// The next message, if there is one.
    pub(super) fn next(&self) -> Option<M> {
        self.messages.try_recv().ok()
    }
}

impl<M> AsFd for Inbox<M> {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.bell.as_fd()
    }
}
