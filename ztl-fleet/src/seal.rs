//! Sealed requests and answers: only the robot's key can read a request and answer it, and only a known client's key can write
//! one. Without I/O.
//!
//! A message of a stream is a nonce and a box, too, and its session tells what it belongs to.
//! A request is the client's public key (32 bytes), a random nonce (24) and a box; an answer is a nonce and a box. The boxes are
//! those of NaCl (X25519, XSalsa20, Poly1305). An answer names the nonce of its request, so that it answers no other.

use crypto_box::aead::Aead as _;
use crypto_box::{PublicKey as BoxPublic, SalsaBox, SecretKey};
use ztl_std::keys::{KeyPair, PublicKey};

use crate::wire::{Verdict, hex};
use ztl_core::envelope::ClientId;

/// Bytes of a nonce.
pub const NONCE: usize = 24;
/// Bytes of a public key.
const KEY: usize = 32;
/// What a box adds.
const TAG: usize = 16;
/// First line of each request.
const REQUEST: &str = "ztl-fleet request 1";
/// First bytes of each answer, which no request has.
const ANSWER: &[u8] = b"ztl-fleet answer 1\n";
/// First bytes of each message of a stream.
const STREAM: &[u8] = b"ztl-fleet stream 1\n";
/// Longest parameters, name and client of a request in bytes.
const LONGEST_HEAD: usize = 1024;
/// What sealing adds to a request, at most.
pub const OVERHEAD: usize = KEY + NONCE + TAG + LONGEST_HEAD;

/// A nonce.
pub type Nonce = [u8; NONCE];

/// The id of a robot's agent that has this key: what its liveliness token says, which proves nothing.
#[must_use]
pub fn agent_of(key: &PublicKey) -> String {
    let mut id = [0; 16];
    for (to, from) in id.iter_mut().zip(key.as_bytes()) {
        *to = *from;
    }
    hex(&ClientId(id))
}

/// What two keys share.
pub struct Shared(SalsaBox);

/// A request in the clear.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Request<'a> {
    /// The robot's name.
    pub robot: &'a str,
    /// What is asked: `request`, `outcome`, `info` or `stop`.
    pub what: &'a str,
    /// Its parameters, as in a query that is not sealed.
    pub parameters: &'a str,
    /// For whom the client asks, for the robot's log.
    pub who: &'a str,
    /// The payload.
    pub body: &'a [u8],
}

/// The public key that a sealed request names as its sender, its nonce, and its box.
#[must_use]
pub fn parts(payload: &[u8]) -> Option<(&[u8; KEY], Nonce, &[u8])> {
    let (sender, rest) = payload.split_first_chunk()?;
    let (nonce, sealed) = rest.split_first_chunk()?;
    Some((sender, *nonce, sealed))
}

impl Shared {
    /// What the owner of `own` shares with the owner of `other`.
    #[must_use]
    pub fn new(own: &KeyPair, other: &PublicKey) -> Self {
        let own = SecretKey::from(*own.secret());
        Self(SalsaBox::new(&BoxPublic::from(*other.as_bytes()), &own))
    }

    /// Seals a request. `None` if its head is too long or has a line feed where it may not.
    #[must_use]
    pub fn request(
        &self,
        own: &PublicKey,
        nonce: &Nonce,
        request: &Request<'_>,
    ) -> Option<Vec<u8>> {
        let Request {
            robot,
            what,
            parameters,
            who,
            body,
        } = request;
        let head = format!("{REQUEST}\n{robot}\n{what}\n{parameters}\n{who}\n");
        if head.len() > LONGEST_HEAD || head.matches('\n').count() != 5 {
            return None;
        }
        let clear = [head.as_bytes(), body].concat();
        let sealed = self.0.encrypt(nonce.into(), clear.as_slice()).ok()?;
        Some([&own.as_bytes()[..], nonce, &sealed].concat())
    }

    /// Opens a box in a request. `None` if another key or hand made it.
    #[must_use]
    pub fn open(&self, nonce: &Nonce, sealed: &[u8]) -> Option<Vec<u8>> {
        self.0.decrypt(nonce.into(), sealed).ok()
    }

    /// Seals the answer to a request with the nonce `asked`.
    #[must_use]
    pub fn answer(&self, asked: &Nonce, nonce: &Nonce, verdict: &Verdict) -> Option<Vec<u8>> {
        let (is_answer, payload) = verdict.to_payload();
        let clear = [ANSWER, asked, &[u8::from(is_answer)], &payload].concat();
        let sealed = self.0.encrypt(nonce.into(), clear.as_slice()).ok()?;
        Some([&nonce[..], &sealed].concat())
    }

