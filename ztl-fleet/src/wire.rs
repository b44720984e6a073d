//! What agents and endpoints say to each other (docs/fleet.md): parameters of queries, and verdicts.

use std::fmt::{self, Write as _};
use std::time::Duration;

use serde::{Deserialize, Serialize};
use ztl_core::envelope::ClientId;
use ztl_core::{Message, Request};

/// As numbers on the wire: whole milliseconds.
#[must_use]
pub fn millis(time: Duration) -> u64 {
    u64::try_from(time.as_millis()).unwrap_or(u64::MAX)
}

/// First chunk of every key.
pub const ROOT: &str = "ztl";

/// Longest time for which an INIT may be valid, in milliseconds.
pub const LONGEST_VALID_MS: u64 = 60_000;

/// What an agent can be asked: the last chunk of the key of a query, or a line of a sealed one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum AgentQuery {
    /// Passes a request on to the robot's server.
    Request,
    /// What became of an INIT.
    Outcome,
    /// What the robot is.
    Info,
    /// Ends all tasks.
    Stop,
    /// Asks for messages of the robot's publisher.
    Streams,
}

impl AgentQuery {
    /// All of them.
    pub const ALL: [Self; 5] = [
        Self::Request,
        Self::Outcome,
        Self::Info,
        Self::Stop,
        Self::Streams,
    ];

    /// Its name on the wire.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Request => "request",
            Self::Outcome => "outcome",
            Self::Info => "info",
            Self::Stop => "stop",
            Self::Streams => "streams",
        }
    }

    /// Reads a name.
    #[must_use]
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|query| query.name() == name)
    }
}

/// Why an INIT starts nothing whose number belongs to another one. What became of that one stays as it is.
pub const ANOTHER_INIT: &str = "another INIT has this number";

/// FNV-1a: tells apart INITs that a client did not mean to be the same. Its clients choose both.
#[must_use]
pub fn checksum(bytes: &[u8]) -> u64 {
    let step = |hash: u64, byte: &u8| (hash ^ u64::from(*byte)).wrapping_mul(0x0100_0000_01b3);
    bytes.iter().fold(0xcbf2_9ce4_8422_2325, step)
}

/// Identifies an INIT: its client, and the client's number for it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct InitId {
    /// The client.
    pub client: ClientId,
    /// Rises with each request of the client.
    pub number: u64,
}

impl Serialize for InitId {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        (hex(&self.client), self.number).serialize(serializer)
    }
}

impl<'de> Deserialize<'de> for InitId {
    fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let (client, number) = <(String, u64)>::deserialize(deserializer)?;
        let client = from_hex(&client).ok_or_else(|| serde::de::Error::custom("client"))?;
        Ok(Self { client, number })
    }
}

/// What makes an INIT act at most once.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct InitRules {
    /// Which INIT it is.
    pub id: InitId,
    /// The boot id of the agent that may act on it; 0 if it is not known yet.
    pub boot: u32,
    /// The agent's clock, in milliseconds, after which the agent refuses it.
    pub until_ms: u64,
}

impl InitRules {
    /// The parameters of a query.
    #[must_use]
    pub fn to_parameters(&self) -> String {
        let InitId { client, number } = self.id;
        let (client, boot, until) = (hex(&client), self.boot, self.until_ms);
        format!("client={client};number={number};boot={boot};until={until}")
    }

    /// Reads the parameters of a query. `None` without a client.
    ///
    /// # Errors
    /// What is wrong.
    pub fn parse(parameters: &str) -> Result<Option<Self>, String> {
        let value = |key: &str| value(parameters, key);
        let Some(client) = value("client") else {
            return Ok(None);
        };
        let client = from_hex(client)
            .ok_or_else(|| format!("client '{client}' is not 32 hexadecimal digits"))?;
        let number = |key: &str| match value(key) {
            Some(text) => text
                .parse::<u64>()
                .map_err(|_| format!("{key} '{text}' is not a whole number")),
            None => Err(format!("'{key}' is missing")),
        };
        let id = InitId {
            client,
            number: number("number")?,
        };
        Ok(Some(Self {
            id,
            boot: u32::try_from(number("boot")?).map_err(|_| "boot is too large")?,
            until_ms: number("until")?,
        }))
    }
}

/// The parameters of a sealed query that is no INIT: the boot and the agent's clock, after which it does not act.
#[must_use]
pub fn fresh(boot: u32, until_ms: u64) -> String {
    format!("boot={boot};until={until_ms}")
}

