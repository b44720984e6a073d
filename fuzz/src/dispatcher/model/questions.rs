//! Which replies a request may get in the current state.

use core::time::Duration;

use ztl_core::dispatcher::LONGEST_WAIT;
use ztl_core::envelope::{ClientId, Envelope};
use ztl_core::integer::Integer;
use ztl_core::{Message, Request};

use super::state::{Asked, First, Model, SCOPES, config};

const GIVEN_UP: &str = "this INIT was given up by its client";
const NUMBER_TAKEN: &str = "another INIT has this number";
const RESERVED: &str = "Invalid request: $ztl takes STATUS with the payload 'probe' or 'outcome N'";

impl Model {
    /// The decision table (`docs/protocol.md` [4.1]), and the time limit of the reply.
    pub(super) fn asked(
        &self,
        envelope: Option<Envelope>,
        message: Message<'_>,
    ) -> (Asked, Duration) {
        let config = config();
        let scope = message.scope;
        let code = message.code().ok().and_then(Integer::value);
        if scope == "$ztl" {
            let outcome = envelope.and_then(|envelope| {
                let number = Integer::parse(message.payload.strip_prefix("outcome ")?).ok()?;
                Some((envelope.client, u64::try_from(number.value()?).ok()?))
            });
            return match (code, message.payload, outcome) {
                (Some(2), "probe", _) => (Asked::Probe, config.hold),
                (Some(2), _, Some((client, number))) => (self.outcome(client, number), config.hold),
                _ => only(format!("$ztl;2;0;{RESERVED}")),
            };
        }
        let Some(scope) = SCOPES.into_iter().find(|known| *known == scope) else {
            return only(format!("{scope};2;-1;No controller for scope: {scope}"));
        };
        let (Ok(code), Ok(id)) = (message.code(), message.number()) else {
            return only(format!("{scope};2;-1;Invalid request"));
        };
        let id = plain(id);
        let task = self
            .tasks
            .iter()
            .position(|task| task.id.to_string() == id && task.scope == scope && !task.forgotten);
        match (code.value().and_then(Request::from_code), task) {
            (None, _) => only(format!("{scope};2;{id};Invalid request")),
            (Some(Request::Init), _) => {
                let early = if envelope.is_some() {
                    config.early
                } else {
                    Default::default()
                };
                (
                    self.init(scope, message.payload, envelope),
                    config.hold + early,
                )
            }
            (_, None) => only(format!("{scope};2;{id};Invalid ID '{id}'")),
            (Some(Request::Abort), Some(task)) => {
                let ended = self.tasks[task].state.is_final();
                (Asked::Abort { task, ended }, config.hold)
            }
            (Some(Request::Status), Some(task)) => {
                let wait = envelope.and_then(|_| {
                    let wait = Integer::parse(message.payload.strip_prefix("wait ")?).ok()?;
                    u64::try_from(wait.value()?).ok()
                });
                let hold = Duration::from_millis(wait.unwrap_or(0)).min(LONGEST_WAIT);
                (
                    Asked::Status {
                        task,
                        wait: wait.is_some(),
                    },
                    hold,
                )
            }
        }
    }

    fn init(&self, scope: &'static str, payload: &str, envelope: Option<Envelope>) -> Asked {
        let Some(envelope) = envelope else {
            return Asked::Init(None);
        };
        match self.inits.get(&envelope.client) {
            Some(last) if last.number == envelope.number => match &last.first {
                First::Void => Asked::Only(format!("{scope};2;-1;{GIVEN_UP}")),
                _ if (last.of.0.as_str(), last.of.1.as_str()) != (scope, payload) => {
                    Asked::Only(format!("{scope};2;-1;{NUMBER_TAKEN}"))
                }
                First::Started(task) => Asked::Again { scope, task: *task },
                First::Refused(text) => Asked::Refusal {
                    scope,
                    text: text.clone(),
                },
            },
            Some(last) if last.number > envelope.number => {
                Asked::Only(format!("{scope};2;-1;{GIVEN_UP}"))
            }
            _ => Asked::Init(None),
        }
    }

    fn outcome(&self, client: ClientId, number: u64) -> Asked {
        let scope = "$ztl";
        match self.inits.get(&client) {
            Some(last) if last.number == number => match &last.first {
                First::Started(task) => Asked::Again { scope, task: *task },
                First::Refused(text) => Asked::Refusal {
                    scope,
                    text: text.clone(),
                },
                First::Void => Asked::NeverSeen(client, number),
            },
            Some(last) if last.number > number => {
                Asked::Only("$ztl;2;0;settled by a later INIT".to_owned())
            }
            _ => Asked::NeverSeen(client, number),
        }
    }
}

/// A request with exactly one reply, sent immediately.
pub(super) fn only(answer: String) -> (Asked, Duration) {
    (Asked::Only(answer), Duration::ZERO)
}

pub(super) fn plain(number: Integer<'_>) -> String {
    let mut out = Vec::new();
    number.put(&mut |bytes: &[u8]| out.extend_from_slice(bytes));
    String::from_utf8(out).expect("ASCII")
}
