//! Tells the log which routers are lost, and when they are there again.

use std::io;
use std::thread::{self, sleep};
use std::time::{Duration, Instant};

use tracing::{error, info, warn};
use zenoh::session::ZenohId;
use zenoh::{Session, Wait as _};

use crate::config::Links;
use crate::session;

/// Pause between two looks.
const LOOK: Duration = Duration::from_millis(500);
/// How long a router's own connection may take when another one to the same router stands.
const LATER: Duration = Duration::from_secs(10);

/// Tells, once each time, that a client's session has lost its router, and that it has one again. Ends when the session is
/// closed.
///
/// # Errors
/// The system's, if a thread cannot start.
pub fn watch(session: &Session, links: &Links) -> io::Result<()> {
    let (session, routers) = (session.clone(), links.routers.join(", "));
    let thread = thread::Builder::new().name("ztl-fleet-router".to_owned());
    thread.spawn(move || {
        let mut was_there = true;
        while !session.is_closed() {
            let is_there = session.info().routers_zid().wait().next().is_some();
            match (was_there, is_there) {
                (true, false) => {
                    warn!(target: "fleet", "No router is connected any more; trying again: {routers}.");
                }
                (false, true) => info!(target: "fleet", "A router is connected again."),
                _ => {}
            }
            was_there = is_there;
            sleep(LOOK);
        }
    })?;
    Ok(())
}

/// Tells for each router that another one connects to whether it waits for it, and when it is there.
///
/// # Errors
/// The system's, if a thread cannot start.
pub fn watch_each(session: &Session, links: &Links) -> io::Result<()> {
    for address in &links.routers {
        let session = session.clone();
        let one = Links {
            routers: vec![address.clone()],
            listen: Vec::new(),
            tls: links.tls.clone(),
            misdated: None,
        };
        let thread = thread::Builder::new().name("ztl-fleet-router".to_owned());
        thread.spawn(move || follow(&session, &one))?;
    }
    Ok(())
}

fn follow(session: &Session, one: &Links) {
    let address = one.routers.join(", ");
    loop {
        // Zenoh does not tell which address a connection was for: only a session to this address alone tells which router is
        // there. Until then, it says why none is.
        let id = match id_of_router(one) {
            Ok(Some(id)) => id,
            Ok(None) => {
                sleep(LOOK);
                continue;
            }
            Err(error) => {
                warn!(target: "fleet", "Router {address} is not watched: {error}.");
                return;
            }
        };
        if id == session.zid() {
            error!(target: "fleet", "{address} in 'routers' is this router itself; leave it out.");
            return;
        }
        let end = Instant::now() + LATER;
        while !is_connected(session, id) && Instant::now() < end {
            sleep(LOOK);
        }
        if !is_connected(session, id) {
            continue;
        }
        info!(target: "fleet", "Router {address} is connected.");
        while is_connected(session, id) {
            sleep(LOOK);
        }
        if session.is_closed() {
            return;
        }
        warn!(target: "fleet", "Router {address} is not connected any more; trying again.");
    }
}

/// The router at an address, once it is reached.
fn id_of_router(one: &Links) -> Result<Option<ZenohId>, session::ZenohError> {
    let session = session::open(one)?;
    let id = session.info().routers_zid().wait().next();
    session.close().wait()?;
    Ok(id)
}

fn is_connected(session: &Session, id: ZenohId) -> bool {
    session.info().routers_zid().wait().any(|other| other == id)
}
