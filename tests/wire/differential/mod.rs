//! The same bytes go to our ZMTP and to libzmq: both do the same, except for the differences that `docs/zmtp.md` lists.
//!
//! Each stream is sent whole, and in two pieces, cut at each byte. No test here waits for time. A *fence* is a
//! request on another connection of the same server: when it is answered, the server has read what was sent before.

mod cases;
mod differences;

use std::collections::BTreeSet;
use std::io::{ErrorKind, Read, Write};
use std::net::{Shutdown, TcpStream};
use std::time::Instant;

use ztl_std::{Limits, RunningServer, TaskServer, Transport};
use ztl_tests::lab::{PATIENCE, SCOPE, port_of, shake_hands};

use self::cases::{Case, MOST, NUMBER, STATUS, greeting, handshakes, named, silent, traffic};
use self::differences::{
    ANSWER, DIFFERENCES, END, IDENTITY, SERVED, TIME_TO_LIVE, TOGETHER_WITH_READY,
};
use crate::socket::Echo;

/// How many connections are open at a time.
const TOGETHER: usize = 50;

/// A server, with a connection for fences.
struct TestServer {
    _server: RunningServer,
    port: u16,
    fence: TcpStream,
}

impl TestServer {
    fn new(transport: Transport) -> Self {
        let mut limits = Limits::default();
        limits.message = MOST;
        // A test may be stopped for a while by a busy machine.
        limits.handshake = 3 * PATIENCE;
        let builder = TaskServer::builder().transport(transport).limits(limits);
        let mut server = builder.bind("tcp://127.0.0.1:*").expect("a port");
        server.register(SCOPE, Echo);
        let server = server.spawn().expect("a thread");
        let port = port_of(server.endpoint());
        let fence = shake_hands(port);
        fence.set_nodelay(true).expect("an option");
        Self {
            _server: server,
            port,
            fence,
        }
    }

    /// Waits until all that was sent before has been read, and what it causes was sent.
    fn fence(&self) {
        for _ in 0..2 {
            let mut answer = [0xA5; 30];
            (&self.fence).write_all(STATUS).expect("to write");
            (&self.fence).read_exact(&mut answer).expect("an answer");
            assert_eq!(&answer[4..], b"/test;2;99;Invalid ID '99'");
        }
    }

    fn connect(&self) -> Attempt {
        let mut stream = TcpStream::connect(("127.0.0.1", self.port)).expect("a connection");
        stream.set_nodelay(true).expect("an option");
        stream.set_read_timeout(Some(PATIENCE)).expect("a time");
        // It is accepted once its signature comes.
        let mut heard = vec![0; 10];
        stream.read_exact(&mut heard).expect("a signature");
        stream.set_nonblocking(true).expect("an option");
        Attempt {
            stream,
            heard,
            is_closed: false,
        }
    }

    /// What happens to these streams, each cut at one place. Waits until all outcomes are as expected.
    fn run(&self, jobs: &[(&Case, usize)], expected: &[&String]) -> Vec<String> {
        let mut attempts = self.start(jobs);
        self.outcomes(&mut attempts, jobs, expected)
    }

    /// Sends these streams, each cut at one place.
    fn start(&self, jobs: &[(&Case, usize)]) -> Vec<Attempt> {
        let mut attempts: Vec<Attempt> = jobs.iter().map(|_| self.connect()).collect();
        for place in 0..4 {
            for (attempt, (case, cut)) in attempts.iter_mut().zip(jobs) {
                let hello = attempt.named(&case.hello);
                let then = cut.saturating_sub(hello.len());
                let (hello, rest) = hello.split_at(hello.len().min(*cut));
                let (begin, end) = case.then.split_at(then);
                attempt.write([hello, rest, begin, end][place]);
            }
            self.fence();
        }
        attempts
    }

