//! Encryption of a connection: CurveZMQ (RFC 26). The cryptography is that of `crypto_box`.

use alloc::vec::Vec;
use core::fmt;

use crypto_box::aead::AeadInPlace as _;
use crypto_box::{Nonce, PublicKey, SalsaBox, SecretKey, Tag};
use curve25519_dalek::MontgomeryPoint;

use crate::fault::Fault;
use crate::wire::{COMMAND, LONG, MORE};

/// How many bytes an encrypted frame is longer: name, nonce, tag, flags.
pub const OVERHEAD: usize = 8 + 8 + TAG + 1;

const TAG: usize = 16;
/// Length of a key.
const KEY: usize = 32;
/// Length of what a client returns unchanged.
const COOKIE: usize = 96;

/// Which end of a connection this is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Role {
    Server,
    /// Accepts only the server with this public key.
    Client([u8; KEY]),
}

/// The keys of one end.
#[derive(Clone)]
pub struct Keys {
    secret: [u8; KEY],
    role: Role,
    random: fn() -> [u8; KEY],
}

impl fmt::Debug for Keys {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        // The secret is not shown.
        f.debug_struct("Keys")
            .field("role", &self.role)
            .finish_non_exhaustive()
    }
}

impl Keys {
    /// A server with its secret key. `random` returns bytes that nobody can guess.
    #[must_use]
    pub const fn server(secret: [u8; KEY], random: fn() -> [u8; KEY]) -> Self {
        Self {
            secret,
            role: Role::Server,
            random,
        }
    }

    /// A client with its secret key, and the public key of its server.
    #[must_use]
    pub const fn client(secret: [u8; KEY], server: [u8; KEY], random: fn() -> [u8; KEY]) -> Self {
        Self {
            secret,
            role: Role::Client(server),
            random,
        }
    }
}

/// The public key of a secret one.
#[must_use]
pub fn public_key(secret: &[u8; KEY]) -> [u8; KEY] {
    SecretKey::from(*secret).public_key().to_bytes()
}

/// Whether everybody can pretend to have the secret key of this public one: with it, all secret keys agree on the same
/// shared one.
#[must_use]
pub fn is_weak(public: &[u8; KEY]) -> bool {
    MontgomeryPoint(*public).mul_clamped([0; KEY]).0 == [0; KEY]
}

/// A handshake that is not complete.
pub(crate) struct Handshake {
    role: Role,
    /// Our permanent key, and the one of this connection only.
    own: SecretKey,
    transient: SecretKey,
    random: fn() -> [u8; KEY],
    /// The peer's keys, as far as they are known.
    peer: [u8; KEY],
    peer_transient: [u8; KEY],
    cookie: [u8; COOKIE],
    /// The last number that the peer has used, and the next one of ours.
    seen: u64,
    number: u64,
    state: State,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum State {
    /// A server waits for HELLO, a client for WELCOME.
    First,
    /// A server waits for INITIATE, a client for READY.
    Second,
    /// The peer is known.
    Known,
}

impl fmt::Debug for Handshake {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Handshake")
            .field("state", &self.state)
            .finish_non_exhaustive()
    }
}

impl Handshake {
    pub(crate) fn new(keys: &Keys) -> Self {
        let peer = match keys.role {
            Role::Server => [0; KEY],
            Role::Client(server) => server,
        };
        Self {
            role: keys.role,
            own: keys.secret.into(),
            transient: (keys.random)().into(),
            random: keys.random,
            peer,
            peer_transient: [0; KEY],
            cookie: [0; COOKIE],
            seen: 0,
            number: 1,
            state: State::First,
        }
    }

    /// The first command of a client.
    pub(crate) fn hello(&mut self) -> Option<Vec<u8>> {
        let Role::Client(server) = self.role else {
            return None;
        };
        let mut hello = b"\x05HELLO\x01\0".to_vec();
        hello.resize(hello.len() + 72, 0);
        hello.extend_from_slice(self.transient.public_key().as_bytes());
        let number = self.next_number();
        hello.extend_from_slice(&number);
        let to = cipher(&server, &self.transient);
        seal(
            &to,
            &short(b"CurveZMQHELLO---", number),
            &[0; 64],
            &mut hello,
        )?;
        Some(hello)
    }

