//! Sessions of Zenoh: opened with the fleet's settings, and asked without its types.

use std::sync::mpsc::{Sender, channel};
use std::time::Duration;

use serde_json::{Value, json};
use zenoh::handlers::CallbackDrop;
use zenoh::query::Reply;
use zenoh::sample::SampleKind;
use zenoh::{Config, Session, Wait as _};

use crate::config::Links;
use crate::wire::{ROOT, RobotInfo, Verdict};

/// What failed in Zenoh.
pub type ZenohError = Box<dyn std::error::Error + Send + Sync>;

/// After this silence a connection counts as lost.
const LEASE_MS: u32 = 3000;
/// Longest pause before a connection is tried again.
const RETRY_MS: u32 = 1000;

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
        "transport": { "link": { "tx": { "lease": LEASE_MS } } },
    });
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

/// Opens a session: of a client of routers, or of a router.
///
/// # Errors
/// Zenoh's: for example an address that is taken.
pub fn open(links: &Links, is_router: bool) -> Result<Session, ZenohError> {
    let mode = if is_router { "router" } else { "client" };
    let config = Config::from_json5(&settings(links, mode).to_string())?;
    zenoh::open(config).wait()
}

/// The key of something that an agent offers.
#[must_use]
pub fn key(robot: &str, agent: &str, what: &str) -> String {
    format!("{ROOT}/{robot}/{agent}/{what}")
}

/// The robot and the agent in a key.
#[must_use]
pub fn parts(key: &str) -> Option<(&str, &str)> {
    let mut chunks = key.split('/');
    let root = chunks.next()?;
    let (robot, agent) = (chunks.next()?, chunks.next()?);
    (root == ROOT).then_some((robot, agent))
}

/// A reply as a verdict.
#[must_use]
pub fn verdict(reply: &Reply) -> Verdict {
    match reply.result() {
        Ok(sample) => Verdict::Answer(sample.payload().to_bytes().into_owned()),
        Err(error) => Verdict::of_error(&error.payload().to_bytes()),
    }
}

/// A query. Its first reply, then its end go to the functions.
///
/// # Errors
/// Zenoh's, if nothing was sent.
pub fn ask(
    session: &Session,
    selector: &str,
    payload: &[u8],
    limit: Duration,
    on_reply: impl Fn(Verdict) + Send + Sync + 'static,
    on_end: impl FnMut() + Send + Sync + 'static,
) -> Result<(), ZenohError> {
    let handler = CallbackDrop {
        callback: move |reply: Reply| on_reply(verdict(&reply)),
        drop: on_end,
    };
    let query = session.get(selector).payload(payload).timeout(limit);
    query.with(handler).wait()
}

/// Asks several agents at once, and waits for their replies. `None` where there is none within the limit.
#[must_use]
pub fn ask_all(
    session: &Session,
    selectors: &[String],
    payload: &[u8],
    limit: Duration,
) -> Vec<Option<Verdict>> {
    let (sender, receiver) = channel();
    for (index, selector) in selectors.iter().enumerate() {
        let (replies, ends): (Sender<(usize, Option<Verdict>)>, _) =
            (sender.clone(), sender.clone());
        let on_reply = move |verdict| {
            // The receiver is there as long as this function.
            let _ = replies.send((index, Some(verdict)));
        };
        let on_end = move || {
            let _ = ends.send((index, None));
        };
        if ask(session, selector, payload, limit, on_reply, on_end).is_err() {
            let _ = sender.send((index, None));
        }
    }
    drop(sender);
    let mut all = vec![None; selectors.len()];
    for (index, verdict) in receiver {
        if let Some(slot) = all.get_mut(index)
            && slot.is_none()
        {
            *slot = verdict;
        }
    }
    all
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

/// What agents say of their robots.
#[must_use]
pub fn infos(
    session: &Session,
    agents: &[(String, String)],
    limit: Duration,
) -> Vec<Option<RobotInfo>> {
    let selectors: Vec<String> = agents
        .iter()
        .map(|(robot, agent)| key(robot, agent, "info"))
        .collect();
    let read = |verdict: Option<Verdict>| match verdict {
        Some(Verdict::Answer(body)) => serde_json::from_slice(&body).ok(),
        _ => None,
    };
    let all = ask_all(session, &selectors, b"", limit);
    all.into_iter().map(read).collect()
}
