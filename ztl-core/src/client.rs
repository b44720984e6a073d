//! A client's rules: which answer is whose, and what no answer means.
//!
//! One request is under way at a time. An INIT is never sent again: when its answer does not come,
//! the client asks `outcome`, and learns from the server what the answer was, or that the INIT never
//! came and never will count. Where it cannot learn that (the original's server, a server that was
//! started anew, no server), the INIT's fate is *unknown*, which is told as such and never as a
//! state.
//!
//! ```
//! use core::time::Duration;
//! use ztl_core::client::{Answer, Client, Heard};
//! use ztl_core::envelope::ClientId;
//! use ztl_core::integer::Integer;
//! use ztl_core::{Instant, Request};
//!
//! let mut client = Client::new(ClientId([7; 16]), Duration::from_secs(2));
//! let now = Instant::ZERO;
//! let mut body = Vec::new();
//! let mut sink = |bytes: &[u8]| body.extend_from_slice(bytes);
//! let envelope = client.request(now, Request::Init, "/lab", None, "open", &mut sink);
//! // Send the envelope's two frames, an empty one, and the body …
//! assert_eq!(body, b"/lab;1;-1;open");
//!
//! // … the answer comes back in the same envelope.
//! let id = Integer::parse("7").expect("a number");
//! let answer = Answer::Accepted { id, ended: None, text: "opening" };
//! let heard = client.handle_reply(envelope, &body, b"/lab;1;7;opening");
//! assert_eq!(heard, Some(Heard::Answer(answer)));
//! assert!(client.handle_reply(envelope, &body, b"/lab;1;7;opening").is_none(), "only once");
//! ```

mod answer;

use core::time::Duration;

use crate::Instant;
use crate::dispatcher::KEEP_INIT;
use crate::envelope::{ClientId, Envelope};
use crate::integer::Integer;
use crate::lifecycle::{Request, State};
use crate::message::Message;
use crate::reply::{NEVER_SEEN, RESERVED_SCOPE};
use crate::sink::{Sink, put_decimal};

pub use answer::Answer;

/// What a client knows of the server at the other end of its connection.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Server {
    /// Not asked yet.
    Unknown,
    /// The original, or another that does not know `$ztl`.
    Original,
    /// Ours.
    Ours {
        /// Differs from start to start of the server.
        boot: u32,
    },
}

/// What an arriving reply means.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Heard<'a> {
    /// The answer to the request under way; for an INIT also when it was learnt by `outcome`.
    Answer(Answer<'a>),
    /// The server says that the INIT never came, and it will refuse it if it still does.
    NeverStarted,
    /// The server cannot say what became of the INIT: it may run.
    FateUnknown,
    /// The answer is not a ZTL message. It answers the request all the same: an INIT may have started
    /// its task.
    Unreadable,
}

/// What it means that no answer has come in time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Late {
    /// The time has not passed, or nothing is under way.
    NotYet,
    /// Nobody knows what the server did. For STATUS and ABORT: ask again. For an INIT: it may run.
    NoAnswer,
    /// An INIT: drop the connection, open another, and send the body that
    /// [`Client::outcome`] writes.
    AskOutcome,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Pending {
    number: u64,
    request: Request,
    /// The INIT whose outcome is asked for.
    outcome_of: Option<u64>,
    probe: bool,
    deadline: Instant,
}

/// A client of any number of scopes of one server, without I/O.
///
/// *Commands*: [`request`](Self::request), [`probe`](Self::probe), [`outcome`](Self::outcome), each
/// writes a body and returns the envelope to send it in. *Inputs*:
/// [`handle_reply`](Self::handle_reply), [`handle_timeout`](Self::handle_timeout). *Next wake-up*:
/// [`poll_timeout`](Self::poll_timeout).
#[derive(Debug)]
pub struct Client {
    id: ClientId,
    number: u64,
    timeout: Duration,
    server: Server,
    longest: Option<u32>,
    pending: Option<Pending>,
    unanswered: Option<Unanswered>,
}

/// The last INIT, as long as its answer is not known.
#[derive(Debug, Clone, Copy)]
struct Unanswered {
    number: u64,
    sent: Instant,
    /// What was known of the server when it was sent: only this start of it can say that it never
    /// came.
    server: Server,
}

/// How long after an INIT it makes sense to ask for its outcome: a server may have forgotten it
/// later, and would say that it never came. The rest of its minute is for the question's way.
const ASK_WITHIN: Duration = Duration::from_secs(KEEP_INIT.as_secs() - 10);

impl Client {
    /// A client with a random id, whose requests are answered within `timeout` or not at all.
    #[must_use]
    pub const fn new(id: ClientId, timeout: Duration) -> Self {
        Self {
            id,
            number: 0,
            timeout,
            server: Server::Unknown,
            longest: None,
            pending: None,
            unanswered: None,
        }
    }