    /// Handles a command of the peer. Returns the answer, and appends the peer's properties once they are known. `ready`
    /// are ours.
    pub(crate) fn on_command(
        &mut self,
        command: &[u8],
        ready: &[u8],
        metadata: &mut Vec<u8>,
    ) -> Result<Option<Vec<u8>>, Fault> {
        let answer = match (self.role, self.state) {
            (Role::Server, State::First) => self.on_hello(command).map(Some),
            (Role::Server, State::Second) => self.on_initiate(command, metadata).map(|()| None),
            (Role::Client(_), State::First) => self.on_welcome(command, ready).map(Some),
            (Role::Client(_), State::Second) => self.on_ready(command, metadata).map(|()| None),
            (_, State::Known) => None,
        };
        let answer = answer.ok_or(Fault::Security)?;
        self.state = match self.state {
            State::First => State::Second,
            _ => State::Known,
        };
        Ok(answer)
    }

    /// Whether the peer's first command was opened.
    pub(crate) fn has_begun(&self) -> bool {
        self.state != State::First
    }

    /// Whether the peer and its properties are known.
    pub(crate) fn is_known(&self) -> bool {
        self.state == State::Known
    }

    /// Whether the peer has proved that it has the expected key: for a client, once it has opened WELCOME.
    pub(crate) fn trusts_peer(&self) -> bool {
        self.state != State::First
    }

    /// The peer's permanent public key, once it is known.
    pub(crate) const fn peer(&self) -> [u8; KEY] {
        self.peer
    }

    /// The last command of a server, with its properties.
    pub(crate) fn ready(&mut self, properties: &[u8]) -> Option<Vec<u8>> {
        if self.role != Role::Server {
            return None;
        }
        let mut ready = b"\x05READY".to_vec();
        let number = self.next_number();
        ready.extend_from_slice(&number);
        let nonce = short(b"CurveZMQREADY---", number);
        seal(&self.session(), &nonce, properties, &mut ready)?;
        Some(ready)
    }

    /// The ciphers for sending and receiving.
    pub(crate) fn ciphers(&self) -> [Cipher; 2] {
        let names = [b"CurveZMQMESSAGES", b"CurveZMQMESSAGEC"];
        let [sending, receiving] = match self.role {
            Role::Server => names,
            Role::Client(_) => [names[1], names[0]],
        };
        [(sending, self.number), (receiving, self.seen)].map(|(name, number)| Cipher {
            cipher: self.session(),
            name: *name,
            number,
        })
    }

    fn session(&self) -> SalsaBox {
        cipher(&self.peer_transient, &self.transient)
    }

    fn next_number(&mut self) -> [u8; 8] {
        let number = self.number;
        self.number += 1;
        number.to_be_bytes()
    }

    fn on_hello(&mut self, command: &[u8]) -> Option<Vec<u8>> {
        let rest = command.strip_prefix(b"\x05HELLO\x01\0")?.get(72..)?;
        let (client, rest) = rest.split_first_chunk::<KEY>()?;
        let (number, sealed) = rest.split_first_chunk::<8>()?;
        let from = cipher(client, &self.own);
        let zeros = open(&from, &short(b"CurveZMQHELLO---", *number), sealed)?;
        if zeros != [0; 64] {
            return None;
        }
        self.peer_transient = *client;
        self.seen = u64::from_be_bytes(*number);
        for (to, from) in self
            .cookie
            .chunks_mut(KEY)
            .zip(core::iter::repeat_with(self.random))
        {
            to.copy_from_slice(&from);
        }
        let mut welcome = b"\x07WELCOME".to_vec();
        let long = self.long_nonce();
        welcome.extend_from_slice(&long);
        let plain = [
            self.transient.public_key().as_bytes(),
            self.cookie.as_slice(),
        ]
        .concat();
        seal(&from, &self::long(b"WELCOME-", long), &plain, &mut welcome)?;
        Some(welcome)
    }

    fn on_welcome(&mut self, command: &[u8], properties: &[u8]) -> Option<Vec<u8>> {
        let rest = command.strip_prefix(b"\x07WELCOME")?;
        let (nonce, sealed) = rest.split_first_chunk::<16>()?;
        let from = cipher(&self.peer, &self.transient);
        let plain = open(&from, &long(b"WELCOME-", *nonce), sealed)?;
        let (server, cookie) = plain.split_first_chunk::<KEY>()?;
        self.peer_transient = *server;
        let own = self.own.public_key().to_bytes();
        let vouching = cipher(server, &self.own);
        self.initiate(&own, &vouching, cookie.try_into().ok()?, properties)
    }

    /// The second command of the client with the permanent key `own`.
    fn initiate(
        &mut self,
        own: &[u8; KEY],
        vouching: &SalsaBox,
        cookie: &[u8; COOKIE],
        properties: &[u8],
    ) -> Option<Vec<u8>> {
        let mut vouch = own.to_vec();
        let nonce = self.long_nonce();
        vouch.extend_from_slice(&nonce);
        let vouched = [self.transient.public_key().as_bytes(), self.peer.as_slice()].concat();
        seal(vouching, &long(b"VOUCH---", nonce), &vouched, &mut vouch)?;
        vouch.extend_from_slice(properties);
        let mut initiate = [&b"\x08INITIATE"[..], cookie].concat();
        let number = self.next_number();
        initiate.extend_from_slice(&number);
        seal(
            &self.session(),
            &short(b"CurveZMQINITIATE", number),
            &vouch,
            &mut initiate,
        )?;
        Some(initiate)
    }

