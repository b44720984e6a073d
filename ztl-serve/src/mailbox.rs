//! Messages to a thread that waits in `poll`.

use std::fmt;
use std::io::{self, Read, Write};
use std::os::fd::{AsFd, BorrowedFd};
use std::os::unix::net::UnixStream;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, Sender, channel};

/// The sending end.
pub(crate) struct Mailbox<M> {
    messages: Sender<M>,
    wake: Arc<UnixStream>,
}

impl<M> Clone for Mailbox<M> {
    fn clone(&self) -> Self {
        Self {
            messages: self.messages.clone(),
            wake: Arc::clone(&self.wake),
        }
    }
}

impl<M> fmt::Debug for Mailbox<M> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Mailbox")
    }
}

impl<M> Mailbox<M> {
    /// A new mailbox with its receiving end.
    pub(crate) fn new() -> io::Result<(Self, Inbox<M>)> {
        let (sender, messages) = channel();
        let (woken, wake) = UnixStream::pair()?;
        woken.set_nonblocking(true)?;
        wake.set_nonblocking(true)?;
        let mailbox = Self {
            messages: sender,
            wake: Arc::new(wake),
        };
        Ok((mailbox, Inbox { messages, woken }))
    }

    /// Sends a message. It is dropped if the receiving end is gone.
    pub(crate) fn send(&self, message: M) {
        drop(self.messages.send(message));
        self.wake();
    }

    /// Wakes the thread without a message.
    pub(crate) fn wake(&self) {
        // A full socket wakes the thread too.
        let _ = (&*self.wake).write(&[0]);
    }

    /// A stream that wakes the thread when something is written to it.
    pub(crate) fn waker(&self) -> io::Result<UnixStream> {
        self.wake.try_clone()
    }
}

/// The receiving end.
#[derive(Debug)]
pub(crate) struct Inbox<M> {
    messages: Receiver<M>,
    woken: UnixStream,
}

impl<M> Inbox<M> {
    /// Clears the wake-up. Call this before [`next`](Self::next), or a message may be missed.
    pub(crate) fn clear(&self) {
        let mut bytes = [0; 256];
        while matches!((&self.woken).read(&mut bytes), Ok(count) if count == bytes.len()) {}
    }

    /// The next message, if there is one.
    pub(crate) fn next(&self) -> Option<M> {
        self.messages.try_recv().ok()
    }
}

impl<M> AsFd for Inbox<M> {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.woken.as_fd()
    }
}