/// Until when a query with these parameters may act, by the agent's clock; `None` if it may not in this boot at this time.
#[must_use]
pub fn fresh_until(parameters: &str, boot: u32, clock_ms: u64) -> Option<u64> {
    let until = value(parameters, "until").and_then(|until| until.parse().ok());
    let valid = clock_ms..=clock_ms.saturating_add(LONGEST_VALID_MS);
    let is_ours = value(parameters, "boot") == Some(boot.to_string().as_str());
    until.filter(|until| is_ours && valid.contains(until))
}

/// Whether the client of an INIT with these parameters asks for an early outcome ([10.3] of the protocol).
#[must_use]
pub fn is_early(parameters: &str) -> bool {
    value(parameters, "early") == Some("1")
}

fn value<'a>(parameters: &'a str, key: &str) -> Option<&'a str> {
    let pairs = parameters
        .split(';')
        .filter_map(|pair| pair.split_once('='));
    let mut found = pairs.filter(|(name, _)| *name == key);
    found.next().map(|(_, value)| value)
}

/// 32 hexadecimal digits.
#[must_use]
pub fn hex(client: &ClientId) -> String {
    client.0.iter().fold(String::new(), |mut text, byte| {
        // Writing to a string does not fail.
        let _ = write!(text, "{byte:02x}");
        text
    })
}

/// Reads 32 hexadecimal digits.
#[must_use]
pub fn from_hex(text: &str) -> Option<ClientId> {
    if text.len() != 32 || !text.bytes().all(|byte| byte.is_ascii_hexdigit()) {
        return None;
    }
    let number = u128::from_str_radix(text, 16).ok()?;
    Some(ClientId(number.to_be_bytes()))
}

/// An agent's answer to a query.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Verdict {
    /// The robot's answer, a body as on ZeroMQ.
    Answer(Vec<u8>),
    /// Nothing was started by this INIT, and nothing will be.
    NotStarted(String),
    /// The same, for an INIT of another boot or one that came too late. One with these values can be sent.
    Stale {
        /// The agent's boot id.
        boot: u32,
        /// The agent's clock in milliseconds.
        clock_ms: u64,
    },
    /// What the robot did is not known: a task may be running.
    Unknown(String),
}

const NOT_STARTED: &str = "not started: ";
const STALE: &str = "stale: ";
const UNKNOWN: &str = "unknown: ";

impl Verdict {
    /// The payload of the reply; an answer is a reply, everything else an error.
    #[must_use]
    pub fn to_payload(&self) -> (bool, Vec<u8>) {
        match self {
            Self::Answer(body) => (true, body.clone()),
            other => (false, other.to_string().into_bytes()),
        }
    }

    /// Reads an error. What cannot be read says nothing.
    #[must_use]
    pub fn of_error(payload: &[u8]) -> Self {
        let text = String::from_utf8_lossy(payload);
        let stale = || {
            let (boot, clock) = text.strip_prefix(STALE)?.split_once(' ')?;
            Some(Self::Stale {
                boot: boot.strip_prefix("boot=")?.parse().ok()?,
                clock_ms: clock.strip_prefix("clock=")?.parse().ok()?,
            })
        };
        if let Some(stale) = stale() {
            return stale;
        }
        match text.strip_prefix(NOT_STARTED) {
            Some(reason) => Self::NotStarted(reason.to_owned()),
            None => Self::Unknown(text.strip_prefix(UNKNOWN).unwrap_or(&text).to_owned()),
        }
    }
}

impl fmt::Display for Verdict {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Answer(body) => f.write_str(&String::from_utf8_lossy(body)),
            Self::NotStarted(reason) => write!(f, "{NOT_STARTED}{reason}"),
            Self::Stale { boot, clock_ms } => write!(f, "{STALE}boot={boot} clock={clock_ms}"),
            Self::Unknown(reason) => write!(f, "{UNKNOWN}{reason}"),
        }
    }
}

/// Whether a request is an ABORT, which no flood of others may hold up.
#[must_use]
pub fn is_abort(body: &[u8]) -> bool {
    let message = Message::parse(body).ok();
    let code = message.and_then(|message| message.code().ok()?.value());
    code.and_then(Request::from_code) == Some(Request::Abort)
}