    /// Sets the longest time for an answer.
    pub const fn set_timeout(&mut self, timeout: Duration) {
        self.timeout = timeout;
    }

    /// Begins a request, about a task or with the INIT's id, and writes its body. A request that
    /// was under way is given up.
    pub fn request(
        &mut self,
        now: Instant,
        request: Request,
        scope: &str,
        task: Option<Integer<'_>>,
        payload: &str,
        sink: &mut (impl Sink + ?Sized),
    ) -> Envelope {
        sink.put(scope.as_bytes());
        sink.put(b";");
        put_decimal(sink, u32::from(request.code()));
        sink.put(b";");
        match task {
            Some(task) => task.put(sink),
            None => Integer::MINUS_ONE.put(sink),
        }
        sink.put(b";");
        sink.put(payload.as_bytes());
        self.begin(now, request, None, false)
    }

    /// Begins an INIT as [`request`](Self::request) does; if its task ends within a moment, a server
    /// of ours tells that in place of the handler's reply.
    pub fn init_to_end(
        &mut self,
        now: Instant,
        scope: &str,
        payload: &str,
        sink: &mut (impl Sink + ?Sized),
    ) -> Envelope {
        let envelope = self.request(now, Request::Init, scope, None, payload, sink);
        Envelope {
            early_end: true,
            ..envelope
        }
    }

    /// Asks who the server is. Once per connection is enough.
    pub fn probe(&mut self, now: Instant, sink: &mut (impl Sink + ?Sized)) -> Envelope {
        put_reserved("probe", sink);
        self.begin(now, Request::Status, None, true)
    }

    /// Asks the server something about itself that is not the protocol's own, as `tasks`.
    pub fn ask(
        &mut self,
        now: Instant,
        question: &str,
        sink: &mut (impl Sink + ?Sized),
    ) -> Envelope {
        put_reserved(question, sink);
        self.begin(now, Request::Status, None, false)
    }

    /// Asks what became of the last INIT, if its answer is not known: it is late, or still under way,
    /// or was given up for another request. `None` when it was answered, or was sent so long ago
    /// that nobody can know: its fate stays unknown. An earlier INIT cannot be asked about: the
    /// last one settled it.
    pub fn outcome(&mut self, now: Instant, sink: &mut (impl Sink + ?Sized)) -> Option<Envelope> {
        let Unanswered { number, sent, .. } = self.unanswered?;
        if now > sent + ASK_WITHIN {
            self.unanswered = None;
            return None;
        }
        put_reserved("outcome ", sink);
        put_u64(number, sink);
        let envelope = self.begin(now, Request::Init, Some(number), false);
        if let Some(pending) = &mut self.pending {
            // Later the server may have forgotten the INIT, and its word counts no more.
            pending.deadline = pending.deadline.min(sent + KEEP_INIT);
        }
        Some(envelope)
    }

