//! Clients of the endpoints, and what they conclude.

use std::time::Duration;

use ztl_core::Instant;
use ztl_core::envelope::{ClientId, Envelope};

use super::super::ends::fleet::endpoint::ClientRequest;
use super::judge::{Said, Truth, read};
use super::robot::SCOPES;
use super::{ENDPOINTS, Event, PEOPLE, ROBOTS, World, name};

/// A client.
#[derive(Default)]
pub(super) struct Person {
    id: Option<ClientId>,
    number: u64,
    last: Option<Last>,
}

/// A client's last INIT.
#[derive(Clone)]
struct Last {
    tag: String,
    number: u64,
    body: String,
    endpoint: usize,
    boot: u32,
    sent: Instant,
    told: bool,
    /// It was refused since a journal could not be written, in this run of that robot's machine.
    unwritten: Option<u32>,
    robot: usize,
}

#[derive(Clone)]
enum Kind {
    Init(String),
    Outcome(String),
    /// The task's INIT, and the boot id of the server at that moment.
    Status(String, u32),
    Abort(String, u32),
}

/// A request of a client.
pub(super) struct Asked {
    person: usize,
    kind: Kind,
    envelope: Option<Envelope>,
    body: String,
    /// The endpoint's boot id when the INIT was sent.
    boot: u32,
    /// The endpoint's boot id when it was sent.
    sent_to: u32,
    answered: bool,
}

impl World {
    pub(super) fn act(&mut self, person: usize) {
        if self.calm {
            return;
        }
        let most = if self.weather.replay > 0.0 {
            9000
        } else {
            2500
        };
        let wait = 20 + self.dice.below(most);
        self.after(wait, Event::Act(person));
        let last = self.people[person].last.clone();
        let choice = self.dice.below(10);
        match last {
            Some(last) if !last.told && choice < 4 && self.is_kept(&last) => {
                let elsewhere = self.dice.chance(0.1);
                let endpoint = (last.endpoint + usize::from(elsewhere)) % ENDPOINTS;
                self.ask_outcome(person, &last, endpoint);
            }
            Some(last)
                if choice < 4
                    && last.unwritten == Some(self.robots[last.robot].machine)
                    && self.now.since(last.sent) < Duration::from_secs(10) =>
            {
                let endpoint = self.dice.below(ENDPOINTS as u64) as usize;
                let kind = Kind::Init(last.tag);
                self.send(person, endpoint, kind, Some(last.number), last.body);
            }
            Some(last) if choice < 7 && !last.told || choice == 0 => {
                let runs = self.at(last.endpoint, last.boot).is_some();
                if runs && self.now.since(last.sent) < Duration::from_secs(10) {
                    let kind = Kind::Init(last.tag);
                    let number = Some(last.number);
                    self.send(person, last.endpoint, kind, number, last.body);
                }
            }
            _ if (4..8).contains(&choice) => {
                self.ask_task(person, choice == 4);
            }
            _ => {
                let endpoint = self.dice.below(ENDPOINTS as u64) as usize;
                self.init(person, endpoint);
            }
        }
    }

    /// Whether a client may still ask for its outcome.
    fn is_kept(&self, last: &Last) -> bool {
        self.now.since(last.sent) < Duration::from_secs(50)
    }

    fn init(&mut self, person: usize, endpoint: usize) -> Option<u64> {
        let boot = self.endpoints[endpoint].as_ref()?.boot;
        let robot = self.dice.below(ROBOTS as u64) as usize;
        let scope = SCOPES[self.dice.below(2) as usize];
        let tag = format!("t{}", self.number());
        self.truths.insert(tag.clone(), Truth::default());
        self.figures.inits += 1;
        let body = format!("/{}{scope};1;-1;{tag}", name(robot));
        let number = self.next_number(person);
        if let Some(number) = number {
            self.people[person].last = Some(Last {
                tag: tag.clone(),
                number,
                body: body.clone(),
                endpoint,
                boot,
                sent: self.now,
                told: false,
                unwritten: None,
                robot,
            });
        }
        self.send(person, endpoint, Kind::Init(tag), number, body)
    }

    /// The next number of a client with envelopes.
    fn next_number(&mut self, person: usize) -> Option<u64> {
        if person + 1 == PEOPLE {
            return None;
        }
        if self.people[person].id.is_none() {
            self.people[person].id = Some(self.random_id());
        }
        self.people[person].number += 1;
        Some(self.people[person].number)
    }

    fn ask_outcome(&mut self, person: usize, last: &Last, endpoint: usize) -> Option<u64> {
        let number = self.next_number(person);
        let body = format!("$ztl;2;-1;outcome {}", last.number);
        let kind = Kind::Outcome(last.tag.clone());
        let request = self.send(person, endpoint, kind, number, body)?;
        if let Some(asked) = self.asked.get_mut(&request) {
            asked.boot = last.boot;
        }
        Some(request)
    }

    fn ask_task(&mut self, person: usize, abort: bool) {
        let told = self.truths.iter().filter(|(_, truth)| truth.starts > 0);
        let told: Vec<String> = told.map(|(tag, _)| tag.clone()).collect();
        let nth = self.dice.below(told.len() as u64) as usize;
        let endpoint = self.dice.below(ENDPOINTS as u64) as usize;
        if let Some(tag) = told.get(nth) {
            self.ask_about(person, endpoint, tag, abort);
        }
    }

