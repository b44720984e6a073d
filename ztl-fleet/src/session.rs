//! Sessions of Zenoh: opened with the fleet's settings, and who is there.

use std::net::{TcpStream, ToSocketAddrs as _};
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::time::Duration;

use serde_json::{Value, json};
use tracing::warn;
use zenoh::handlers::CallbackDrop;
use zenoh::query::Reply;
use zenoh::sample::SampleKind;
use zenoh::{Config, Session, Wait as _};

use crate::config::Links;
use crate::wire::{ROOT, Verdict, from_hex, is_name};

/// What failed in Zenoh.
pub type ZenohError = Box<dyn std::error::Error + Send + Sync>;

/// After this silence a connection counts as lost.
const LEASE_MS: u32 = 3000;
/// Longest message that is taken, in bytes: Zenoh's own limit is 1 GiB, an answer of a server about 4 MiB.
const LONGEST: usize = 8 << 20;
/// How long an agent's thread waits for room on its own line before a message of a stream is dropped, in microseconds; with many
/// fragments, the second.
const WAIT_US: u32 = 50_000;
const WAIT_LONG_US: u32 = 500_000;
/// Longest pause before a connection is tried again.
const RETRY_MS: u32 = 1000;
/// How long to wait for a router before the log says so.
const UNREACHED: Duration = Duration::from_secs(3);
/// How long to look why one is not reached.
const LOOK: Duration = Duration::from_secs(1);

/// Zenoh's settings: connections to the named routers, and to nobody else.
fn settings(links: &Links, mode: &str) -> Value {
    let mut all = json!({
        "mode": mode,
        "connect": {
            "endpoints": links.routers,
            "timeout_ms": -1,
            "exit_on_failure": false,
            "retry": {
                "period_init_ms": 100,
                "period_max_ms": RETRY_MS,
                "period_increase_factor": 2,
            },
        },
        "listen": { "endpoints": links.listen },
        "scouting": { "multicast": { "enabled": false }, "gossip": { "enabled": false } },
        "transport": { "link": {
            "tx": { "lease": LEASE_MS },
            "rx": { "max_message_size": LONGEST },
        } },
    });
    // A router would make others wait meanwhile.
    if mode == "client"
        && let Some(tx) = all.pointer_mut("/transport/link/tx")
    {
        tx["queue"] = json!({ "congestion_control": { "drop": {
            "wait_before_drop": WAIT_US,
            "max_wait_before_drop_fragments": WAIT_LONG_US,
        } } });
    }
    if let Some(tls) = &links.tls
        && let Some(link) = all.pointer_mut("/transport/link")
    {
        // Each side proves who it is.
        link["tls"] = json!({
            "root_ca_certificate": tls.ca,
            "listen_certificate": tls.certificate,
            "listen_private_key": tls.key,
            "connect_certificate": tls.certificate,
            "connect_private_key": tls.key,
            "enable_mtls": true,
        });
    }
    all
}

/// Opens the session of a router.
///
/// # Errors
/// Zenoh's, or that an address is taken.
pub fn open_router(links: &Links) -> Result<Session, ZenohError> {
    let config = Config::from_json5(&settings(links, "router").to_string())?;
    let opened = zenoh::open(config).wait();
    opened.map_err(|error| cannot_route(links, &error.to_string()).into())
}

/// Opens the session of a client, which waits until it reaches a router.
///
/// # Errors
/// Zenoh's.
pub fn open(links: &Links) -> Result<Session, ZenohError> {
    let config = client(links)?;
    let routers = links.routers.clone();
    let (opened, opens) = channel::<()>();
    let thread = std::thread::Builder::new().name("ztl-fleet-opening".to_owned());
    thread.spawn(move || {
        if opens.recv_timeout(UNREACHED) == Err(RecvTimeoutError::Timeout) {
            warn!(target: "fleet", "No router is reached yet; trying again. {}.", obstacles(&routers));
        }
    })?;
    let session = zenoh::open(config).wait();
    drop(opened);
    session
}

/// Opens the session of a client, if it reaches a router within `limit`.
///
/// # Errors
/// That it does not, or Zenoh's.
pub fn open_within(links: &Links, limit: Duration) -> Result<Session, ZenohError> {
    let mut config = client(links)?;
    config.insert_json5("connect/timeout_ms", &limit.as_millis().to_string())?;
    // Zenoh tells no reason.
    zenoh::open(config).wait().map_err(|_| {
        let (limit, why) = (limit.as_secs(), obstacles(&links.routers));
        format!("no router is reached within {limit} s, so no robot was asked: {why}").into()
    })
}

fn client(links: &Links) -> Result<Config, ZenohError> {
    if links.routers.is_empty() {
        return Err("the file names no router; write routers: [tcp/10.0.0.1:7447]".into());
    }
    Config::from_json5(&settings(links, "client").to_string())
}

