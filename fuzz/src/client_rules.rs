//! A client's rules under any replies and silences: an answer counts only for the request that is
//! under way, and an INIT is sent once.
//!
//! | line | step |
//! |---|---|
//! | `i`, `s`, `a` | INIT, STATUS or ABORT of task 7, its payload behind it; `I` is an INIT that waits for a quick end |
//! | `p` | a probe |
//! | `o` | what became of the last INIT? |
//! | `!0 $ztl;5;-1;{boot: 4711}` | this reply comes in the envelope of the last request, `!1` of the one before … |
//! | `~0 /lab;1;7;ok` | the same, but of a stranger |
//! | `t2000` | so many milliseconds pass, and the client looks at the clock |

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
    let mut desk = Desk {
        client: Client::new(OURS, TIMEOUT),
        now: Instant::ZERO,
        sent: Vec::new(),
        pending: None,
        triggers: 0,
    };
    for (verb, mut rest) in steps(script) {
        match verb {
            b'I' => desk.init_to_end(&text(rest)),
            b'i' => desk.request(Request::Init, &text(rest)),
            b's' => desk.request(Request::Status, &text(rest)),
            b'a' => desk.request(Request::Abort, &text(rest)),
            b'p' => desk.send(Kind::Probe, |client, now, sink| {
                Some(client.probe(now, sink))
            }),
            b'o' => desk.outcome(),
            b'!' | b'~' => {
                let back = number(&mut rest);
                desk.reply(back, if verb == b'!' { OURS } else { STRANGER }, rest);
            }
            b't' => desk.pass(number(&mut rest)),
            _ => {}
        }
        desk.assert_still_sane();
    }
}

/// What a request is, as its body says.
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
    /// What was known of the server then.
    server: Server,
    answered: bool,
}

struct Desk {
    client: Client,
    now: Instant,
    sent: Vec<Sent>,
    /// Place of the request that is under way.
    pending: Option<usize>,
    triggers: usize,
}

impl Desk {
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

    /// Asks, and looks at what is to be sent.
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
        assert!(envelope.number > last, "a number is used twice");
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
            Kind::Other => assert_ne!(message.state, "1", "an INIT that nobody asked for"),
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
        let place = usize::try_from(back)
            .ok()
            .and_then(|back| self.sent.len().checked_sub(1)?.checked_sub(back));
        let Some(place) = place else { return };
        let Sent {
            number,
            kind,
            body: ref asked,
            ..
        } = self.sent[place];
        let heard = self.client.handle_reply(
            Envelope {
                client,
                number,
                early_end: false,
            },
            asked,
            body,
        );
        if client != OURS || self.pending != Some(place) {
            assert_eq!(heard, None, "not the request that is under way");
            return;
        }
        self.pending = None;
        let heard = heard.expect("the answer to the request that is under way");
        match heard {
            Heard::NeverStarted | Heard::FateUnknown => {
                let Kind::Outcome(about) = kind else {
                    panic!("nobody asked for it");
                };
                if heard == Heard::NeverStarted {
                    let mut sent = self.sent.iter();
                    let init = sent.find(|sent| sent.number == about).expect("an INIT");
                    let Server::Ours { boot } = init.server else {
                        panic!("a server that was not known to the INIT said so");
                    };
                    assert!(self.now <= init.sent + KEEP_INIT, "it may have forgotten");
                    let said = text(body);
                    let (_, said) = said
                        .rsplit_once("never seen since boot ")
                        .expect("these words");
                    let said = Integer::parse(said).expect("a number");
                    assert_eq!(said.value(), Some(i64::from(boot)), "another server's word");
                }
            }
            Heard::Answer(answer) => {
                self.sent[place].answered = true;
                let message = Message::parse(body).expect("a message");
                assert_eq!(message.payload, answer.text());
                match answer {
                    Answer::Accepted { id, .. } => {
                        assert_eq!(message.number(), Ok(id));
                        assert!(id.is_positive(), "accepted without an id: {}", text(body));
                    }
                    Answer::Refused { id, .. } => {
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
                    Answer::UnknownEnd { text } => {
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
            .filter(|place| self.sent[*place].deadline <= self.now);
        let Some(place) = pending else {
            assert_eq!(late, Late::NotYet);
            return;
        };
        self.pending = None;
        let ours = matches!(self.client.server(), Server::Ours { .. });
        let expected = match self.sent[place].kind {
            Kind::Init if ours => Late::AskOutcome,
            Kind::Outcome(_) => Late::AskOutcome,
            _ => Late::NoAnswer,
        };
        assert_eq!(late, expected);
    }

    fn assert_still_sane(&self) {
        let inits = self
            .sent
            .iter()
            .filter(|sent| sent.kind == Kind::Init)
            .count();
        assert_eq!(inits, self.triggers, "one INIT for each trigger");
        let deadline = self.pending.map(|place| self.sent[place].deadline);
        assert_eq!(self.client.poll_timeout(), deadline);
    }
}