    fn ask_about(&mut self, person: usize, endpoint: usize, tag: &str, abort: bool) -> Option<u64> {
        let truth = self.truths.get(tag)?;
        let (robot, id) = (truth.robot, truth.id);
        let server = self.robots[robot].server.as_ref();
        let boot = server.map_or(0, |server| server.boot);
        let code = if abort { 3 } else { 2 };
        // Each robot has tasks in both scopes; an id is known in its own only.
        let scope = self.scope_of(tag);
        let body = format!("/{}{scope};{code};{id};", name(robot));
        let kind = match abort {
            true => Kind::Abort(tag.to_owned(), boot),
            false => Kind::Status(tag.to_owned(), boot),
        };
        let number = self.next_number(person);
        self.send(person, endpoint, kind, number, body)
    }

    fn scope_of(&self, tag: &str) -> &'static str {
        let is_it = |asked: &&Asked| matches!(&asked.kind, Kind::Init(known) if known == tag);
        let init = self.asked.values().find(is_it);
        let in_lab = init.is_some_and(|init| init.body.contains("/lab;"));
        if in_lab { "/lab" } else { "/arm" }
    }

    fn send(
        &mut self,
        person: usize,
        endpoint: usize,
        kind: Kind,
        number: Option<u64>,
        body: String,
    ) -> Option<u64> {
        let boot = self.endpoints[endpoint].as_ref()?.boot;
        let request = self.number();
        let client = self.people[person].id;
        let envelope = number.zip(client).map(|(number, client)| Envelope {
            client,
            number,
            early_end: false,
        });
        self.note(|| {
            format!("client {person} request {request} to endpoint {endpoint}: {number:?} {body}")
        });
        let asked = Asked {
            person,
            kind,
            envelope,
            body,
            boot,
            sent_to: boot,
            answered: false,
        };
        self.asked.insert(request, asked);
        for time in self.arrivals().into_iter().take(1) {
            // A connection does not keep it for longer.
            self.after(time.min(5000), Event::ToFleet(endpoint, request));
        }
        Some(request)
    }

    pub(super) fn on_request(&mut self, endpoint: usize, request: u64) {
        let Some(boot) = self.endpoints[endpoint]
            .as_ref()
            .map(|endpoint| endpoint.boot)
        else {
            return;
        };
        let fresh = self.random_id();
        let (Some(at), Some(asked)) = (self.at(endpoint, boot), self.asked.get(&request)) else {
            return;
        };
        if asked.sent_to != boot {
            // Its connection ended.
            return;
        }
        let (envelope, body) = (asked.envelope, asked.body.clone());
        let asked = ClientRequest {
            request,
            envelope,
            fresh,
            body: Some(body.as_bytes()),
        };
        let effects =
            self.with_endpoint(endpoint, |rules| rules.handle_request(at, asked, |_| true));
        self.endpoint_effects(endpoint, effects);
    }

    pub(super) fn on_told(&mut self, request: u64, body: &[u8]) -> Result<(), String> {
        let text = String::from_utf8_lossy(body).into_owned();
        self.note(|| format!("client's request {request}: {text}"));
        let Some(asked) = self.asked.get_mut(&request) else {
            return Ok(());
        };
        asked.answered = true;
        let (person, boot, kind) = (asked.person, asked.boot, asked.kind.clone());
        match kind {
            Kind::Init(tag) | Kind::Outcome(tag) => {
                let said = read(body, boot);
                let last = self.people[person].last.as_mut();
                let last = last.filter(|last| last.tag == tag);
                let is_current = last.is_some() || person + 1 == PEOPLE;
                if !is_current && said == Said::Nothing {
                    // Its client itself has given it up.
                    return Ok(());
                }
                if let Some(last) = last {
                    last.told |= said != Said::Unknown;
                    if said == Said::Nothing && text.contains("journal of the robot's agent") {
                        last.unwritten = Some(self.robots[last.robot].machine);
                    }
                }
                self.figures.told += u64::from(matches!(said, Said::Task(_)));
                self.figures.refused += u64::from(said == Said::Nothing);
                let truth = self.truths.get_mut(&tag).ok_or("no such INIT")?;
                truth.tell(said, body)
            }
            Kind::Status(tag, boot) | Kind::Abort(tag, boot) => {
                let truth = self.truths.get(&tag).ok_or("no such INIT")?;
                let server = self.robots[truth.robot].server.as_ref();
                let now = server.map(|server| server.boot);
                truth.status(body, truth.server == boot && now == Some(boot))
            }
        }
    }

    /// Without faults, everything is answered, and everywhere alike.
    pub(super) fn finish(&mut self) -> Result<(), String> {
        let mut open = Vec::new();
        for person in 0..PEOPLE {
            let last = self.people[person].last.clone();
            if let Some(last) = last.filter(|last| !last.told)
                && self.at(last.endpoint, last.boot).is_some()
                && self.is_kept(&last)
            {
                open.extend(self.ask_outcome(person, &last, last.endpoint));
            }
        }
        self.settle("an outcome", &open)?;
        let mut open = Vec::new();
        for person in 0..PEOPLE {
            open.extend(self.init(person, person % ENDPOINTS));
        }
        self.settle("an INIT", &open)?;
        let tags: Vec<String> = self.truths.keys().cloned().collect();
        let mut open = Vec::new();
        for tag in tags {
            let truth = self.truths.get(&tag).ok_or("no such INIT")?;
            if truth.starts > 0 {
                for endpoint in 0..ENDPOINTS {
                    open.extend(self.ask_about(0, endpoint, &tag, false));
                }
            }
        }
        self.settle("a STATUS", &open)
    }

    fn settle(&mut self, what: &str, open: &[u64]) -> Result<(), String> {
        self.pass(self.now + Duration::from_secs(3))?;
        let is_open = |request: &&u64| self.asked.get(request).is_none_or(|asked| !asked.answered);
        match open.iter().find(is_open) {
            Some(request) => Err(format!(
                "{what} gets no answer although nothing fails (request {request})"
            )),
            None => Ok(()),
        }
    }
}
