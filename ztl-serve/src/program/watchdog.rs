//! The watchdog: a second process, which stops all programs when the server is killed or crashes.
//!
//! A program starts only after the watchdog has confirmed that it knows of it. The watchdog acts when the server's
//! end of its socket closes, which the kernel does however the server ends.

mod keeper;
mod process;
pub(crate) mod protocol;

use std::io;
use std::process::{Command, Stdio};
use std::sync::mpsc::channel;
use std::sync::{Mutex, PoisonError};
use std::thread::JoinHandle;

use crate::mailbox::Mailbox;
use crate::program::process_group::ProcessGroup;
use keeper::{Keeper, Order, STARTING};
use protocol::{Charge, READY};

pub use process::watchdog;

/// A handle of the thread that keeps a watchdog running. Only [`start`](Self::start) blocks.
#[derive(Debug)]
pub(crate) struct Watchdog {
    keeper: Mailbox<Order>,
    /// The number of the last program.
    last: Mutex<u64>,
    thread: Option<JoinHandle<()>>,
}

impl Watchdog {
    /// Starts a watchdog by this command, which must call [`watchdog`], and restarts it when it ends. Waits
    /// until the first one is ready, at most 5 s.
    pub(crate) fn start(mut command: Command) -> io::Result<Self> {
        use std::os::unix::process::CommandExt;

        // In a group of its own, so that Ctrl-C in a terminal does not reach it.
        command.stdout(Stdio::null()).process_group(0);
        let (mailbox, orders) = Mailbox::new()?;
        let (first, is_ready) = channel();
        let keeper = Keeper::new(orders, command, first);
        let thread = std::thread::Builder::new()
            .name("ztl-watchdog".to_owned())
            .spawn(move || keeper.run())?;
        // Returns when the other end is dropped.
        let _ = is_ready.recv_timeout(STARTING);
        Ok(Self {
            keeper: mailbox,
            last: Mutex::new(READY),
            thread: Some(thread),
        })
    }

    /// Announces to the watchdog that a program is about to start. Calls `confirmed` on another thread once the watchdog
    /// knows of it, unless that is [over](Self::over) before. Returns the number of the program.
    pub(crate) fn announce(
        &self,
        charge: Charge,
        confirmed: impl FnOnce() + Send + 'static,
    ) -> u64 {
        let mut last = self.last.lock().unwrap_or_else(PoisonError::into_inner);
        *last += 1;
        let number = *last;
        drop(last);
        self.keeper
            .send(Order::Announce(number, charge, Box::new(confirmed)));
        number
    }

    /// An announced program has started and leads this group.
    pub(crate) fn runs(&self, number: u64, leader: i32) {
        self.keeper
            .send(Order::Runs(number, ProcessGroup::of(leader)));
    }

    /// A program has ended, or has not started.
    pub(crate) fn over(&self, number: u64) {
        self.keeper.send(Order::Over(number));
    }
}

impl Drop for Watchdog {
    fn drop(&mut self) {
        self.keeper.send(Order::Close);
        if let Some(thread) = self.thread.take() {
            // A panic there has been printed already.
            let _ = thread.join();
        }
    }
}