/// What a robot says of itself, in JSON.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct RobotInfo {
    /// Version of the fleet's protocol.
    pub ztl_fleet: u32,
    /// The robot's name.
    pub name: String,
    /// Its agent's id, the same for each start.
    pub agent: String,
    /// The agent's boot id.
    pub boot: u32,
    /// The agent's clock in milliseconds, for the validity of INITs.
    pub clock_ms: u64,
    /// When the agent claimed the name: seconds since 1970.
    pub since: u64,
    /// For how long it has had the name, in milliseconds.
    #[serde(default)]
    pub held_ms: u64,
    /// The groups that it belongs to.
    #[serde(default)]
    pub groups: Vec<String>,
    /// Whether it has a publisher.
    #[serde(default)]
    pub streams: bool,
    /// Whether its server answers.
    pub ready: bool,
    /// Why not.
    #[serde(default)]
    pub problem: Option<String>,
    /// What its server answers to `probe`; `None` for a server of the original.
    #[serde(default)]
    pub server: Option<String>,
    /// Its scopes, if they are known.
    #[serde(default)]
    pub scopes: Vec<String>,
}

/// What became of the tasks of a robot that was told to stop.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Stopped {
    /// The agent's boot id, which tells apart machines that answer as one robot.
    #[serde(default)]
    pub boot: u32,
    /// Tasks that have ended now: `/scope id`.
    pub stopped: Vec<String>,
    /// Tasks that have not, with the reason.
    pub running: Vec<String>,
    /// Why the robot cannot tell whether more tasks run; `None` if it can.
    pub unknown: Option<String>,
    /// Whether to tell it again: tasks still run, or its server does not answer.
    #[serde(default)]
    pub again: bool,
    /// Whether another machine has answered as this robot within the last minute. It may move, and be silent.
    #[serde(default)]
    pub copy: bool,
}

/// Whether a text can be a robot's name, which is a chunk of a key and the first part of a scope.
#[must_use]
pub fn is_name(text: &str) -> bool {
    let fits = |c: char| c.is_ascii_alphanumeric() || matches!(c, '-' | '_' | '.');
    (1..=64).contains(&text.len()) && text.chars().all(fits)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parameters_round_trip() {
        let rules = InitRules {
            id: InitId {
                client: ClientId(*b"0123456789abcdef"),
                number: 258,
            },
            boot: 7,
            until_ms: 9000,
        };
        let text = rules.to_parameters();
        assert_eq!(
            text,
            "client=30313233343536373839616263646566;number=258;boot=7;until=9000"
        );
        assert_eq!(InitRules::parse(&text), Ok(Some(rules)));
        assert_eq!(InitRules::parse("number=7"), Ok(None));
        for wrong in [
            "client=07;number=1;boot=1;until=1",
            "client=+0313233343536373839616263646566;number=1;boot=1;until=1",
            "client=30313233343536373839616263646566;number=-1;boot=1;until=1",
            "client=30313233343536373839616263646566;number=1;boot=4294967296;until=1",
            "client=30313233343536373839616263646566;number=1;boot=1",
        ] {
            assert!(InitRules::parse(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn a_question_is_fresh_in_its_boot_and_until_its_time() {
        let with_client = "client=x;number=1;boot=7;until=100";
        for fits in [&fresh(7, 100), with_client] {
            assert_eq!(fresh_until(fits, 7, 100), Some(100));
            assert_eq!(fresh_until(fits, 7, 101), None);
            assert_eq!(fresh_until(fits, 8, 100), None);
        }
        let eternal = fresh(7, LONGEST_VALID_MS + 1);
        for wrong in [&eternal, "boot=7", "until=1", ""] {
            assert_eq!(fresh_until(wrong, 7, 0), None);
        }
    }

    #[test]
    fn verdicts_round_trip_and_the_unreadable_is_unknown() {
        for verdict in [
            Verdict::NotStarted("no".to_owned()),
            Verdict::Stale {
                boot: 7,
                clock_ms: 8,
            },
            Verdict::Unknown("silent".to_owned()),
        ] {
            let (is_answer, payload) = verdict.to_payload();
            assert!(!is_answer);
            assert_eq!(Verdict::of_error(&payload), verdict);
        }
        for odd in [&b"stale: boot=x clock=7"[..], b"\xff", b""] {
            assert!(matches!(Verdict::of_error(odd), Verdict::Unknown(_)));
        }
    }
}