    /// What comes back. Waits until all outcomes are as expected.
    fn outcomes(
        &self,
        attempts: &mut [Attempt],
        jobs: &[(&Case, usize)],
        expected: &[&String],
    ) -> Vec<String> {
        let start = Instant::now();
        loop {
            let outcomes = attempts.iter_mut().zip(jobs);
            let outcomes = outcomes.map(|(attempt, (case, _))| attempt.outcome(case));
            let outcomes: Vec<_> = outcomes.collect();
            let is_expected = outcomes
                .iter()
                .zip(expected)
                .all(|(one, other)| one == *other);
            // libzmq's threads may be late.
            if is_expected || start.elapsed() > PATIENCE {
                return outcomes;
            }
            self.fence();
        }
    }
}

/// A connection.
struct Attempt {
    stream: TcpStream,
    heard: Vec<u8>,
    is_closed: bool,
}

impl Attempt {
    /// With an identity of its own.
    fn named(&self, bytes: &[u8]) -> Vec<u8> {
        let mut bytes = bytes.to_vec();
        let place = bytes.windows(NUMBER.len()).position(|at| at == NUMBER);
        if let Some(place) = place {
            let port = self.stream.local_addr().expect("an address").port();
            let name = format!("name {port:05}");
            bytes[place..place + NUMBER.len()].copy_from_slice(name.as_bytes());
        }
        bytes
    }

    /// Sends a piece, unless the server has closed the connection.
    fn write(&mut self, bytes: &[u8]) {
        // A few hundred bytes always fit the system's buffer.
        let _ = self.stream.write_all(bytes);
    }

    /// What has come back so far.
    fn outcome(&mut self, case: &Case) -> String {
        let mut piece = [0; 4096];
        while !self.is_closed {
            match self.stream.read(&mut piece) {
                Ok(0) => self.is_closed = true,
                Ok(count) => self.heard.extend(&piece[..count]),
                Err(error) if error.kind() == ErrorKind::WouldBlock => break,
                Err(_) => self.is_closed = true,
            }
        }
        shown(&self.heard, self.is_closed, case.met)
    }
}

/// A connection as text. What the server sends before the handshake is complete may overtake the client's, so without
/// a complete handshake, `READY` counts as not sent, and nor does the greeting of a connection that is closed.
fn shown(heard: &[u8], is_closed: bool, met: bool) -> String {
    let mut parts = Vec::new();
    let mut rest = match heard {
        [0xFF, _, _, _, _, _, _, _, _, 0x7F, 3, 1, ..] if heard.len() >= 64 => {
            assert_eq!(&heard[12..16], b"NULL");
            assert_eq!(&heard[16..64], [0; 48]);
            parts.push("3.1".to_owned());
            &heard[64..]
        }
        [0xFF, _, _, _, _, _, _, _, _, 0x7F, 3, 6, rest @ ..] => {
            parts.push("2.0 ROUTER".to_owned());
            rest
        }
        [0xFF, _, _, _, _, _, _, _, _, 0x7F] | [0xFF, _, _, _, _, _, _, _, _, 0x7F, 3] => &[],
        [0xFF, _, _, _, _, _, _, _, _, 0x7F, rest @ ..] => rest,
        _ => panic!("no signature: {}", heard.escape_ascii()),
    };
    while let Some((flags, body, after)) = split(rest) {
        rest = after;
        parts.push(match (flags, body) {
            (4, [5, b'R', b'E', b'A', b'D', b'Y', ..]) => "READY".to_owned(),
            _ if body.len() > 40 => format!("{flags}[{}]", body.len()),
            _ => format!("{flags}'{}'", String::from_utf8_lossy(body)),
        });
    }
    if !rest.is_empty() {
        parts.push(format!("+{}", rest.escape_ascii()));
    }
    if !met && parts.last().is_some_and(|last| last == "READY") {
        parts.pop();
    }
    if is_closed && !met && parts.last().is_some_and(|last| last == "3.1") {
        parts.pop();
    }
    parts.push(if is_closed { "closed" } else { "open" }.to_owned());
    let parts = parts.chunk_by(|one, other| one == other);
    let parts = parts.map(|same| match same {
        [one] => one.clone(),
        _ => format!("{}*{}", same.len(), same[0]),
    });
    parts.collect::<Vec<_>>().join(" ")
}

