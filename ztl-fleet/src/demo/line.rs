//! A line to the router that can be cut.

use std::io;
use std::net::{Shutdown, TcpListener, TcpStream};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// Passes bytes on between whoever connects and the router.
pub(super) struct Line(Arc<Mutex<State>>);

struct State {
    is_cut: bool,
    streams: Vec<TcpStream>,
}

impl Line {
    /// A line to the router at a Zenoh address, and the address of its other end.
    pub(super) fn open(router: &str) -> io::Result<(Self, String)> {
        let router = router.trim_start_matches("tcp/").to_owned();
        let listener = TcpListener::bind("127.0.0.1:0")?;
        let address = format!("tcp/{}", listener.local_addr()?);
        let state = Arc::new(Mutex::new(State {
            is_cut: false,
            streams: Vec::new(),
        }));
        let shared = Arc::clone(&state);
        let thread = std::thread::Builder::new().name("ztl-fleet-line".to_owned());
        thread.spawn(move || {
            for near in listener.incoming().flatten() {
                // Who cannot be passed on is closed, and tries again.
                let _ = pass(&shared, near, &router);
            }
        })?;
        Ok((Self(state), address))
    }

    /// Ends all connections, and lets none through.
    pub(super) fn cut(&self) {
        let mut state = lock(&self.0);
        state.is_cut = true;
        for stream in state.streams.drain(..) {
            // One that has ended is as good.
            let _ = stream.shutdown(Shutdown::Both);
        }
    }

    /// Lets connections through again.
    pub(super) fn join(&self) {
        lock(&self.0).is_cut = false;
    }
}

fn lock(state: &Mutex<State>) -> MutexGuard<'_, State> {
    state.lock().unwrap_or_else(PoisonError::into_inner)
}

fn pass(state: &Mutex<State>, near: TcpStream, router: &str) -> io::Result<()> {
    let mut state = lock(state);
    if state.is_cut {
        return Ok(());
    }
    let far = TcpStream::connect(router)?;
    for (from, to) in [(&near, &far), (&far, &near)] {
        let (mut from, mut to) = (from.try_clone()?, to.try_clone()?);
        let thread = std::thread::Builder::new().name("ztl-fleet-pass".to_owned());
        thread.spawn(move || {
            // An end of one side is passed on to the other.
            let _ = io::copy(&mut from, &mut to);
            let _ = to.shutdown(Shutdown::Both);
        })?;
    }
    state.streams.extend([near, far]);
    Ok(())
}
