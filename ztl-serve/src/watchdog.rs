//! The watchdog: a second process, which stops the programs when the server is gone without having done so.
//!
//! A program starts only after the watchdog has confirmed that it knows of it. The watchdog does nothing else
//! until the server's end of its socket closes. The kernel closes it, however the server ended.

mod keeper;
mod process;

use std::io;
use std::process::{Command, Stdio};
use std::sync::mpsc::channel;
use std::sync::{Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use serde::{Deserialize, Serialize};
use ztl_core::TaskId;

use super::group::Group;
use super::link::Link;
use super::program::{AbortBy, Launch, Program};
use super::template::Call;
use keeper::{Keeper, Order, STARTING};

pub use process::watchdog;

/// A program that somebody has to look after.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct Charge {
    /// `ZTL_ID` in its environment, by which it is found while its group is not known.
    task: u32,
    group: Option<Group>,
    end: Ending,
    grace: Duration,
}

/// How it is asked to end.
#[derive(Debug, Clone, Serialize, Deserialize)]
enum Ending {
    /// By a signal, as `TERM`.
    Signal(String),
    /// By another program.
    Run(Box<Launch>),
    /// Not at all: it ends another one.
    Wait,
}

impl Charge {
    /// A task's program.
    pub(super) fn of(program: &Program, call: &Call) -> Self {
        let end = match &program.abort.by {
            AbortBy::Signal(name, _) => Ending::Signal((*name).to_owned()),
            AbortBy::Program(run) => match run.launch(call) {
                Ok(launch) => Ending::Run(Box::new(launch)),
                // The server has no other way either.
                Err(_) => Ending::Signal("TERM".to_owned()),
            },
        };
        Self::new(call.id.get(), end, program.abort.grace)
    }

    /// A program that aborts a task's.
    pub(super) fn of_helper(task: TaskId, grace: Duration) -> Self {
        Self::new(task.get(), Ending::Wait, grace)
    }

    fn new(task: u32, end: Ending, grace: Duration) -> Self {
        Self {
            task,
            group: None,
            end,
            grace,
        }
    }
}

/// What the watchdog is told, one line of JSON each. It answers each `Begins` with its number in a line of its
/// own, and says [`READY`] before.
#[derive(Debug, Serialize, Deserialize)]
enum Message {
    /// A program may be started from now on.
    Begins(u64, Charge),
    /// It has been.
    Runs(u64, Group),
    /// Nobody needs to look after it any more.
    Over(u64),
}

/// The watchdog's first line: it heeds no signal any more, and listens.
const READY: u64 = 0;

/// The way to the thread that keeps a watchdog running. Nothing here blocks.
#[derive(Debug)]
pub(super) struct Watchdog {
    link: Link<Order>,
    /// The number of the last program.
    last: Mutex<u64>,
    thread: Option<JoinHandle<()>>,
}

impl Watchdog {
    /// Has a watchdog started by this command, which must call [`watchdog`], and restarted when it ends. Waits
    /// until the first one is ready, but not for long.
    ///
    /// # Errors
    /// When the system gives no more threads or files.
    pub(super) fn start(mut command: Command) -> io::Result<Self> {
        use std::os::unix::process::CommandExt;

        // In a group of its own: Ctrl-C in a terminal is for the server.
        command.stdout(Stdio::null()).process_group(0);
        let (link, orders) = Link::new()?;
        let (first, is_ready) = channel();
        let keeper = Keeper::new(orders, command, first);
        let thread = std::thread::Builder::new()
            .name("ztl-watchdog".to_owned())
            .spawn(move || keeper.run())?;
        // Nothing is sent: the other end is dropped.
        let _ = is_ready.recv_timeout(STARTING);
        Ok(Self {
            link,
            last: Mutex::new(READY),
            thread: Some(thread),
        })
    }

    /// Tells the watchdog that a program is about to be started. `confirmed` is called, on another thread, once
    /// the watchdog knows of it; never if that is [over](Self::over) before. Returns its number.
    pub(super) fn announce(
        &self,
        charge: Charge,
        confirmed: impl FnOnce() + Send + 'static,
    ) -> u64 {
        let mut last = self.last.lock().unwrap_or_else(PoisonError::into_inner);
        *last += 1;
        let number = *last;
        drop(last);
        self.link
            .send(Order::Announce(number, charge, Box::new(confirmed)));
        number
    }

    /// An announced program has been started; it leads this group.
    pub(super) fn runs(&self, number: u64, leader: i32) {
        self.link.send(Order::Runs(number, Group::of(leader)));
    }

    /// A program has ended, or is not started after all.
    pub(super) fn over(&self, number: u64) {
        self.link.send(Order::Over(number));
    }
}

impl Drop for Watchdog {
    fn drop(&mut self) {
        self.link.send(Order::Close);
        if let Some(thread) = self.thread.take() {
            // A panic there has been printed already.
            let _ = thread.join();
        }
    }
}
