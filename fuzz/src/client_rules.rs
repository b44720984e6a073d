//! A client's rules under any replies and timeouts: an answer counts only for the current request, and an INIT is sent
//! once.
//!
//! | line | step |
//! |---|---|
//! | `i`, `s`, `a` | INIT, STATUS or ABORT of task 7, followed by the payload; `I` is an INIT that waits for an early final state |
//! | `p` | a probe |
//! | `o` | the client asks for the outcome of the last INIT |
//! | `!0 $ztl;5;-1;{boot: 4711}` | this reply arrives in the envelope of the last request, `!1` of the one before … |
//! | `~0 /lab;1;7;ok` | the same, in the envelope of another client |
//! | `t2000` | this many milliseconds pass, and the client handles timeouts |

use core::time::Duration;

use ztl_core::client::{Answer, Client, Heard, Late, Server};
use ztl_core::dispatcher::KEEP_INIT;
use ztl_core::envelope::{ClientId, Envelope};
use ztl_core::integer::Integer;
use ztl_core::sink::Sink;
use ztl_core::{Instant, Message, Request};

use crate::script::{number, steps, text};

const TIMEOUT: Duration = Duration::from_secs(2);
const OURS: ClientId = ClientId([7; 16]);
const STRANGER: ClientId = ClientId([8; 16]);

/// Plays a scenario.
pub fn check(script: &[u8]) {
    let mut scenario = Scenario {
        client: Client::new(OURS, TIMEOUT),
        now: Instant::ZERO,
        sent: Vec::new(),
        pending: None,
        triggers: 0,
    };
    for (verb, mut rest) in steps(script) {
        match verb {
            b'I' => scenario.init_to_end(&text(rest)),
            b'i' => scenario.request(Request::Init, &text(rest)),
            b's' => scenario.request(Request::Status, &text(rest)),
            b'a' => scenario.request(Request::Abort, &text(rest)),
            b'p' => scenario.send(Kind::Probe, |client, now, sink| {
                Some(client.probe(now, sink))
            }),
            b'o' => scenario.outcome(),
            b'!' | b'~' => {
                let back = number(&mut rest);
                scenario.reply(back, if verb == b'!' { OURS } else { STRANGER }, rest);
            }
            b't' => scenario.pass(number(&mut rest)),
            _ => {}
        }
        scenario.check_invariants();
    }
}

/// The kind of a request.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Kind {
    Init,
    Other,
    Probe,
    /// About the INIT of this number.
    Outcome(u64),
}

#[derive(Debug, Clone)]
struct Sent {
    number: u64,
    body: Vec<u8>,
    kind: Kind,
    sent: Instant,
    deadline: Instant,
    /// What was known about the server then.
    server: Server,
    answered: bool,
}

struct Scenario {
    client: Client,
    now: Instant,
    sent: Vec<Sent>,
    /// Index of the current request.
    pending: Option<usize>,
    triggers: usize,
}

impl Scenario {
    fn request(&mut self, request: Request, payload: &str) {
        let task = Integer::parse("7")
            .ok()
            .filter(|_| request != Request::Init);
        let kind = if request == Request::Init {
            Kind::Init
        } else {
            Kind::Other
        };
        self.triggers += usize::from(kind == Kind::Init);
        self.send(kind, |client, now, sink| {
            Some(client.request(now, request, "/lab", task, payload, sink))
        });
    }

    fn init_to_end(&mut self, payload: &str) {
        self.triggers += 1;
        self.send(Kind::Init, |client, now, sink| {
            let envelope = client.init_to_end(now, "/lab", payload, sink);
            assert!(envelope.early_end);
            Some(envelope)
        });
    }

    fn outcome(&mut self) {
        // The last INIT, if it was not answered.
        let mut inits = self.sent.iter().filter(|sent| sent.kind == Kind::Init);
        let unanswered = inits.next_back().filter(|init| !init.answered);
        let about = unanswered.map_or(0, |init| init.number);
        self.send(Kind::Outcome(about), |client, now, sink| {
            client.outcome(now, sink)
        });
    }

    /// Sends a request and checks its message.
    fn send(
        &mut self,
        kind: Kind,
        ask: impl FnOnce(&mut Client, Instant, &mut dyn Sink) -> Option<Envelope>,
    ) {
        let mut body = Vec::new();
        let mut sink = |bytes: &[u8]| body.extend_from_slice(bytes);
        let Some(envelope) = ask(&mut self.client, self.now, &mut sink) else {
            assert!(matches!(kind, Kind::Outcome(_)) && body.is_empty());
            return;
        };
        assert_eq!(envelope.client, OURS);
        let last = self.sent.last().map_or(0, |sent| sent.number);
        assert!(envelope.number > last, "a request number is used twice");
        let message = Message::parse(&body).expect("a message");
        let (scope, state, id) = match kind {
            Kind::Init => ("/lab", "1", "-1"),
            Kind::Other => ("/lab", message.state, "7"),
            Kind::Probe | Kind::Outcome(_) => ("$ztl", "2", "-1"),
        };
        assert_eq!(
            (message.scope, message.state, message.id),
            (scope, state, id)
        );
        match kind {
            Kind::Probe => assert_eq!(message.payload, "probe"),
            Kind::Outcome(about) => {
                assert!(about > 0, "no INIT is unanswered");
                assert_eq!(message.payload, format!("outcome {about}"));
            }
            Kind::Other => assert_ne!(message.state, "1", "an unexpected INIT"),
            Kind::Init => {}
        }
        let number = envelope.number;
        self.pending = Some(self.sent.len());
        self.sent.push(Sent {
            number,
            body,
            kind,
            sent: self.now,
            deadline: self.now + TIMEOUT,
            server: self.client.server(),
            answered: false,
        });
    }

