//! The scope `$ztl` of an endpoint: what it is, and questions that it passes on to robots.

use std::collections::{BTreeMap, BTreeSet};

use serde_json::{Map, Value, json};
use ztl_core::{Instant, Message, Request};
use ztl_std::{Description, Offers};

use super::requests::split;
use super::{
    Ask, ClientRequest, Endpoint, EndpointEffect, LONGEST, Pending, Purpose, about_server,
};

/// Components of one robot in the numbering of `describe`: the endpoint counts robots in steps of this.
const STEP: u64 = 1_000_000;

/// A question to several robots.
#[derive(Debug)]
pub(super) struct Question {
    kind: Kind,
    /// How many have not answered.
    open: usize,
    parts: BTreeMap<String, Value>,
    allowed: Allowed,
}

/// What a client may use. Robots answer by the rights of the endpoint, so their answers are limited to this.
#[derive(Debug, Default)]
struct Allowed {
    /// Robots of which it may use all scopes.
    robots: BTreeSet<String>,
    /// Scopes as the endpoint names them.
    scopes: BTreeSet<String>,
}

impl Allowed {
    fn has(&self, robot: &str, scope: &str) -> bool {
        // Behind the robot's name, another text could name another robot.
        scope.starts_with('/')
            && (self.robots.contains(robot) || self.scopes.contains(&format!("/{robot}{scope}")))
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    /// A list of tasks.
    Tasks,
    /// A mapping whose keys are scopes.
    ByScope,
    /// Components from this one of this robot on, of so many robots.
    Describe { robot: u64, inner: u64, robots: u64 },
}

impl Endpoint {
    pub(super) fn on_reserved(
        &mut self,
        now: Instant,
        asked: ClientRequest<'_>,
        kind: Option<Request>,
        message: &Message<'_>,
        may_use: impl Fn(&str) -> bool,
    ) -> Vec<EndpointEffect> {
        let request = asked.request;
        let answer = |body| vec![EndpointEffect::Answer { request, body }];
        let invalid = "Invalid request: $ztl takes STATUS with the payload 'probe' or 'outcome N'";
        let payload = message.payload;
        if kind != Some(Request::Status) {
            return answer(about_server(2, invalid));
        }
        if payload == "probe" {
            return answer(about_server(5, &self.probed(&may_use)));
        }
        if let (Some(envelope), Some(number)) = (asked.envelope, payload.strip_prefix("outcome "))
            && let Ok(number) = number.trim().parse()
        {
            return self.on_outcome(now, request, envelope, number);
        }
        let word = payload.split(' ').next().unwrap_or_default();
        let mut allowed = Allowed::default();
        let mut here = Vec::new();
        for (name, agent) in self.robots() {
            let before = allowed.scopes.len();
            let scopes = self.scopes_of(name);
            allowed.scopes.extend(scopes.filter(|scope| may_use(scope)));
            if allowed.scopes.len() > before {
                here.push((name.to_owned(), agent.to_owned()));
                let whole = Some(name).filter(|name| may_use(&format!("/{name}")));
                allowed.robots.extend(whole.map(str::to_owned));
            }
        }
        let (kind, to, question) = match word {
            "tasks" => (Kind::Tasks, here, payload.to_owned()),
            "devices" | "takes" | "log" => (Kind::ByScope, here, payload.to_owned()),
            "describe" => {
                let argument = payload
                    .strip_prefix("describe")
                    .unwrap_or_default()
                    .trim_start();
                let (scope, from) = argument.split_once(';').unwrap_or((argument, "0"));
                let Ok(from) = from.parse::<u64>() else {
                    return answer(about_server(2, invalid));
                };
                let robots = here.len() as u64;
                let (robot, to, scope) = match split(scope) {
                    _ if scope.is_empty() => {
                        let nth = usize::try_from(from / STEP).unwrap_or(usize::MAX);
                        (from / STEP, here.into_iter().nth(nth), "")
                    }
                    Some((name, scope)) => {
                        let mut named = here.into_iter();
                        let named =
                            named.find(|(known, _)| known == name && allowed.has(name, scope));
                        // There is no next robot.
                        (robots, named, scope)
                    }
                    None => (robots, None, ""),
                };
                let inner = from % STEP;
                let question = format!("describe {scope};{inner}");
                (
                    Kind::Describe {
                        robot,
                        inner,
                        robots,
                    },
                    to.into_iter().collect(),
                    question,
                )
            }
            _ => return answer(about_server(2, invalid)),
        };
        let open = to.len();
        let parts = BTreeMap::new();
        let all = Question {
            kind,
            open,
            parts,
            allowed,
        };
        if open == 0 {
            return answer(all.answer());
        }
        if self.is_full(open) {
            return vec![EndpointEffect::Silence { request }];
        }
        self.questions.insert(request, all);
        let ask = |(robot, agent)| {
            let body = format!("$ztl;2;-1;{question}").into_bytes();
            let pending = Pending {
                request,
                robot,
                agent,
                what: Ask::Request {
                    rules: None,
                    envelope: None,
                    body,
                },
                purpose: Purpose::Part,
                deadline: now + LONGEST,
                again: None,
                stale: 0,
            };
            self.ask(now, pending)
        };
        to.into_iter().map(ask).collect()
    }

