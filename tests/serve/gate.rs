//! A gate at which tasks wait until the test opens it.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Condvar, Mutex};

#[derive(Default)]
struct State {
    open: Mutex<bool>,
    opened: Condvar,
    waiting: AtomicUsize,
}

#[derive(Clone, Default)]
pub struct Gate(Arc<State>);

impl Gate {
    pub fn open(&self) {
        *self.0.open.lock().unwrap() = true;
        self.0.opened.notify_all();
    }

    pub fn wait(&self) {
        self.0.waiting.fetch_add(1, Ordering::SeqCst);
        let open = self.0.open.lock().unwrap();
        drop(self.0.opened.wait_while(open, |open| !*open));
    }

    /// How many tasks have come to the gate.
    pub fn waiting(&self) -> usize {
        self.0.waiting.load(Ordering::SeqCst)
    }
}
