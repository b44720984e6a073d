//! The live view of a run: a thread draws the screen and reads the keys.
//!
//! The run never waits for the terminal. It passes its events to [`LiveView::handle`] and takes the keys from
//! [`LiveView::pressed`].

mod choose;
mod draw;
mod key_decoder;
mod keys;
mod message;
mod rows;
mod screen;
mod text;

use std::io;
use std::sync::mpsc::{self, Receiver};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::Instant;

use ztl_script::event::StampedEvent;

use self::screen::{Screen, Shared, lock};
use self::text::Capabilities;
use crate::key_press::KeyPress;
use crate::terminal::{self, drawn_line};
use crate::terminal_mode::{self, Mode};

/// The live view. It has the terminal until it is dropped.
#[derive(Debug)]
pub(crate) struct LiveView {
    shared: Arc<Mutex<Shared>>,
    pressed: Receiver<KeyPress>,
    thread: Option<JoinHandle<()>>,
}

impl LiveView {
    /// Takes the terminal. The thread calls `wake` after each key. `attended`: the run asks the operator.
    ///
    /// # Errors
    /// If the terminal cannot be taken; it is unchanged then.
    pub(crate) fn open(wake: impl Fn() + Send + 'static, attended: bool) -> io::Result<Self> {
        terminal_mode::take(Mode::Screen)?;
        let shared = Arc::new(Mutex::new(Shared {
            board: Arc::default(),
            received: Instant::now(),
            changed: true,
            over: false,
        }));
        let (sender, pressed) = mpsc::channel();
        let screen = Screen::new(
            Arc::clone(&shared),
            sender,
            wake,
            Capabilities::of_terminal(),
            attended,
        );
        let thread = std::thread::Builder::new()
            .name("ztl-live".to_owned())
            .spawn(move || screen.run());
        let thread = thread.inspect_err(|_| terminal_mode::restore())?;
        Ok(Self {
            shared,
            pressed,
            thread: Some(thread),
        })
    }

    /// Shows an event.
    pub(crate) fn handle(&self, event: &StampedEvent) {
        let mut shared = lock(&self.shared);
        Arc::make_mut(&mut shared.board).handle(event);
        shared.received = Instant::now();
        shared.changed = true;
    }

    /// The next key press, if there is one.
    pub(crate) fn pressed(&self) -> Option<KeyPress> {
        self.pressed.try_recv().ok()
    }

    /// Restores the terminal and prints a summary of the run.
    pub(crate) fn close(mut self) {
        self.end();
        let (width, _) = terminal::size();
        let board = Arc::clone(&lock(&self.shared).board);
        for line in draw::summary(&board, width) {
            drawn_line(&line.encoded(Capabilities::of_terminal()));
        }
    }

    fn end(&mut self) {
        lock(&self.shared).over = true;
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
        terminal_mode::restore();
    }
}

impl Drop for LiveView {
    fn drop(&mut self) {
        self.end();
    }
}
