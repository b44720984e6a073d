//! What members of a fleet send each other (`ztl-fleet/src/seal.rs`, `ztl-fleet/src/wire.rs`).
//!
//! The first byte chooses what the rest is: a sealed request, or changes of a true one; the same for an answer; a request in the
//! clear, or its parts; a text of parameters or of an error.

use std::sync::OnceLock;

use ztl_fleet::seal::{NONCE, OVERHEAD, Request, Shared, parts};
use ztl_fleet::wire::{InitRules, Verdict, fresh, fresh_until};
use ztl_std::keys::{KeyPair, PublicKey};

/// The robot `arm`, and an endpoint that it knows.
struct Pair {
    desk: PublicKey,
    at_robot: Shared,
    at_desk: Shared,
    /// A true request, and the robot's answer.
    request: Vec<u8>,
    answer: Vec<u8>,
}

const ASKED: [u8; NONCE] = [1; NONCE];
const BODY: &[u8] = b"/lab;1;-1;open";

const REQUEST: Request<'_> = Request {
    robot: "arm",
    what: "request",
    parameters: "boot=7;until=9000",
    who: "anybody",
    body: BODY,
};

/// No input depends on the keys, but on whether they are the right ones.
fn pair() -> &'static Pair {
    static PAIR: OnceLock<Pair> = OnceLock::new();
    PAIR.get_or_init(|| {
        let [robot, desk] = [(); 2].map(|()| KeyPair::generate());
        let at_robot = Shared::new(&robot, &desk.public());
        let at_desk = Shared::new(&desk, &robot.public());
        let verdict = Verdict::Answer(BODY.to_vec());
        Pair {
            desk: desk.public(),
            request: at_desk.request(&desk.public(), &ASKED, &REQUEST).unwrap(),
            answer: at_robot.answer(&ASKED, &[2; NONCE], &verdict).unwrap(),
            at_robot,
            at_desk,
        }
    })
}

/// Any input.
pub fn check(bytes: &[u8]) {
    let Some((choice, rest)) = bytes.split_first() else {
        return;
    };
    match choice % 6 {
        0 => request(rest),
        1 => request(&changed(&pair().request, rest)),
        2 => answer(rest),
        3 => answer(&changed(&pair().answer, rest)),
        4 => clear(rest),
        _ => texts(rest),
    }
}

/// The robot gets these bytes.
fn request(payload: &[u8]) {
    let pair = pair();
    let Some((sender, nonce, sealed)) = parts(payload) else {
        assert!(
            payload.len() < 32 + NONCE,
            "{} bytes are too short",
            payload.len()
        );
        return;
    };
    // A robot looks up the key by these bytes.
    let is_true = payload == pair.request;
    let opened = pair.at_robot.open(&nonce, sealed);
    let opened = opened.filter(|_| sender == pair.desk.as_bytes());
    match opened {
        None => assert!(!is_true, "a true request is refused"),
        Some(clear) => {
            assert!(is_true, "a request that nobody sealed is opened");
            assert_eq!(Request::parse(&clear), Some(REQUEST));
        }
    }
}

/// The endpoint gets these bytes as an answer.
fn answer(payload: &[u8]) {
    let pair = pair();
    let told = pair.at_desk.open_answer(&ASKED, payload);
    let is_true = payload == pair.answer;
    assert_eq!(told, is_true.then(|| Verdict::Answer(BODY.to_vec())));
    let other = pair.at_desk.open_answer(&[3; NONCE], payload);
    assert_eq!(other, None, "an answer to another request is believed");
}

/// A request in the clear, and one of these parts.
fn clear(bytes: &[u8]) {
    let pair = pair();
    let sealed = |request: &Request<'_>| pair.at_desk.request(&pair.desk, &ASKED, request);
    if let Some(request) = Request::parse(bytes)
        && let Some(sealed) = sealed(&request)
    {
        let (_, nonce, sealed) = parts(&sealed).unwrap();
        assert_eq!(pair.at_robot.open(&nonce, sealed).as_deref(), Some(bytes));
    }
    let mut pieces = bytes.splitn(5, |byte| *byte == 0);
    let mut text = || str::from_utf8(pieces.next().unwrap_or_default()).unwrap_or_default();
    let request = Request {
        robot: text(),
        what: text(),
        parameters: text(),
        who: text(),
        body: bytes,
    };
    if let Some(sealed) = sealed(&request) {
        assert!(sealed.len() <= bytes.len() + OVERHEAD);
        let (_, nonce, sealed) = parts(&sealed).unwrap();
        let clear = pair.at_robot.open(&nonce, sealed).unwrap();
        assert_eq!(Request::parse(&clear), Some(request));
    }
    // An answer is never read as a request, nor the other way round.
    let verdict = Verdict::Answer(bytes.to_vec());
    let answer = pair.at_robot.answer(&ASKED, &[2; NONCE], &verdict).unwrap();
    assert_eq!(pair.at_desk.open_answer(&ASKED, &answer), Some(verdict));
    let (nonce, sealed) = answer.split_first_chunk().unwrap();
    let clear = pair.at_robot.open(nonce, sealed).unwrap();
    assert_eq!(Request::parse(&clear), None);
}

/// Parameters, and an error.
fn texts(bytes: &[u8]) {
    let verdict = Verdict::of_error(bytes);
    let (is_answer, payload) = verdict.to_payload();
    assert!(!is_answer, "an error is taken for an answer");
    assert_eq!(Verdict::of_error(&payload), verdict);
    let Ok(text) = str::from_utf8(bytes) else {
        return;
    };
    if let Ok(Some(rules)) = InitRules::parse(text) {
        assert_eq!(InitRules::parse(&rules.to_parameters()), Ok(Some(rules)));
        if let Some(until) = fresh_until(text, rules.boot, rules.until_ms) {
            assert_eq!(
                fresh_until(&fresh(rules.boot, until), rules.boot, until),
                Some(until)
            );
        }
    }
}

/// A true message with other bytes at some places: two bytes for the place and one for the change; perhaps longer or shorter.
fn changed(message: &[u8], changes: &[u8]) -> Vec<u8> {
    let mut message = message.to_vec();
    let mut changes = changes.chunks_exact(3);
    for change in &mut changes {
        let at = usize::from(change[0]) << 8 | usize::from(change[1]);
        match message.get_mut(at) {
            Some(byte) => *byte ^= change[2],
            None if change[2] < 128 => message.truncate(at % (message.len() + 1)),
            None => message.push(change[2]),
        }
    }
    message
}