    fn on_initiate(&mut self, command: &[u8], metadata: &mut Vec<u8>) -> Option<()> {
        let rest = command.strip_prefix(b"\x08INITIATE")?;
        let (cookie, rest) = rest.split_first_chunk::<COOKIE>()?;
        let (number, sealed) = rest.split_first_chunk::<8>()?;
        if *cookie != self.cookie || u64::from_be_bytes(*number) <= self.seen {
            return None;
        }
        let plain = open(
            &self.session(),
            &short(b"CurveZMQINITIATE", *number),
            sealed,
        )?;
        let (client, rest) = plain.split_first_chunk::<KEY>()?;
        let (nonce, rest) = rest.split_first_chunk::<16>()?;
        let (vouch, properties) = rest.split_at_checked(2 * KEY + TAG)?;
        if is_weak(client) {
            return None;
        }
        // The owner of the permanent key vouches for the transient one, for this server.
        let from = cipher(client, &self.transient);
        let vouched = open(&from, &long(b"VOUCH---", *nonce), vouch)?;
        let (transient, server) = vouched.split_first_chunk::<KEY>()?;
        if *transient != self.peer_transient || server != self.own.public_key().as_bytes() {
            return None;
        }
        self.seen = u64::from_be_bytes(*number);
        self.peer = *client;
        metadata.extend_from_slice(properties);
        Some(())
    }

    fn on_ready(&mut self, command: &[u8], metadata: &mut Vec<u8>) -> Option<()> {
        let rest = command.strip_prefix(b"\x05READY")?;
        let (number, sealed) = rest.split_first_chunk::<8>()?;
        let plain = open(
            &self.session(),
            &short(b"CurveZMQREADY---", *number),
            sealed,
        )?;
        self.seen = u64::from_be_bytes(*number);
        metadata.extend_from_slice(&plain);
        Some(())
    }

    fn long_nonce(&self) -> [u8; 16] {
        let mut nonce = [0; 16];
        for (to, from) in nonce.iter_mut().zip((self.random)()) {
            *to = from;
        }
        nonce
    }
}

/// Encrypts or decrypts the frames of one direction.
pub(crate) struct Cipher {
    cipher: SalsaBox,
    /// The first part of each nonce.
    name: [u8; 16],
    /// The next number when sending, the last one when receiving.
    number: u64,
}

impl fmt::Debug for Cipher {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Cipher").finish_non_exhaustive()
    }
}

impl Cipher {
    /// Appends the frame with this body and these flags.
    pub(crate) fn encrypt(&mut self, flags: u8, body: &[u8], out: &mut Vec<u8>) {
        let number = self.number.to_be_bytes();
        self.number += 1;
        // RFC 26 has its own flags: more, and command.
        let inner = flags & MORE | (flags & COMMAND) >> 1;
        crate::session::put_header(0, body.len() + OVERHEAD, out);
        out.extend_from_slice(b"\x07MESSAGE");
        out.extend_from_slice(&number);
        let begin = out.len();
        out.resize(begin + TAG, 0);
        out.push(inner);
        out.extend_from_slice(body);
        let Some((tag, sealed)) = out
            .get_mut(begin..)
            .and_then(<[u8]>::split_first_chunk_mut::<TAG>)
        else {
            return;
        };
        let nonce = short(&self.name, number);
        // It fails only for messages of 256 GiB.
        if let Ok(sum) = self.cipher.encrypt_in_place_detached(&nonce, b"", sealed) {
            *tag = sum.into();
        }
    }

    /// Appends the decrypted frame as it would be without encryption; returns its flags.
    pub(crate) fn decrypt(&mut self, body: &[u8], plain: &mut Vec<u8>) -> Result<u8, Fault> {
        self.try_decrypt(body, plain).ok_or(Fault::Security)
    }