/// The flags without LONG, the body, and what follows.
fn split(bytes: &[u8]) -> Option<(u8, &[u8], &[u8])> {
    let (flags, rest) = bytes.split_first()?;
    let (size, rest) = match flags & 2 {
        0 => rest
            .split_first()
            .map(|(size, rest)| (u64::from(*size), rest))?,
        _ => {
            let (size, rest) = rest.split_first_chunk()?;
            (u64::from_be_bytes(*size), rest)
        }
    };
    let (body, rest) = rest.split_at_checked(usize::try_from(size).ok()?)?;
    Some((flags & !2, body, rest))
}

fn all_cases() -> Vec<Case> {
    let cases: Vec<Case> = handshakes().into_iter().chain(traffic()).collect();
    let names: BTreeSet<_> = cases.iter().map(|case| case.name).collect();
    assert_eq!(names.len(), cases.len(), "a name is used twice");
    cases
}

/// How often both must have agreed in a row: on a busy machine, the system may deliver a fence before older bytes of
/// other connections.
const AGREED: usize = 3;

/// What each case shall do: what ours does, and libzmq. Where no difference is listed, it is what both agree on.
fn expected(cases: &[Case], native: &TestServer, libzmq: &TestServer) -> Vec<[String; 2]> {
    let listed = |case: &Case| {
        let shown = DIFFERENCES.iter().flat_map(|difference| difference.shown);
        let mut shown = shown.filter(|(name, _, _)| *name == case.name);
        let found = shown.next()?;
        assert!(shown.next().is_none(), "{} is listed twice", case.name);
        let both = [found.2, found.1].map(|text| text.replace("ANSWER", ANSWER));
        assert_ne!(both[0], both[1], "{}: no difference", case.name);
        Some(both)
    };
    let both = cases.chunks(TOGETHER).flat_map(|chunk| {
        let listed: Vec<_> = chunk.iter().map(listed).collect();
        let agreed = agreed(chunk, &listed, native, libzmq);
        let both = listed.into_iter().zip(agreed);
        both.map(|(listed, agreed)| listed.unwrap_or_else(|| [agreed.clone(), agreed]))
    });
    both.collect()
}

/// What both do with these streams, whole. If they do not agree where no difference is listed, what ours does.
fn agreed(
    cases: &[Case],
    listed: &[Option<[String; 2]>],
    native: &TestServer,
    libzmq: &TestServer,
) -> Vec<String> {
    let jobs: Vec<_> = cases.iter().map(|case| (case, 0)).collect();
    let mut sides = [native, libzmq].map(|server| server.start(&jobs));
    let start = Instant::now();
    let mut times = 0;
    loop {
        let [ours, theirs] = sides.each_mut().map(|attempts| {
            let outcomes = attempts.iter_mut().zip(cases);
            let outcomes = outcomes.map(|(attempt, case)| attempt.outcome(case));
            outcomes.collect::<Vec<_>>()
        });
        let outcomes = ours.iter().zip(&theirs).zip(listed);
        let mut unlisted = outcomes.filter(|(_, listed)| listed.is_none());
        times = if unlisted.all(|((ours, theirs), _)| ours == theirs) {
            times + 1
        } else {
            0
        };
        if times == AGREED || start.elapsed() > PATIENCE {
            return ours;
        }
        native.fence();
        libzmq.fence();
    }
}