    fn reply(&mut self, back: u64, client: ClientId, body: &[u8]) {
        let index = usize::try_from(back)
            .ok()
            .and_then(|back| self.sent.len().checked_sub(1)?.checked_sub(back));
        let Some(index) = index else { return };
        let Sent {
            number,
            kind,
            body: ref asked,
            ..
        } = self.sent[index];
        let heard = self.client.handle_reply(
            Envelope {
                client,
                number,
                early_end: false,
            },
            asked,
            body,
        );
        if client != OURS || self.pending != Some(index) {
            assert_eq!(heard, None, "not the current request");
            return;
        }
        self.pending = None;
        let heard = heard.expect("the answer to the current request");
        match heard {
            Heard::NeverStarted | Heard::OutcomeUnknown => {
                let Kind::Outcome(about) = kind else {
                    panic!("not the answer to an outcome request");
                };
                if heard == Heard::NeverStarted {
                    let mut sent = self.sent.iter();
                    let init = sent.find(|sent| sent.number == about).expect("an INIT");
                    let Server::Ours { boot } = init.server else {
                        panic!("the server was unknown when the INIT was sent");
                    };
                    assert!(
                        self.now <= init.sent + KEEP_INIT,
                        "the server may have dropped the INIT"
                    );
                    let reply = text(body);
                    let (_, boot_id) = reply
                        .rsplit_once("never seen since boot ")
                        .expect("the boot id");
                    let told = Integer::parse(boot_id).expect("a number");
                    assert_eq!(
                        told.value(),
                        Some(i64::from(boot)),
                        "the boot id of another server"
                    );
                }
            }
            Heard::Answer(answer) => {
                self.sent[index].answered = true;
                let message = Message::parse(body).expect("a message");
                assert_eq!(message.payload, answer.text());
                match answer {
                    Answer::Accepted { id, .. } => {
                        assert_eq!(message.number(), Ok(id));
                        assert!(id.is_positive(), "accepted without an id: {}", text(body));
                    }
                    Answer::Rejected { id, .. } => {
                        assert_eq!(message.number(), Ok(id));
                        assert!(!id.is_positive(), "refused with an id: {}", text(body));
                    }
                    Answer::Task { state, .. } | Answer::NotTold { state, .. } => {
                        if matches!(answer, Answer::Task { .. }) && kind == Kind::Other {
                            let seven = Integer::parse("7");
                            assert_eq!((message.scope, message.number()), ("/lab", seven));
                        }
                        let code = message.code().expect("a number").value();
                        assert_eq!(code, Some(i64::from(state.code())));
                    }
                    Answer::UnknownTask { text } => assert!(text.starts_with("Invalid ID")),
                    Answer::UnknownOutcome { text } => {
                        assert!(text.starts_with("unknown: "));
                        assert_eq!(message.code().expect("a number").value(), Some(3));
                    }
                    Answer::OtherTask { scope, id, .. } => {
                        assert_eq!((message.scope, message.id), (scope, id));
                    }
                    Answer::UndefinedState { state, .. } => assert_eq!(message.code(), Ok(state)),
                }
            }
            Heard::Unreadable => {
                let readable = Message::parse(body).is_ok_and(|message| match kind {
                    Kind::Init | Kind::Outcome(_) => message.number().is_ok(),
                    Kind::Other | Kind::Probe => message.code().is_ok(),
                });
                assert!(!readable, "{}", text(body));
            }
        }
    }

    fn pass(&mut self, millis: u64) {
        self.now = self.now + Duration::from_millis(millis.min(10_000));
        let late = self.client.handle_timeout(self.now);
        let pending = self
            .pending
            .filter(|index| self.sent[*index].deadline <= self.now);
        let Some(index) = pending else {
            assert_eq!(late, Late::NotYet);
            return;
        };
        self.pending = None;
        let ours = matches!(self.client.server(), Server::Ours { .. });
        let expected = match self.sent[index].kind {
            Kind::Init if ours => Late::AskOutcome,
            Kind::Outcome(_) => Late::AskOutcome,
            _ => Late::NoAnswer,
        };
        assert_eq!(late, expected);
    }

    fn check_invariants(&self) {
        let inits = self
            .sent
            .iter()
            .filter(|sent| sent.kind == Kind::Init)
            .count();
        assert_eq!(inits, self.triggers, "one INIT for each trigger");
        let deadline = self.pending.map(|index| self.sent[index].deadline);
        assert_eq!(self.client.poll_timeout(), deadline);
    }
}
