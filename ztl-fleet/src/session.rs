//! Sessions of Zenoh: opened with the fleet's settings, and who is there.

use std::thread::sleep;
use std::time::{Duration, Instant};

use serde_json::{Value, json};
use tracing::warn;
use zenoh::handlers::CallbackDrop;
use zenoh::query::Reply;
use zenoh::sample::SampleKind;
use zenoh::{Config, Session, Wait as _};

use crate::config::Links;
use crate::obstacles::obstacles;
use crate::wire::{ROOT, Verdict, from_hex, is_name, millis};

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
/// Pause before routers are tried again, at first and at most.
const RETRY: Duration = Duration::from_millis(100);
const LONGEST_RETRY: Duration = Duration::from_secs(1);
/// How long to try a router before the next one's turn: it may accept a connection and say nothing. Each round gives more time, up
/// to the second, as the machine or the line may be slow. With a limit for all, at least the third.
const TURN: Duration = Duration::from_secs(3);
const LONGEST_TURN: Duration = Duration::from_secs(10);
const SHORTEST_TURN: Duration = Duration::from_millis(500);
/// How long to wait for a router before the log says so.
const UNREACHED: Duration = Duration::from_secs(3);

/// Zenoh's settings: connections to the named routers, and to nobody else.
fn settings(links: &Links, mode: &str, turn: Duration) -> Value {
    let mut all = json!({
        "mode": mode,
        "connect": {
            "endpoints": links.routers,
            // Zenoh would try the first router of a client until that is reached.
            "timeout_ms": { "router": -1, "client": 0 },
            "exit_on_failure": false,
            "retry": {
                "period_init_ms": millis(RETRY),
                "period_max_ms": millis(LONGEST_RETRY),
                "period_increase_factor": 2,
            },
        },
        "listen": { "endpoints": links.listen },
        "scouting": { "multicast": { "enabled": false }, "gossip": { "enabled": false } },
        "transport": {
            "unicast": { "open_timeout": millis(turn) },
            "link": {
                "tx": { "lease": LEASE_MS },
                "rx": { "max_message_size": LONGEST },
            },
        },
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
    warn_of_dates(links);
    let config = Config::from_json5(&settings(links, "router", TURN).to_string())?;
    let opened = zenoh::open(config).wait();
    opened.map_err(|error| cannot_route(links, &error.to_string()).into())
}

/// Opens the session of a client, which waits until it reaches a router.
///
/// # Errors
/// Zenoh's.
pub fn open(links: &Links) -> Result<Session, ZenohError> {
    warn_of_dates(links);
    let began = Instant::now();
    let (mut turn, mut pause, mut is_told) = (TURN, RETRY, false);
    loop {
        let tried = Instant::now();
        if let Some(session) = round(links, turn)? {
            return Ok(session);
        }
        if !is_told && began.elapsed() >= UNREACHED {
            is_told = true;
            let links = links.clone();
            let thread = std::thread::Builder::new().name("ztl-fleet-obstacles".to_owned());
            // Nothing waits for a slow resolver.
            thread.spawn(move || {
                warn!(target: "fleet", "No router is reached yet; trying again. {}.", obstacles(&links));
            })?;
        }
        // A router that does not run is no sign of a slow line.
        if tried.elapsed() >= turn {
            turn = (2 * turn).min(LONGEST_TURN);
        }
        sleep(pause);
        pause = (2 * pause).min(LONGEST_RETRY);
    }
}

/// Opens the session of a client, if it reaches a router within `limit`.
///
/// # Errors
/// That it does not, or Zenoh's.
pub fn open_within(links: &Links, limit: Duration) -> Result<Session, ZenohError> {
    warn_of_dates(links);
    let end = Instant::now() + limit;
    let count = u32::try_from(links.routers.len())
        .unwrap_or(u32::MAX)
        .max(1);
    loop {
        let left = end.saturating_duration_since(Instant::now());
        let turn = (left / count).max(SHORTEST_TURN);
        if let Some(session) = round(links, turn)? {
            return Ok(session);
        }
        if Instant::now() + RETRY >= end {
            let (limit, why) = (limit.as_secs(), obstacles(links));
            return Err(format!(
                "no router is reached within {limit} s, so no robot was asked: {why}"
            )
            .into());
        }
        sleep(RETRY);
    }
}

/// Tries each router once, in turn. Returns the session of a client if one is reached.
fn round(links: &Links, turn: Duration) -> Result<Option<Session>, ZenohError> {
    if links.routers.is_empty() {
        return Err("the file names no router; write routers: [tcp/10.0.0.1:7447]".into());
    }
    // A new id each time: a router may still hold a connection of the last one.
    let config = Config::from_json5(&settings(links, "client", turn).to_string())?;
    // Zenoh tells no reason.
    Ok(zenoh::open(config).wait().ok())
}

/// The certificate is used anyway: the clock may be wrong.
fn warn_of_dates(links: &Links) {
    if let Some(mistake) = &links.misdated {
        warn!(target: "fleet", "{}.", mistake.sentence());
    }
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
