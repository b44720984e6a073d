//! A gateway's end of the link, as far as an update needs it: one command at a time.

use std::io::{ErrorKind, Read, Write};
use std::os::unix::net::UnixStream;
use std::time::{Duration, Instant};

use ztl_core::link::update::{UpdateCommand, UpdateMessage, UpdatePhase};
use ztl_core::link::{Body, Decoder, Frame, Hello, NO_SESSION, VERSION, encode, session_key};

/// After such a time a command is sent again: QEMU's line is faster than the board's queue is long.
const RETRY: Duration = Duration::from_millis(200);

/// What the node has said.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Said {
    Awake,
    /// With the version of its firmware.
    Welcome(String),
    Phase(UpdatePhase),
    /// Whether it is confirmed.
    Firmware(bool),
    Refused(String),
}

/// The state of the conversation.
#[derive(Debug)]
pub(crate) struct Talk {
    hello: u32,
    session: u32,
    seq: u8,
    sent: Vec<u8>,
    sent_at: Instant,
    decoder: Decoder<300>,
}

impl Talk {
    pub(crate) fn new() -> Self {
        Self {
            hello: 0x1122_3344,
            session: NO_SESSION,
            seq: 0,
            sent: Vec::new(),
            sent_at: Instant::now(),
            decoder: Decoder::new(),
        }
    }

    /// Begins a session.
    pub(crate) fn greet(&mut self, line: &mut UnixStream) {
        self.hello += 2;
        self.seq = 0;
        self.session = NO_SESSION;
        let hello = Hello {
            version: VERSION,
            session: self.hello,
            gateway: 7,
        };
        self.send(line, 0, Body::Hello(hello));
    }

    /// Sends a command about updates.
    pub(crate) fn command(&mut self, line: &mut UnixStream, command: UpdateCommand<'_>) {
        self.seq = self.seq % 255 + 1;
        let body = Body::Update(UpdateMessage::Command(command));
        self.send(line, self.seq, body);
    }

    fn send(&mut self, line: &mut UnixStream, seq: u8, body: Body<'_>) {
        let mut buffer = [0; 300];
        let frame = Frame { addr: 0, seq, body };
        let len = encode(self.session, &frame, &mut buffer[1..]).expect("a short frame");
        self.sent = buffer[..=len].to_vec();
        self.again(line);
    }

    fn again(&mut self, line: &mut UnixStream) {
        self.sent_at = Instant::now();
        line.write_all(&self.sent).expect("the line");
    }

    /// Sends the command again that was not answered.
    pub(crate) fn retry(&mut self, line: &mut UnixStream) {
        if self.sent_at.elapsed() > RETRY {
            self.again(line);
        }
    }

    /// What the node has said to the last command, or that it is awake.
    pub(crate) fn hear(&mut self, line: &mut UnixStream) -> Option<Said> {
        let mut byte = [0];
        loop {
            match line.read(&mut byte) {
                Ok(1) => {}
                Err(error) if error.kind() == ErrorKind::WouldBlock => return None,
                other => panic!("the line: {other:?}"),
            }
            if let Ok(true) = self.decoder.push(byte[0])
                && let Some(said) = self.frame()
            {
                return Some(said);
            }
        }
    }

    fn frame(&mut self) -> Option<Said> {
        let sessions = [NO_SESSION, self.hello, self.session];
        let (_, frame) = self.decoder.frame(&sessions).ok()?;
        let answers = frame.seq == self.seq;
        match frame.body {
            Body::Awake { .. } => Some(Said::Awake),
            // Not the answer to a `Hello` that was sent again.
            Body::Welcome(welcome) if self.session == NO_SESSION => {
                self.session = session_key(self.hello, welcome.boot);
                Some(Said::Welcome(welcome.firmware.to_owned()))
            }
            Body::Update(UpdateMessage::Phase(phase)) if answers => Some(Said::Phase(phase)),
            Body::Update(UpdateMessage::Firmware(firmware)) if answers => {
                Some(Said::Firmware(firmware.confirmed))
            }
            Body::Refused { reason } if answers => Some(Said::Refused(reason.to_owned())),
            _ => None,
        }
    }
}