#[test]
fn ours_and_libzmq_do_the_same_wherever_the_bytes_are_cut() {
    let cases = all_cases();
    let [native, libzmq] = [Transport::Native, Transport::Libzmq].map(TestServer::new);
    let expected = expected(&cases, &native, &libzmq);
    let names: BTreeSet<_> = cases.iter().map(|case| case.name).collect();
    for (name, ..) in DIFFERENCES.iter().flat_map(|difference| difference.shown) {
        assert!(names.contains(name), "no case is named '{name}'");
    }
    let usual = greeting(3, 1);
    let places = |case: &Case| {
        // The beginning that most have is cut in the cases of versions.
        let begin = match case {
            Case {
                met: true, hello, ..
            } => hello.len(),
            Case { name, .. } if name.starts_with("version") => 0,
            Case { hello, .. } if hello.starts_with(&usual) => usual.len(),
            _ => 0,
        };
        let all = case.hello.len() + case.then.len();
        // Whole, at each byte, but not in the middle of a long one.
        let cut = (begin + 1..all).filter(move |cut| cut - begin < 120 || all - cut < 30);
        // libzmq's outcome depends on where these are cut.
        let is_cut = !TOGETHER_WITH_READY.contains(&case.name);
        std::iter::once(0).chain(cut.filter(move |_| is_cut))
    };
    let jobs = cases.iter().zip(&expected);
    let jobs = jobs.flat_map(|(case, both)| places(case).map(move |cut| (case, cut, both)));
    let jobs: Vec<_> = jobs.collect();
    let mut wrong = Vec::new();
    for chunk in jobs.chunks(TOGETHER) {
        let streams: Vec<_> = chunk.iter().map(|(case, cut, _)| (*case, *cut)).collect();
        for (side, (who, server)) in [("ours", &native), ("libzmq", &libzmq)].iter().enumerate() {
            let expected: Vec<_> = chunk.iter().map(|(.., both)| &both[side]).collect();
            let outcomes = server.run(&streams, &expected);
            for ((outcome, expected), (case, cut)) in outcomes.iter().zip(expected).zip(&streams) {
                if outcome != expected {
                    let name = case.name;
                    wrong.push(format!(
                        "{name}, cut at {cut}: {who}:\n   it is {outcome}\n  not {expected}"
                    ));
                }
            }
        }
        if wrong.len() > 20 {
            break;
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn ours_serves_two_connections_with_the_same_identity() {
    let case = named();
    for (transport, second) in [
        (Transport::Native, SERVED),
        (Transport::Libzmq, "3.1 READY open"),
    ] {
        let expected = [SERVED, second].map(|text| text.replace("ANSWER", ANSWER));
        let jobs = [(&case, 0), (&case, 0)];
        let outcomes = TestServer::new(transport).run(&jobs, &expected.each_ref());
        assert_eq!(outcomes, expected, "{transport:?}");
    }
}

/// libzmq forgets the time to live with the next frame.
#[test]
fn ours_closes_a_client_that_is_silent_after_a_request() {
    let case = silent();
    let [native, libzmq] = [Transport::Native, Transport::Libzmq].map(TestServer::new);
    let closed = format!("3.1 READY 4'\u{4}PONG' {ANSWER} closed");
    let mut theirs = libzmq.start(&[(&case, 0)]);
    assert_eq!(native.run(&[(&case, 0)], &[&closed]), [closed]);
    theirs[0].write(STATUS);
    let open = format!("3.1 READY 4'\u{4}PONG' {ANSWER} {ANSWER} open");
    let outcome = libzmq.outcomes(&mut theirs, &[(&case, 0)], &[&open]);
    assert_eq!(outcome, [open]);
}

/// Also if the end comes together with the last bytes. libzmq may drop the answer.
#[test]
fn ours_answers_a_request_before_the_end_of_its_stream() {
    let no_request = b"\0\x0C/test;2;99;x".as_slice();
    let native = TestServer::new(Transport::Native);
    for (bytes, answer) in [(STATUS, 30), (no_request, 0), (&STATUS[..9], 0), (b"", 0)] {
        let mut stream = shake_hands(native.port);
        stream.write_all(bytes).expect("to write");
        stream.shutdown(Shutdown::Write).expect("to end it");
        let mut heard = Vec::new();
        stream.read_to_end(&mut heard).expect("the end");
        assert_eq!(heard.len(), answer, "{}", heard.escape_ascii());
    }
}

#[test]
fn the_document_lists_exactly_these_differences() {
    let document = include_str!("../../../docs/zmtp.md");
    let (_, table) = document
        .split_once("| what | libzmq 4.3.4 | ours | why |")
        .expect("the table");
    let rows = table
        .lines()
        .skip(2)
        .take_while(|line| line.starts_with("| "));
    let rows = rows.map(|row| {
        row.split(" | ")
            .next()
            .unwrap_or_default()
            .trim_start_matches("| ")
    });
    let known = DIFFERENCES.iter().map(|difference| difference.what);
    let known = known.chain([IDENTITY, TIME_TO_LIVE, END]);
    assert_eq!(rows.collect::<Vec<_>>(), known.collect::<Vec<_>>());
}
