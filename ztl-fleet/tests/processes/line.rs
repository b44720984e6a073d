//! A TCP connection to a router that can be cut, silenced and delayed.

use std::io::{Read as _, Write as _};
use std::net::{Shutdown, TcpListener, TcpStream};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Condvar, Mutex};
use std::time::Duration;

/// What becomes of bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Mode {
    /// They are passed on.
    Open,
    /// They are passed on so much later.
    Slow(Duration),
    /// They wait, and neither side is told.
    Silent,
    /// There is no connection.
    Cut,
}

/// Passes bytes on between whoever connects and a router.
pub(crate) struct Line {
    state: Arc<State>,
    /// Where to connect: an address of Zenoh.
    pub(crate) address: String,
}

/// What has passed.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Passed {
    pub(crate) bytes: u64,
    /// How often bytes came together.
    pub(crate) chunks: u64,
}

struct State {
    bytes: AtomicUsize,
    chunks: AtomicUsize,
    mode: Mutex<Mode>,
    changed: Condvar,
    streams: Mutex<Vec<TcpStream>>,
}

impl Line {
    /// A line to the router at a Zenoh address.
    pub(crate) fn to(router: &str) -> Self {
        let router = router.trim_start_matches("tcp/").to_owned();
        let listener = TcpListener::bind("127.0.0.1:0").expect("a port");
        let address = format!("tcp/{}", listener.local_addr().expect("its address"));
        let state = Arc::new(State {
            bytes: AtomicUsize::new(0),
            chunks: AtomicUsize::new(0),
            mode: Mutex::new(Mode::Open),
            changed: Condvar::new(),
            streams: Mutex::default(),
        });
        let shared = Arc::clone(&state);
        std::thread::spawn(move || {
            for near in listener.incoming().flatten() {
                // Who cannot be passed on is closed, and tries again.
                let _ = connect(&shared, near, &router);
            }
        });
        Self { state, address }
    }

    /// What has passed so far, in both directions.
    pub(crate) fn passed(&self) -> Passed {
        Passed {
            bytes: self.state.bytes.load(Ordering::Relaxed) as u64,
            chunks: self.state.chunks.load(Ordering::Relaxed) as u64,
        }
    }

    /// Changes what becomes of bytes, also of those under way.
    pub(crate) fn set(&self, mode: Mode) {
        *self.state.mode.lock().unwrap() = mode;
        self.state.changed.notify_all();
        if mode == Mode::Cut {
            for stream in self.state.streams.lock().unwrap().drain(..) {
                // One that has ended is as good.
                let _ = stream.shutdown(Shutdown::Both);
            }
        }
    }
}

impl State {
    /// Waits while bytes may not pass; returns whether they may now.
    fn wait(&self) -> bool {
        let mode = self.mode.lock().unwrap();
        let mode = self
            .changed
            .wait_while(mode, |mode| *mode == Mode::Silent)
            .unwrap();
        if let Mode::Slow(delay) = *mode {
            drop(mode);
            // The time is the fault.
            std::thread::sleep(delay);
            return true;
        }
        *mode != Mode::Cut
    }
}

fn connect(state: &Arc<State>, near: TcpStream, router: &str) -> std::io::Result<()> {
    let mut streams = state.streams.lock().unwrap();
    if *state.mode.lock().unwrap() == Mode::Cut {
        return Ok(());
    }
    let far = TcpStream::connect(router)?;
    for (from, to) in [(&near, &far), (&far, &near)] {
        from.set_nodelay(true)?;
        let (from, to, state) = (from.try_clone()?, to.try_clone()?, Arc::clone(state));
        std::thread::spawn(move || {
            pass(&state, &from, &to);
            for stream in [&from, &to] {
                let _ = stream.shutdown(Shutdown::Both);
            }
        });
    }
    streams.retain(|stream| stream.peer_addr().is_ok());
    streams.extend([near, far]);
    Ok(())
}

/// Passes on until one side ends.
fn pass(state: &State, mut from: &TcpStream, mut to: &TcpStream) {
    let mut buffer = [0; 1 << 16];
    while let Ok(count @ 1..) = from.read(&mut buffer) {
        if !state.wait() || to.write_all(&buffer[..count]).is_err() {
            return;
        }
        state.bytes.fetch_add(count, Ordering::Relaxed);
        state.chunks.fetch_add(1, Ordering::Relaxed);
    }
}
