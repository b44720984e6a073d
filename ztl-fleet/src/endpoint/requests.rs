//! Requests of clients to robots, and the outcome of INITs.

use ztl_core::envelope::Envelope;
use ztl_core::integer::Integer;
use ztl_core::{Instant, Message, Request};

use super::{
    Ask, ClientRequest, EachTold, Endpoint, EndpointEffect, InitId, InitRules, KEEP, LONGEST,
    LONGEST_HOLD_MS, LastInit, MOST, Pending, Purpose, about_server, rejection, with_scope,
};
use crate::wire::{ANOTHER_INIT, checksum, is_name, millis};

/// The robot and its own scope in a scope of the endpoint: `/NAME/scope`.
pub(super) fn split(scope: &str) -> Option<(&str, &str)> {
    let rest = scope.strip_prefix('/')?;
    let end = rest.find('/')?;
    rest.split_at_checked(end)
}

/// The robot that a request is for; empty if it is for none.
#[must_use]
pub fn robot_of(body: &[u8]) -> &str {
    let message = Message::parse(body).ok();
    let robot = message.and_then(|message| split(message.scope));
    let robot = robot.map(|(robot, _)| robot);
    robot.filter(|robot| is_name(robot)).unwrap_or_default()
}

impl Endpoint {
    /// A client's request. `may_use` tells which scopes the client may use.
    pub fn handle_request(
        &mut self,
        now: Instant,
        asked: ClientRequest<'_>,
        may_use: impl Fn(&str) -> bool,
    ) -> Vec<EndpointEffect> {
        let request = asked.request;
        let answer = |body| vec![EndpointEffect::Answer { request, body }];
        let message = match asked.body.map(Message::parse) {
            Some(Ok(message)) => message,
            Some(Err(error)) => {
                let scope = error.scope();
                return answer(rejection(scope, "Unknown protocol"));
            }
            None => return answer(rejection("", "Unknown protocol")),
        };
        // A server that reads other digits, as the original's, might take it for an INIT or an ABORT.
        let (Ok(code), Ok(_)) = (message.code(), message.number()) else {
            return answer(rejection(message.scope, "Invalid request"));
        };
        let kind = code.value().and_then(Request::from_code);
        if message.scope == "$ztl" {
            return self.on_reserved(now, asked, kind, &message, may_use);
        }
        let scope = message.scope;
        let unknown = || rejection(scope, &format!("No controller for scope: {scope}"));
        let Some((name, robot_scope)) = split(scope).filter(|_| may_use(scope)) else {
            return answer(unknown());
        };
        let is_init = kind == Some(Request::Init);
        let is_abort = kind == Some(Request::Abort);
        let hash = checksum(format!("{robot_scope};{}", message.payload).as_bytes());
        let silence = vec![EndpointEffect::Silence { request }];
        let robot = self.robots.get(name);
        let agent = robot.and_then(|robot| robot.agent.clone());
        let refused = match (robot, &agent) {
            (None, _) if !self.expected.contains(name) => {
                Some(format!("No controller for scope: {scope}"))
            }
            (_, None) => Some(format!("robot '{name}' is not connected")),
            (Some(robot), _) if robot.is_doubted && !is_abort => Some(format!(
                "two machines answer as robot '{name}', so neither gets a task"
            )),
            // No flood of other requests keeps a task from being ended.
            _ if self.is_full(1) && (!is_abort || self.pending.len() >= 2 * MOST) => {
                Some("too many requests are waiting, try again".to_owned())
            }
            _ => None,
        };
        let (Some(robot), Some(agent), None) = (robot, agent, &refused) else {
            // Nothing is sent, so nothing is started. An endpoint that has just started does not know all robots, and a
            // task may run there.
            return match refused {
                Some(reason) if is_init => self.refuse(now, asked, scope, name, hash, &reason),
                _ => silence,
            };
        };
        let purpose = match robot.is_doubted {
            // Which machine runs the task is not known, nor what a machine's answer says of it.
            true => Purpose::AbortEach(EachTold::default()),
            false => Purpose::Request {
                scope: scope.to_owned(),
            },
        };
        let mut rules = None;
        if is_init {
            let (boot, clock_ms) = robot.clock(now);
            let id = asked.envelope.map_or(
                InitId {
                    client: asked.fresh,
                    // This client sends nothing else with this id.
                    number: 0,
                },
                |Envelope { client, number, .. }| InitId { client, number },
            );
            let mut new = InitRules {
                id,
                boot,
                until_ms: clock_ms.saturating_add(millis(LONGEST)),
            };
            if asked.envelope.is_some() {
                match self.note_init(now, name, &agent, hash, new) {
                    // The robot's agent knows it, or its boot.
                    Ok(first) => new = first.unwrap_or(new),
                    Err(reason) => return answer(rejection(scope, reason)),
                }
            }
            rules = Some(new);
        }
        let Message {
            state, id, payload, ..
        } = message;
        let held = payload.strip_prefix("wait ").filter(|_| !is_init);
        let held = held.and_then(|wait| u64::try_from(Integer::parse(wait).ok()?.value()?).ok());
        let held = held.map(|wait| format!("wait {}", wait.min(LONGEST_HOLD_MS)));
        let payload = held.as_deref().unwrap_or(payload);
        let body = format!("{robot_scope};{state};{id};{payload}").into_bytes();
        let pending = Pending {
            request,
            robot: name.to_owned(),
            agent,
            what: Ask::Request {
                rules,
                envelope: asked.envelope,
                body,
            },
            purpose,
            deadline: now + LONGEST,
            again: None,
            stale: 0,
        };
        vec![self.ask(now, pending)]
    }