    /// Opens an answer to the request with the nonce `asked`. `None` if it is not the robot's, or answers another request.
    #[must_use]
    pub fn open_answer(&self, asked: &Nonce, payload: &[u8]) -> Option<Verdict> {
        let (nonce, sealed) = payload.split_first_chunk::<NONCE>()?;
        let clear = self.open(nonce, sealed)?;
        let rest = clear.strip_prefix(ANSWER)?.strip_prefix(asked)?;
        match rest.split_first()? {
            (1, body) => Some(Verdict::Answer(body.to_vec())),
            (_, error) => Some(Verdict::of_error(error)),
        }
    }
}

impl Shared {
    /// Seals a message of a stream.
    #[must_use]
    pub fn stream(&self, nonce: &Nonce, message: &[u8]) -> Option<Vec<u8>> {
        let clear = [STREAM, message].concat();
        let sealed = self.0.encrypt(nonce.into(), clear.as_slice()).ok()?;
        Some([&nonce[..], &sealed].concat())
    }

    /// Opens a message of a stream. `None` if another key or hand made it.
    #[must_use]
    pub fn open_stream(&self, payload: &[u8]) -> Option<Vec<u8>> {
        let (nonce, sealed) = payload.split_first_chunk::<NONCE>()?;
        let mut clear = self.open(nonce, sealed)?;
        if !clear.starts_with(STREAM) {
            return None;
        }
        clear.drain(..STREAM.len());
        Some(clear)
    }
}

impl<'a> Request<'a> {
    /// Reads an opened request. `None` if it is something else.
    #[must_use]
    pub fn parse(clear: &'a [u8]) -> Option<Self> {
        let mut parts = clear.splitn(6, |byte| *byte == b'\n');
        let mut text = || str::from_utf8(parts.next()?).ok();
        let (first, robot, what) = (text()?, text()?, text()?);
        let (parameters, who) = (text()?, text()?);
        let body = parts.next()?;
        (first == REQUEST).then_some(Self {
            robot,
            what,
            parameters,
            who,
            body,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const BODY: &[u8] = b"/lab;3;42;\n";

    fn request() -> Request<'static> {
        Request {
            robot: "arm",
            what: "request",
            parameters: "boot=1;until=2",
            who: "127.0.0.1",
            body: BODY,
        }
    }

    #[test]
    fn only_the_two_keys_read_and_answer_and_an_answer_answers_one_request() {
        let [robot, desk, other] = [(); 3].map(|()| KeyPair::generate());
        let at_desk = Shared::new(&desk, &robot.public());
        let at_robot = Shared::new(&robot, &desk.public());
        let asked = [1; NONCE];
        let sealed = at_desk.request(&desk.public(), &asked, &request()).unwrap();
        assert!(sealed.len() <= BODY.len() + OVERHEAD);
        let (sender, nonce, box_) = parts(&sealed).unwrap();
        assert_eq!((sender, nonce), (desk.public().as_bytes(), asked));
        let clear = at_robot.open(&nonce, box_).unwrap();
        assert_eq!(Request::parse(&clear), Some(request()));

        let verdict = Verdict::Answer(b"/lab;4;42;True".to_vec());
        let answer = at_robot.answer(&asked, &[2; NONCE], &verdict).unwrap();
        assert_eq!(at_desk.open_answer(&asked, &answer), Some(verdict.clone()));
        // A recorded answer, one of another key, a changed one, and a request sent back.
        assert_eq!(at_desk.open_answer(&[3; NONCE], &answer), None);
        let forged = Shared::new(&other, &desk.public());
        let forged = forged.answer(&asked, &[2; NONCE], &verdict).unwrap();
        assert_eq!(at_desk.open_answer(&asked, &forged), None);
        for at in 0..answer.len() {
            let mut changed = answer.clone();
            changed[at] ^= 1;
            assert_eq!(at_desk.open_answer(&asked, &changed), None);
        }
        assert_eq!(at_desk.open_answer(&asked, &sealed[KEY..]), None);
        let eavesdropper = Shared::new(&other, &desk.public());
        assert_eq!(eavesdropper.open(&nonce, box_), None);
        for short in 0..KEY + NONCE {
            assert_eq!(parts(&sealed[..short]), None);
        }
    }

    #[test]
    fn a_head_that_could_be_read_in_two_ways_is_not_sealed() {
        let (robot, desk) = (KeyPair::generate(), KeyPair::generate());
        let shared = Shared::new(&desk, &robot.public());
        let long = "x".repeat(LONGEST_HEAD);
        for who in ["a\nb", &long] {
            let request = Request { who, ..request() };
            assert_eq!(shared.request(&desk.public(), &[1; NONCE], &request), None);
        }
        for odd in [&b""[..], b"ztl-fleet request 1\n", b"\xff\n\n\n\n\n"] {
            assert_eq!(Request::parse(odd), None);
        }
    }
}