    /// A robot's part of an answer; `None` if it does not answer.
    pub(super) fn on_part(
        &mut self,
        request: u64,
        robot: &str,
        body: Option<&[u8]>,
    ) -> Vec<EndpointEffect> {
        let Some(question) = self.questions.get_mut(&request) else {
            return Vec::new();
        };
        let part = body.and_then(|body| {
            let message = Message::parse(body).ok()?;
            let is_told = message.scope == "$ztl" && message.state == "5";
            let value = serde_json::from_str(message.payload).ok()?;
            is_told.then_some(value)
        });
        if let Some(part) = part {
            question.parts.insert(robot.to_owned(), part);
        }
        question.open = question.open.saturating_sub(1);
        if question.open > 0 {
            return Vec::new();
        }
        let body = question.answer();
        self.questions.remove(&request);
        vec![EndpointEffect::Answer { request, body }]
    }

    /// The scopes of a robot, as the endpoint names them.
    fn scopes_of(&self, robot: &str) -> impl Iterator<Item = String> {
        let info = self.robots.get(robot).and_then(|robot| robot.info.as_ref());
        let scopes = info.into_iter().flat_map(|info| &info.scopes);
        scopes.map(move |scope| format!("/{robot}{scope}"))
    }

    /// What a robot's server says that its scopes offer.
    fn offers_of(&self, robot: &str) -> BTreeMap<String, Offers> {
        let info = self.robots.get(robot).and_then(|robot| robot.info.as_ref());
        let probed = info.and_then(|info| info.server.clone());
        let told = probed.and_then(|probed| Description::read(probed).ok());
        told.map(|told| told.scopes).unwrap_or_default()
    }

    /// The answer to `probe`.
    fn probed(&self, may_use: &impl Fn(&str) -> bool) -> String {
        let mut scopes = Vec::new();
        for (name, _) in self.robots() {
            let allowed = self.scopes_of(name).filter(|scope| may_use(scope));
            let offers = self.offers_of(name);
            // JSON is YAML, too.
            scopes.extend(allowed.map(|scope| {
                let own = scope.get(1 + name.len()..).unwrap_or_default();
                let offers = json!(offers.get(own).cloned().unwrap_or_default());
                format!("{}: {offers}", Value::from(scope))
            }));
        }
        let (version, boot, scopes) = (ztl_core::VERSION, self.boot, scopes.join(", "));
        format!(
            "{{ztl: 1, version: '{version}', boot: {boot}, message: {}, scopes: {{{scopes}}}, running: {{}}}}",
            ztl_std::server::MAX_MESSAGE - 1024
        )
    }
}

impl Question {
    /// The answer from all parts.
    fn answer(&self) -> Vec<u8> {
        let value = match self.kind {
            Kind::Tasks => self.tasks(),
            Kind::ByScope => {
                let mut all = Map::new();
                for (robot, part) in &self.parts {
                    let scopes = part.as_object().into_iter().flatten();
                    for (scope, value) in scopes.filter(|it| self.allowed.has(robot, it.0)) {
                        all.insert(format!("/{robot}{scope}"), value.clone());
                    }
                }
                Value::Object(all)
            }
            Kind::Describe {
                robot,
                inner,
                robots,
            } => self.components(robot, inner, robots),
        };
        about_server(5, &value.to_string())
    }

    fn tasks(&self) -> Value {
        let mut tasks = Vec::new();
        let (mut more, mut elsewhere) = (0_u64, 0_u64);
        for (robot, part) in &self.parts {
            let (told, hidden) = self.scoped(robot, part.get("tasks"));
            tasks.extend(told);
            // Of others, only how many run.
            let runs = |task: &&Value| task.get("state").and_then(Value::as_u64) < Some(2);
            elsewhere = elsewhere.saturating_add(hidden.iter().filter(runs).count() as u64);
            let number = |key| part.get(key).and_then(Value::as_u64).unwrap_or_default();
            more = more.saturating_add(number("more"));
            elsewhere = elsewhere.saturating_add(number("elsewhere"));
        }
        json!({ "tasks": tasks, "more": more, "elsewhere": elsewhere })
    }

    fn components(&self, robot: u64, asked: u64, robots: u64) -> Value {
        let mut all = Vec::new();
        let mut next = None;
        for (name, part) in &self.parts {
            all.extend(self.scoped(name, part.get("components")).0);
            let inner = part.get("next").and_then(Value::as_u64);
            // A robot that does not count on hides no other one.
            next = inner.filter(|inner| *inner > asked && *inner < STEP);
        }
        let base = if robot < robots { robot * STEP } else { 0 };
        let next = match next {
            Some(inner) => Some(base + inner),
            None if robot + 1 < robots => Some(base + STEP),
            None => None,
        };
        match next {
            Some(next) => json!({ "components": all, "next": next }),
            None => json!({ "components": all }),
        }
    }

    /// Entries with the endpoint's scopes, and those that the client may not know.
    fn scoped(&self, robot: &str, entries: Option<&Value>) -> (Vec<Value>, Vec<Value>) {
        let entries = entries.and_then(Value::as_array).into_iter().flatten();
        let (mut told, mut hidden) = (Vec::new(), Vec::new());
        for entry in entries {
            let mut entry = entry.clone();
            match entry.get_mut("scope") {
                Some(Value::String(scope)) if self.allowed.has(robot, scope) => {
                    *scope = format!("/{robot}{scope}");
                    told.push(entry);
                }
                _ => hidden.push(entry),
            }
        }
        (told, hidden)
    }
}
