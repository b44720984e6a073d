//! The web console: what all robots do, and a Stop for all of them, in a browser and for any rosbridge client.
//!
//! [`serve`] watches each server, and sends it ABORTs, on a thread of its own (`server_thread`), starts goals on threads
//! (`goals`), plays the scenes of a script (`show`), and tells every socket (`socket`)
//! what changed on the `board`. The page in `assets/` is one
//! rosbridge client among others.

mod aborts;
mod board;
mod clients;
mod clock;
mod cut;
mod devices;
mod gate;
mod goal;
mod goals;
mod http;
mod lock;
mod operator;
mod outcome;
mod own_page;
mod past;
mod picture;
mod places;
mod record;
mod robots;
mod rosbridge;
mod server_thread;
mod show;
mod socket;
mod stop;
mod streams;
mod task;
mod tls;
mod tokens;
mod topics;

use std::collections::BTreeSet;
use std::io;
use std::net::TcpListener;
use std::sync::Arc;

pub use own_page::OwnPage;
pub use robots::{Connect, Robot};
pub use show::{Record, Show, ShowRecord};
pub use streams::{ConnectPublisher, Publisher};
pub use tls::Tls;
pub use tokens::Tokens;

/// What [`serve`] needs.
pub struct Options {
    /// Where browsers connect.
    pub listener: TcpListener,
    /// The robots, as the configuration names them.
    pub robots: Vec<Robot>,
    /// Publishers whose streams the page can show.
    pub publishers: Vec<Publisher>,
    /// Topics whose bytes are sound: 16-bit samples, little-endian. The page shows their level.
    pub sounds: BTreeSet<String>,
    /// What browsers must show. Without `hosts`, a request of this machine to one of its loopback names needs none.
    pub tokens: Tokens,
    /// Names under which browsers reach this machine, besides `localhost` and IP addresses.
    pub hosts: Vec<String>,
    /// A user's page in place of the console's, which is then at `/console`.
    pub page: Option<OwnPage>,
    /// A script to play.
    pub show: Option<Show>,
    /// The certificate and key of `https`; without it, connections are not encrypted.
    pub tls: Option<Tls>,
}

/// Serves the console until the process ends.
///
/// # Errors
/// If the system has no more threads or files.
pub fn serve(options: Options) -> io::Result<()> {
    let Options {
        listener,
        robots,
        publishers,
        sounds,
        tokens,
        hosts,
        page,
        show,
        tls,
    } = options;
    let streams = streams::Streams::new(publishers, sounds);
    let (console, woken) = board::Board::new(robots::group(robots), streams);
    let console = Arc::new(console);
    for (server, woken) in woken.into_iter().enumerate() {
        server_thread::spawn(&console, server, woken)?;
    }
    let record = show.as_ref().and_then(|show| show.record.as_ref());
    let record = record.map(record::RecordFile::new);
    if let Some(show) = show {
        show::spawn(show, &console)?;
    }
    streams::spawn(&console.streams)?;
    listener.set_nonblocking(true)?;
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()?;
    let gate = gate::Gate::new(tokens, hosts, listener.local_addr()?.port());
    runtime.block_on(http::accept(listener, console, gate, (page, record), tls))
}
