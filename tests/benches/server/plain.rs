//! Clients that cost little: all on one thread, over plain TCP, speaking ZMTP as REQ sockets do.
//!
//! 64 of libzmq's, on a core of their own, need more of it than a server of its core: they would be what is
//! measured.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, poll};
use ztl_tests::lab::shake_hands;

use crate::load::{Clients, Subject};

/// Before each body: a delimiter, which is an empty frame with more to come; then the body's flags.
const BEFORE: [u8; 3] = [1, 0, 0];

/// Longest reply including its prefix, in bytes.
const LONGEST: usize = BEFORE.len() + 1 + 255;

pub(crate) struct Plain {
    /// Without blocking.
    streams: Vec<TcpStream>,
    talks: Vec<Talk>,
}

/// The bytes sent over a stream.
struct Talk {
    asked: Instant,
    heard: [u8; LONGEST],
    len: usize,
}

impl Clients for Plain {
    fn connect(subject: &Subject, count: usize) -> Self {
        let open = |_| {
            let stream = shake_hands(subject.port());
            stream.set_nodelay(true).expect("an option");
            stream.set_nonblocking(true).expect("an option");
            stream
        };
        let talk = |_| Talk {
            asked: Instant::now(),
            heard: [0; LONGEST],
            len: 0,
        };
        Self {
            streams: (0..count).map(open).collect(),
            talks: (0..count).map(talk).collect(),
        }
    }

    fn ask(&mut self, subject: &Subject, slice: Duration) -> Vec<f64> {
        let body = subject.request().as_bytes();
        let len = u8::try_from(body.len()).expect("a short request");
        let request = [&BEFORE[..], &[len], body].concat();
        // So little always has room.
        let send = |mut stream: &TcpStream| stream.write_all(&request).expect("to send");

        let watch = |stream| PollFd::new(stream, PollFlags::IN);
        let mut watched: Vec<PollFd<'_>> = self.streams.iter().map(watch).collect();
        let (start, mut times) = (Instant::now(), Vec::new());
        for (stream, talk) in self.streams.iter().zip(&mut self.talks) {
            talk.asked = Instant::now();
            send(stream);
        }
        let mut waiting = self.streams.len();
        while waiting > 0 {
            poll(&mut watched, None).expect("to wait");
            for ((watched, stream), talk) in watched.iter().zip(&self.streams).zip(&mut self.talks)
            {
                if watched.revents().is_empty() || !talk.is_answered(stream, subject) {
                    continue;
                }
                let now = Instant::now();
                times.push(now.duration_since(talk.asked).as_secs_f64() * 1e6);
                if now.duration_since(start) < slice {
                    talk.asked = now;
                    send(stream);
                } else {
                    waiting -= 1;
                }
            }
        }
        times
    }
}

impl Talk {
    /// Reads the available bytes; returns whether they complete a reply.
    fn is_answered(&mut self, mut stream: &TcpStream, subject: &Subject) -> bool {
        let room = &mut self.heard[self.len..];
        let count = stream.read(room).expect("an answer");
        assert!(count > 0, "the connection has ended");
        self.len += count;
        let Some(([delimiter @ .., len], body)) = self.heard[..self.len].split_first_chunk::<4>()
        else {
            return false;
        };
        assert_eq!(*delimiter, BEFORE);
        if body.len() < usize::from(*len) {
            return false;
        }
        assert_eq!(body.len(), usize::from(*len), "one answer to a request");
        subject.check(body);
        self.len = 0;
        true
    }
}