/// Why each of these routers may not be reached, and what helps.
fn obstacles(routers: &[String]) -> String {
    let of = |address: &String| {
        let place = address.split_once('/').map_or("", |(_, place)| place);
        let connected = place.to_socket_addrs().and_then(|mut all| {
            let at = all.next().ok_or(std::io::ErrorKind::NotFound)?;
            TcpStream::connect_timeout(&at, LOOK)
        });
        match connected {
            Ok(_) => format!(
                "{address}: something listens there, but it is not a router, or one of the two does not accept the other; compare 'tls', and the address's name and protocol, at both ends"
            ),
            Err(error) => {
                format!("{address}: {error}; start a router there, or correct 'routers'")
            }
        }
    };
    routers.iter().map(of).collect::<Vec<_>>().join("; ")
}

/// Why a router does not start, by what Zenoh says, which includes places in its source.
fn cannot_route(links: &Links, said: &str) -> String {
    let mut listen = links.listen.iter();
    let taken = listen.find(|address| {
        let place = address.split_once('/').map_or("", |(_, place)| place);
        said.contains("Address already in use") && said.contains(place)
    });
    match taken {
        Some(address) => format!(
            "cannot listen at {address}: the port is in use; stop what uses it, or choose another port"
        ),
        None => said.split(" at /").next().unwrap_or(said).to_owned(),
    }
}

/// The key of something that an agent offers.
#[must_use]
pub fn key(robot: &str, agent: &str, what: &str) -> String {
    format!("{ROOT}/{robot}/{agent}/{what}")
}

/// The robot and the agent in a key; `None` if it has others than [`is_name`] and 32 hexadecimal digits there.
#[must_use]
pub fn parts(key: &str) -> Option<(&str, &str)> {
    let mut chunks = key.split('/');
    let root = chunks.next()?;
    let (robot, agent) = (chunks.next()?, chunks.next()?);
    let fits = root == ROOT && is_name(robot) && from_hex(agent).is_some();
    fits.then_some((robot, agent))
}

/// A reply as a verdict.
#[must_use]
pub fn verdict(reply: &Reply) -> Verdict {
    match reply.result() {
        Ok(sample) => Verdict::Answer(sample.payload().to_bytes().into_owned()),
        Err(error) => Verdict::of_error(&error.payload().to_bytes()),
    }
}

/// Tells an agent that another one claims its name. `on_end` is called when it has heard that, or cannot.
///
/// # Errors
/// Zenoh's, if nothing was sent.
pub fn claim(
    session: &Session,
    robot: &str,
    agent: &str,
    other: &str,
    limit: Duration,
    on_end: impl FnMut() + Send + Sync + 'static,
) -> Result<(), ZenohError> {
    let selector = format!("{}?agent={other}", key(robot, agent, "claim"));
    let handler = CallbackDrop {
        callback: |_: Reply| {},
        drop: on_end,
    };
    session.get(selector).timeout(limit).with(handler).wait()
}

/// The agents that are there: robots with their agents, in order. `robot` may be `*`.
///
/// # Errors
/// Zenoh's.
pub fn present(
    session: &Session,
    robot: &str,
    limit: Duration,
) -> Result<Vec<(String, String)>, ZenohError> {
    let replies = session
        .liveliness()
        .get(format!("{ROOT}/{robot}/*/alive"))
        .timeout(limit)
        .wait()?;
    let mut all = Vec::new();
    while let Ok(reply) = replies.recv() {
        if let Ok(sample) = reply.result()
            && let Some((robot, agent)) = parts(sample.key_expr().as_str())
        {
            all.push((robot.to_owned(), agent.to_owned()));
        }
    }
    all.sort();
    all.dedup();
    Ok(all)
}

/// Tells who comes and who goes: the robot, the agent, and whether it is there.
///
/// # Errors
/// Zenoh's.
pub fn watch_presence(
    session: &Session,
    robot: &str,
    told: impl Fn(&str, &str, bool) + Send + Sync + 'static,
) -> Result<(), ZenohError> {
    session
        .liveliness()
        .declare_subscriber(format!("{ROOT}/{robot}/*/alive"))
        .history(true)
        .callback(move |sample| {
            if let Some((robot, agent)) = parts(sample.key_expr().as_str()) {
                told(robot, agent, sample.kind() == SampleKind::Put);
            }
        })
        .background()
        .wait()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_key_with_an_odd_name_is_nobodys() {
        let agent = "0123456789abcdef0123456789abcdef";
        assert_eq!(parts(&key("arm-1", agent, "alive")), Some(("arm-1", agent)));
        let odd = "a\nb";
        for key in [
            key(odd, agent, "alive"),
            key("arm", "7", "alive"),
            format!("x/arm/{agent}/alive"),
        ] {
            assert_eq!(parts(&key), None, "{key}");
        }
    }
}