    /// A reply has arrived in this envelope, in which `asked` was sent. `None` when it answers nothing
    /// that is under way: it is late, or somebody else's. Late is what comes after [`handle_timeout`](Self::handle_timeout):
    /// call that first, if the time may have come to which [`poll_timeout`](Self::poll_timeout) points.
    pub fn handle_reply<'a>(
        &mut self,
        envelope: Envelope,
        asked: &[u8],
        body: &'a [u8],
    ) -> Option<Heard<'a>> {
        let answers = |pending: &mut Pending| pending.number == envelope.number;
        if envelope.client != self.id {
            return None;
        }
        let pending = self.pending.take_if(answers)?;
        let read = || {
            let (asked, message) = (Message::parse(asked).ok()?, Message::parse(body).ok()?);
            let answer = Answer::of(pending.request, &asked, &message)?;
            Some((message.scope, answer))
        };
        let Some((scope, answer)) = read() else {
            return Some(Heard::Unreadable);
        };
        if pending.probe {
            self.server = server(&answer);
            self.longest = longest(&answer, self.server);
        }
        if pending.outcome_of.is_some() {
            return Some(self.on_outcome(scope, answer));
        }
        if pending.request == Request::Init {
            self.unanswered = None;
        }
        Some(Heard::Answer(answer))
    }

    /// The time has come to which [`poll_timeout`](Self::poll_timeout) pointed.
    pub fn handle_timeout(&mut self, now: Instant) -> Late {
        let Some(pending) = self.pending.take_if(|pending| now >= pending.deadline) else {
            return Late::NotYet;
        };
        match (pending.request, pending.outcome_of) {
            (Request::Init, None) => match self.server {
                Server::Ours { .. } => Late::AskOutcome,
                // The original would not know, and an unknown one could have been started anew.
                Server::Original | Server::Unknown => Late::NoAnswer,
            },
            // Asked again, over another connection.
            (_, Some(_)) => Late::AskOutcome,
            _ => Late::NoAnswer,
        }
    }

    /// When the request under way is given up.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Instant> {
        self.pending.map(|pending| pending.deadline)
    }

    /// What is known of the server.
    #[must_use]
    pub const fn server(&self) -> Server {
        self.server
    }

    /// The longest message that the server takes, in bytes: a longer one ends the connection, and is not to
    /// be sent. `None` where it tells none, as the original, which takes any.
    #[must_use]
    pub const fn longest_message(&self) -> Option<u32> {
        self.longest
    }

    fn begin(
        &mut self,
        now: Instant,
        request: Request,
        outcome_of: Option<u64>,
        probe: bool,
    ) -> Envelope {
        self.number = self.number.saturating_add(1);
        let number = self.number;
        if request == Request::Init && outcome_of.is_none() {
            self.unanswered = Some(Unanswered {
                number,
                sent: now,
                server: self.server,
            });
        }
        self.pending = Some(Pending {
            number,
            request,
            outcome_of,
            probe,
            deadline: now + self.timeout,
        });
        Envelope {
            client: self.id,
            number,
            early_end: false,
        }
    }

    fn on_outcome<'a>(&mut self, scope: &str, answer: Answer<'a>) -> Heard<'a> {
        // The original refuses the reserved scope, with an id that ours would give to a refused
        // INIT.
        if scope != RESERVED_SCOPE || self.server == Server::Original {
            return Heard::FateUnknown;
        }
        if let Answer::Refused { id, text } = answer
            && id == Integer::ZERO
            && let Some(boot) = text.strip_prefix(NEVER_SEEN)
        {
            let asked = self.unanswered.take().map(|init| init.server);
            let boot = Integer::parse(boot).ok().and_then(Integer::value);
            // Another boot id than when it was sent: the server that may have seen it is gone.
            return match asked {
                Some(Server::Ours { boot: known }) if boot == Some(i64::from(known)) => {
                    Heard::NeverStarted
                }
                _ => Heard::FateUnknown,
            };
        }
        // It cannot say; an answer about the INIT has another id.
        if let Answer::Refused { id, text } = answer
            && (id == Integer::ZERO || text.starts_with("No controller for scope"))
        {
            return Heard::FateUnknown;
        }
        self.unanswered = None;
        Heard::Answer(answer)
    }
}

fn put_reserved(payload: &str, sink: &mut (impl Sink + ?Sized)) {
    sink.put(RESERVED_SCOPE.as_bytes());
    sink.put(b";2;-1;");
    sink.put(payload.as_bytes());
}

fn put_u64(number: u64, sink: &mut (impl Sink + ?Sized)) {
    const BILLION: u64 = 1_000_000_000;
    if number >= BILLION {
        put_u64(number / BILLION, sink);
        // The rest with its leading zeros.
        let mut digits = [b'0'; 9];
        let mut rest = number % BILLION;
        for digit in digits.iter_mut().rev() {
            *digit = b'0' + (rest % 10) as u8;
            rest /= 10;
        }
        sink.put(&digits);
    } else {
        put_decimal(sink, number as u32);
    }
}

/// Who answered a probe so.
fn server(answer: &Answer<'_>) -> Server {
    let boot = match answer {
        Answer::Task {
            state: State::Completed,
            text,
        } => number_after(text, b"boot: "),
        _ => None,
    };
    boot.map_or(Server::Original, |boot| Server::Ours { boot })
}

/// What a server of ours tells of the longest message that it takes, before its scopes: their names could
/// read like that, too.
fn longest(answer: &Answer<'_>, server: Server) -> Option<u32> {
    if !matches!(server, Server::Ours { .. }) {
        return None;
    }
    let text = answer.text();
    let end = position(text, b"scopes: ").unwrap_or(text.len());
    number_after(text.get(..end)?, b"message: ")
}

fn number_after<const N: usize>(text: &str, key: &[u8; N]) -> Option<u32> {
    let rest = text.get(position(text, key)? + N..)?;
    let end = rest.bytes().position(|byte| matches!(byte, b',' | b'}'));
    let digits = rest.get(..end.unwrap_or(rest.len()))?;
    let number = Integer::parse(digits).ok().and_then(Integer::value)?;
    u32::try_from(number).ok()
}

/// Where it stands first. By bytes, since of `str::find` the compiler cannot see that it never panics.
fn position<const N: usize>(text: &str, key: &[u8; N]) -> Option<usize> {
    let mut windows = text.as_bytes().windows(N);
    windows.position(|window| window == key)
}

#[cfg(test)]
mod tests;
