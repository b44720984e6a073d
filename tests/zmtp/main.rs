//! A device that is a server by itself (`examples/zmtp.rs`), as ZeroMQ clients see it: old ones and new, of several
//! kinds, and streams that are no client at all.

mod clients;
mod crowds;
mod strangers;

use std::io::{Read, Write};
use std::net::{Shutdown, TcpListener, TcpStream};
use std::process::Command;
use std::time::Duration;

use ztl_tests::lab::{Process, example};

/// What the example serves.
const SCOPE: &str = "/desk";

/// How many clients it takes at a time.
const PLACES: usize = 4;

/// What the original's client waits for an answer.
const TIMEOUT: Duration = Duration::from_secs(2);

/// The example in a process of its own.
struct Desk {
    process: Process,
    port: u16,
}

impl Desk {
    #[track_caller]
    fn start() -> Self {
        Self::of(example("zmtp").arg("127.0.0.1:0"))
    }

    #[track_caller]
    fn of(command: &mut Command) -> Self {
        let process = Process::start(command);
        let port = process.wait_for_port("serving /desk at ");
        Self { process, port }
    }

    fn endpoint(&self) -> String {
        format!("tcp://127.0.0.1:{}", self.port)
    }

    /// A client as the original's, that sends just what it is told to.
    fn req(&self) -> Socket {
        Socket::connect(zmq::REQ, &self.endpoint())
    }

    #[track_caller]
    fn assert_serves(&self, after: &str) {
        let answer = self.req().ask("/desk;2;99;x");
        assert_eq!(answer, "/desk;2;99;Invalid ID '99'", "{after}");
    }
}

/// A libzmq socket.
struct Socket(zmq::Socket);

impl Socket {
    fn connect(kind: zmq::SocketType, endpoint: &str) -> Self {
        Self::prepared(kind, endpoint, |_| {})
    }

    fn prepared(kind: zmq::SocketType, endpoint: &str, prepare: impl FnOnce(&zmq::Socket)) -> Self {
        let context = zmq::Context::new();
        let socket = context.socket(kind).expect("a socket");
        socket.set_linger(0).unwrap();
        socket.set_sndtimeo(20_000).unwrap();
        socket.set_rcvtimeo(20_000).unwrap();
        prepare(&socket);
        socket.connect(endpoint).expect("an address");
        Self(socket)
    }

    #[track_caller]
    fn send<F: AsRef<[u8]>>(&self, frames: &[F]) {
        let frames = frames.iter().map(F::as_ref);
        self.0.send_multipart(frames, 0).expect("to send");
    }

    #[track_caller]
    fn receive(&self) -> Vec<Vec<u8>> {
        self.0.recv_multipart(0).expect("an answer")
    }

    #[track_caller]
    fn ask(&self, body: impl AsRef<[u8]>) -> String {
        self.send(&[body]);
        let [answer] = <[_; 1]>::try_from(self.receive()).expect("one frame");
        String::from_utf8(answer).expect("UTF-8")
    }
}

/// Between clients and the desk: each byte goes on in a packet of its own.
struct Dribble {
    port: u16,
}

impl Dribble {
    /// Its threads end with the connections, and the first with the test.
    fn before(desk: &Desk) -> Self {
        let listener = TcpListener::bind(("127.0.0.1", 0)).expect("a port");
        let port = listener.local_addr().expect("its address").port();
        let behind = desk.port;
        std::thread::spawn(move || {
            for client in listener.incoming().map_while(Result::ok) {
                let Ok(server) = TcpStream::connect(("127.0.0.1", behind)) else {
                    continue;
                };
                let (from, to) = (client.try_clone().unwrap(), server.try_clone().unwrap());
                std::thread::spawn(move || dribble(from, to));
                std::thread::spawn(move || dribble(server, client));
            }
        });
        Self { port }
    }
}

fn dribble(mut from: TcpStream, mut to: TcpStream) {
    let _ = to.set_nodelay(true);
    let mut byte = [0];
    while from.read_exact(&mut byte).is_ok() && to.write_all(&byte).is_ok() {}
    let _ = from.shutdown(Shutdown::Both);
    let _ = to.shutdown(Shutdown::Both);
}
