//! The rules of a client: which request a reply answers, and what a missing reply means.
//!
//! One request is pending at a time. An INIT is never sent again. If its reply is missing, the client asks for its
//! `outcome`: the server repeats the reply, or declares that the INIT never arrived and is void. If the client cannot
//! learn that (the original's server, a restarted server, no server), the outcome is *unknown* and is reported as such,
//! never as a state.
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
//! // Send the two frames of the envelope, an empty frame, and the body …
//! assert_eq!(body, b"/lab;1;-1;open");
//!
//! // … the reply arrives in the same envelope.
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

pub use answer::{Answer, is_abort_rejected, is_no_scope, is_unknown_outcome};

/// What a client knows about its server.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Server {
    /// Not probed yet.
    Unknown,
    /// The original, or another server without `$ztl`.
    Original,
    /// Our server.
    Ours {
        /// Changes with each start of the server.
        boot: u32,
    },
}

/// What an arriving reply means.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Heard<'a> {
    /// The answer to the pending request, or to an INIT whose outcome was asked for.
    Answer(Answer<'a>),
    /// The INIT never arrived, and the server will reject it if it still does.
    NeverStarted,
    /// The server does not know the outcome of the INIT: its task may run.
    OutcomeUnknown,
    /// The reply is not a ZTL message. It still answers the request: an INIT may have started its task.
    Unreadable,
}

/// What a missing reply means.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Late {
    /// The timeout has not passed, or no request is pending.
    NotYet,
    /// It is unknown what the server did. Repeat STATUS and ABORT; the task of an INIT may run.
    NoAnswer,
    /// For an INIT: drop the connection, open another, and send the body of [`Client::outcome`].
    AskOutcome,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Pending {
    number: u64,
    request: Request,
    /// The INIT whose outcome is requested.
    outcome_of: Option<u64>,
    probe: bool,
    deadline: Instant,
}

/// A client of any number of scopes of one server, without I/O.
///
/// *Commands*: [`request`](Self::request), [`probe`](Self::probe), [`outcome`](Self::outcome); each
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

/// The last INIT, while its reply is unknown.
#[derive(Debug, Clone, Copy)]
struct Unanswered {
    number: u64,
    sent: Instant,
    /// What was known about the server when the INIT was sent. Only that server can know that it never arrived.
    server: Server,
}

/// How long after an INIT the client may ask for its outcome. Later a server may have dropped the record, and would report
/// that the INIT never arrived. The rest of the minute is for the request's transfer.
const ASK_WITHIN: Duration = Duration::from_secs(KEEP_INIT.as_secs() - 10);

impl Client {
    /// A client with a random id, whose requests time out after `timeout`.
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

    /// Sets the timeout of requests.
    pub const fn set_timeout(&mut self, timeout: Duration) {
        self.timeout = timeout;
    }

    /// Starts a request about `task`, or with the id of an INIT, and writes its body. Gives up the pending request.
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

    /// Starts an INIT like [`request`](Self::request). If its task ends almost immediately, our servers reply with the
    /// outcome instead of the handler's reply.
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

    /// Asks for the identity of the server. Once per connection is enough.
    pub fn probe(&mut self, now: Instant, sink: &mut (impl Sink + ?Sized)) -> Envelope {
        put_reserved("probe", sink);
        self.begin(now, Request::Status, None, true)
    }

    /// Asks the reserved scope a question that is not part of the protocol, such as `tasks`.
    pub fn ask(
        &mut self,
        now: Instant,
        question: &str,
        sink: &mut (impl Sink + ?Sized),
    ) -> Envelope {
        put_reserved(question, sink);
        self.begin(now, Request::Status, None, false)
    }

    /// Asks for the outcome of the last INIT, if its reply is unknown: late, pending, or given up for another request.
    /// `None` if it was answered, or was sent so long ago that its outcome stays unknown. The outcome of an earlier INIT
    /// cannot be requested, because a later INIT settles it.
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
            // Later the server may have dropped the record, and its answer would mean nothing.
            pending.deadline = pending.deadline.min(sent + KEEP_INIT);
        }
        Some(envelope)
    }

    /// Handles a reply in this envelope, in which `asked` was sent. `None` if it does not answer the pending request: it is
    /// late, or for another client. A reply is late after [`handle_timeout`](Self::handle_timeout); call that first if
    /// [`poll_timeout`](Self::poll_timeout) may have passed.
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

    /// Call this when [`poll_timeout`](Self::poll_timeout) has passed.
    pub fn handle_timeout(&mut self, now: Instant) -> Late {
        match self.pending {
            Some(pending) if now >= pending.deadline => self.give_up(),
            _ => Late::NotYet,
        }
    }

    /// Gives up the pending request: its reply is not waited for any more. Returns what [`handle_timeout`](Self::handle_timeout)
    /// returns at its time.
    pub fn give_up(&mut self) -> Late {
        let Some(pending) = self.pending.take() else {
            return Late::NotYet;
        };
        match (pending.request, pending.outcome_of) {
            (Request::Init, None) => match self.server {
                Server::Ours { .. } => Late::AskOutcome,
                // The original does not know outcomes, and an unknown server may have restarted.
                Server::Original | Server::Unknown => Late::NoAnswer,
            },
            // Asks again, over another connection.
            (_, Some(_)) => Late::AskOutcome,
            _ => Late::NoAnswer,
        }
    }

    /// When the pending request times out.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Instant> {
        self.pending.map(|pending| pending.deadline)
    }

    /// What is known about the server.
    #[must_use]
    pub const fn server(&self) -> Server {
        self.server
    }

    /// The longest message that the server accepts, in bytes. Do not send a longer one: the server would close the
    /// connection. `None` if the server reports no limit, like the original.
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
        // The original rejects the reserved scope with the id that our servers give a rejected INIT.
        if scope != RESERVED_SCOPE || self.server == Server::Original {
            return Heard::OutcomeUnknown;
        }
        if let Answer::Rejected { id, text } = answer
            && id == Integer::ZERO
            && let Some(boot) = text.strip_prefix(NEVER_SEEN)
        {
            let asked = self.unanswered.take().map(|init| init.server);
            let boot = Integer::parse(boot).ok().and_then(Integer::value);
            // With another boot id, the server that may have received the INIT is gone.
            return match asked {
                Some(Server::Ours { boot: known }) if boot == Some(i64::from(known)) => {
                    Heard::NeverStarted
                }
                _ => Heard::OutcomeUnknown,
            };
        }
        // The server does not know; an answer about the INIT has another id.
        if let Answer::Rejected { id, text } = answer
            && (id == Integer::ZERO || is_no_scope(State::Rejected, text))
        {
            return Heard::OutcomeUnknown;
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
        // The last nine digits, with leading zeros.
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

/// The server that sent this answer to a probe.
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

/// The longest message that our server accepts. It is written before the scopes, whose names could contain the same text.
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

/// Position of the first match. By bytes, because the compiler cannot remove the panic branch of `str::find`.
fn position<const N: usize>(text: &str, key: &[u8; N]) -> Option<usize> {
    let mut windows = text.as_bytes().windows(N);
    windows.position(|window| window == key)
}

#[cfg(test)]
mod tests;