    fn try_decrypt(&mut self, body: &[u8], plain: &mut Vec<u8>) -> Option<u8> {
        let rest = body.strip_prefix(b"\x07MESSAGE")?;
        let (number, sealed) = rest.split_first_chunk::<8>()?;
        let count = u64::from_be_bytes(*number);
        // A frame that was recorded, or that comes in another order.
        if count <= self.number {
            return None;
        }
        let (tag, sealed) = sealed.split_first_chunk::<TAG>()?;
        let begin = plain.len();
        let length = sealed.len().checked_sub(1)?;
        crate::session::put_header(0, length, plain);
        let header = plain.len();
        plain.extend_from_slice(sealed);
        let nonce = short(&self.name, *number);
        let opened = plain.get_mut(header..)?;
        let cipher = &self.cipher;
        if cipher
            .decrypt_in_place_detached(&nonce, b"", opened, Tag::from_slice(tag))
            .is_err()
        {
            plain.truncate(begin);
            return None;
        }
        self.number = count;
        let inner = plain.remove(header);
        if inner & !3 != 0 {
            return None;
        }
        let flags = inner & MORE | (inner & 2) << 1;
        let long = plain.get(begin).copied()? & LONG;
        *plain.get_mut(begin)? = flags & MORE | long;
        Some(flags)
    }
}

fn cipher(public: &[u8; KEY], secret: &SecretKey) -> SalsaBox {
    SalsaBox::new(&PublicKey::from(*public), secret)
}

/// A nonce of a name and a number.
fn short(name: &[u8; 16], number: [u8; 8]) -> Nonce {
    let mut nonce = Nonce::default();
    for (to, from) in nonce.iter_mut().zip(name.iter().chain(&number)) {
        *to = *from;
    }
    nonce
}

/// A nonce of a name and random bytes.
fn long(name: &[u8; 8], random: [u8; 16]) -> Nonce {
    let mut nonce = Nonce::default();
    for (to, from) in nonce.iter_mut().zip(name.iter().chain(&random)) {
        *to = *from;
    }
    nonce
}

/// Appends tag and ciphertext.
fn seal(cipher: &SalsaBox, nonce: &Nonce, plain: &[u8], out: &mut Vec<u8>) -> Option<()> {
    let begin = out.len() + TAG;
    out.resize(begin, 0);
    out.extend_from_slice(plain);
    let sum = cipher
        .encrypt_in_place_detached(nonce, b"", out.get_mut(begin..)?)
        .ok()?;
    out.get_mut(begin - TAG..begin)?.copy_from_slice(&sum);
    Some(())
}

/// Opens what [`seal`] has made.
fn open(cipher: &SalsaBox, nonce: &Nonce, sealed: &[u8]) -> Option<Vec<u8>> {
    let (tag, text) = sealed.split_first_chunk::<TAG>()?;
    let mut plain = text.to_vec();
    cipher
        .decrypt_in_place_detached(nonce, b"", &mut plain, Tag::from_slice(tag))
        .ok()?;
    Some(plain)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A client with this permanent public key, whose vouch is sealed with `secret`; returns whether a server takes it.
    fn gets_in(public: &[u8; KEY], secret: [u8; KEY]) -> bool {
        let server_key = public_key(&[1; KEY]);
        let mut server = Handshake::new(&Keys::server([1; KEY], || [5; KEY]));
        let mut client = Handshake::new(&Keys::client([2; KEY], server_key, || [7; KEY]));
        let hello = client.hello().unwrap();
        server.on_command(&hello, b"", &mut Vec::new()).unwrap();
        client.peer_transient = server.transient.public_key().to_bytes();
        // For a weak key, all secret ones give the same shared one.
        let vouching = match is_weak(public) {
            true => cipher(public, &secret.into()),
            false => cipher(&client.peer_transient, &secret.into()),
        };
        let initiate = client.initiate(public, &vouching, &server.cookie, b"");
        let answer = server.on_command(&initiate.unwrap(), b"", &mut Vec::new());
        assert_eq!(answer.is_ok(), server.is_known());
        answer.is_ok()
    }

    #[test]
    fn a_public_key_that_everybody_can_claim_lets_nobody_in() {
        assert!(gets_in(&public_key(&[3; KEY]), [3; KEY]));
        assert!(!gets_in(&public_key(&[3; KEY]), [4; KEY]));
        // CZMQ writes zeros where it cannot encrypt. The others are 1, and a point of order 8, also with the bit that
        // X25519 ignores.
        let mut one = [0; KEY];
        one[0] = 1;
        let order_8 = *b"\x5f\x9c\x95\xbc\xa3\x50\x8c\x24\xb1\xd0\xb1\x55\x9c\x83\xef\x5b\
            \x04\x44\x5c\xc4\x58\x1c\x8e\x86\xd8\x22\x4e\xdd\xd0\x9f\x11\x57";
        let mut masked = order_8;
        masked[KEY - 1] |= 0x80;
        for weak in [[0; KEY], one, order_8, masked] {
            assert!(is_weak(&weak), "{weak:x?}");
            assert!(!gets_in(&weak, [4; KEY]), "{weak:x?}");
        }
    }
}
