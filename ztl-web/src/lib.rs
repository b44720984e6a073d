//! The web console: what all robots do, and a Stop for all of them, in a browser and for any rosbridge client.
//!
//! [`serve`] watches each server, and sends it ABORTs, on a thread of its own (`server_thread`), starts goals on threads
//! (`goals`), and tells every socket (`socket`) what changed on the `board`. The page in `assets/` is one
//! rosbridge client among others.

mod aborts;
mod board;
mod clients;
mod clock;
mod cut;
mod gate;
mod goal;
mod goals;
mod http;
mod places;
mod robots;
mod rosbridge;
mod server_thread;
mod socket;
mod stop;

use std::io;
use std::net::TcpListener;
use std::sync::Arc;

pub use gate::Tokens;
pub use robots::{Connect, Robot};

/// What [`serve`] needs.
pub struct Options {
    /// Where browsers connect.
    pub listener: TcpListener,
    /// The robots, as the configuration names them.
    pub robots: Vec<Robot>,
    /// What browsers must show; without it whoever reaches the listener is an operator.
    pub tokens: Option<Tokens>,
    /// Names under which browsers reach this machine, besides `localhost` and IP addresses.
    pub hosts: Vec<String>,
}

/// Serves the console until the process ends.
///
/// # Errors
/// If the system has no more threads or files.
pub fn serve(options: Options) -> io::Result<()> {
    let Options {
        listener,
        robots,
        tokens,
        hosts,
    } = options;
    let (console, woken) = board::Board::new(robots::group(robots));
    let console = Arc::new(console);
    for (server, woken) in woken.into_iter().enumerate() {
        server_thread::spawn(&console, server, woken)?;
    }
    listener.set_nonblocking(true)?;
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()?;
    let gate = gate::Gate::new(tokens, hosts);
    runtime.block_on(http::accept(listener, console, gate))
}