    /// `outcome N` of a client.
    pub(super) fn on_outcome(
        &mut self,
        now: Instant,
        request: u64,
        envelope: Envelope,
        number: u64,
    ) -> Vec<EndpointEffect> {
        let answer = |body| vec![EndpointEffect::Answer { request, body }];
        let id = InitId {
            client: envelope.client,
            number,
        };
        let last = self.inits.get(&id.client);
        if last.is_some_and(|last| last.number > number) {
            return answer(about_server(2, "settled by a later INIT"));
        }
        match last.filter(|last| last.number == number) {
            Some(LastInit {
                answer: Some(body), ..
            }) => answer(with_scope(body, "$ztl")),
            Some(LastInit {
                robot,
                agent,
                rules: Some(rules),
                void: false,
                ..
            }) => {
                let pending = Pending {
                    request,
                    robot: robot.clone(),
                    agent: agent.clone(),
                    what: Ask::Outcome(*rules),
                    purpose: Purpose::Outcome(id),
                    deadline: now + LONGEST,
                    again: None,
                    stale: 0,
                };
                vec![self.ask(now, pending)]
            }
            _ if self.inits.len() >= MOST && last.is_none() => {
                let text = "too many clients at a time, try again in a minute";
                answer(about_server(2, text))
            }
            _ => {
                let void = LastInit {
                    number,
                    robot: String::new(),
                    agent: String::new(),
                    hash: None,
                    rules: None,
                    answer: None,
                    void: true,
                    expires: now + KEEP,
                };
                self.inits.insert(id.client, void);
                answer(self.never_seen())
            }
        }
    }

    /// Refuses an INIT without sending it; never one that was sent.
    fn refuse(
        &mut self,
        now: Instant,
        asked: ClientRequest<'_>,
        scope: &str,
        robot: &str,
        hash: u64,
        reason: &str,
    ) -> Vec<EndpointEffect> {
        let request = asked.request;
        let mut body = rejection(scope, reason);
        if let Some(Envelope { client, number, .. }) = asked.envelope {
            let id = InitId { client, number };
            let rules = InitRules {
                id,
                boot: 0,
                until_ms: 0,
            };
            match self.note_init(now, robot, "", hash, rules) {
                Ok(Some(_)) => return vec![EndpointEffect::Silence { request }],
                Ok(None) => {
                    self.note_answer(now, id, &body);
                    self.give_up(id);
                }
                Err(reason) => body = rejection(scope, reason),
            }
        }
        vec![EndpointEffect::Answer { request, body }]
    }

    /// Remembers an INIT that is about to be sent. Returns the rules with which it was sent before.
    fn note_init(
        &mut self,
        now: Instant,
        robot: &str,
        agent: &str,
        hash: u64,
        rules: InitRules,
    ) -> Result<Option<InitRules>, &'static str> {
        let id = rules.id;
        let last = self.inits.get(&id.client);
        if last.is_none() && self.inits.len() >= MOST {
            return Err("too many clients at a time, try again in a minute");
        }
        if let Some(last) = last {
            if last.number > id.number || last.number == id.number && last.void {
                return Err("this INIT was given up by its client");
            }
            let is_another = last.robot != robot || last.hash.is_some_and(|last| last != hash);
            if last.number == id.number && is_another {
                return Err(ANOTHER_INIT);
            }
            if last.number == id.number {
                return Ok(last.rules);
            }
        }
        let init = LastInit {
            number: id.number,
            robot: robot.to_owned(),
            agent: agent.to_owned(),
            hash: Some(hash),
            rules: Some(rules),
            answer: None,
            void: false,
            expires: now + KEEP,
        };
        self.inits.insert(id.client, init);
        Ok(None)
    }

    /// The robot says that an INIT with these rules does not act. Returns the rules for the next try: `new`, or those with which
    /// another copy of it was sent meanwhile.
    pub(super) fn note_rules(&mut self, refused: InitRules, new: InitRules) -> InitRules {
        match self.last(new.id).map(|last| &mut last.rules) {
            Some(Some(latest)) if *latest != refused => *latest,
            Some(rules) => *rules.insert(new),
            None => new,
        }
    }

    /// Whether no copy of an INIT was sent with later rules.
    pub(super) fn is_latest(&mut self, id: InitId, what: &Ask) -> bool {
        match (self.last(id), what) {
            (Some(last), Ask::Request { rules, .. }) => last.rules == *rules,
            _ => true,
        }
    }

    pub(super) fn note_answer(&mut self, now: Instant, id: InitId, body: &[u8]) {
        if let Some(last) = self.last(id) {
            last.answer = Some(body.to_vec());
            last.expires = now + KEEP;
        }
    }

    /// The robot has another INIT with this number, which the client may repeat.
    pub(super) fn forget_hash(&mut self, id: InitId) {
        if let Some(last) = self.last(id) {
            last.hash = None;
        }
    }

    pub(super) fn give_up(&mut self, id: InitId) {
        if let Some(last) = self.last(id) {
            last.void = true;
        }
    }

    /// Whether there is no room for so many queries more.
    pub(super) fn is_full(&self, more: usize) -> bool {
        self.pending.len().saturating_add(more) > MOST
    }

    fn last(&mut self, id: InitId) -> Option<&mut LastInit> {
        let last = self.inits.get_mut(&id.client)?;
        (last.number == id.number).then_some(last)
    }
}
