//! The example `zmtp` in its own process.

use std::io::{Read, Write};
use std::net::{Shutdown, TcpListener, TcpStream};
use std::process::Command;

use ztl_tests::lab::{PATIENCE, Process, example};

use crate::socket::Socket;

/// What the example serves.
pub(super) const SCOPE: &str = "/desk";

/// How many clients it takes at a time.
pub(super) const PLACES: usize = 4;

/// The example in its own process.
pub(super) struct Device {
    pub(super) process: Process,
    pub(super) port: u16,
}

impl Device {
    #[track_caller]
    pub(super) fn start() -> Self {
        Self::of(example("zmtp").arg("127.0.0.1:0"))
    }

    /// The same with a slide that needs 20 s for its whole way: a task still runs when a busy machine asks about it.
    #[track_caller]
    pub(super) fn slow() -> Self {
        Self::of(example("zmtp").args(["127.0.0.1:0", "5"]))
    }

    #[track_caller]
    pub(super) fn of(command: &mut Command) -> Self {
        let process = Process::start(command);
        let port = process.wait_for_port("serving /desk at ");
        Self { process, port }
    }

    pub(super) fn endpoint(&self) -> String {
        format!("tcp://127.0.0.1:{}", self.port)
    }

    /// A client like the original's, that sends exactly the given frames.
    pub(super) fn req(&self) -> Socket {
        self.socket(zmq::REQ, |_| {})
    }

    /// A socket that is connected to it.
    pub(super) fn socket(
        &self,
        kind: zmq::SocketType,
        prepare: impl FnOnce(&zmq::Socket),
    ) -> Socket {
        Socket::prepared(kind, &self.endpoint(), PATIENCE, prepare)
    }

    #[track_caller]
    pub(super) fn assert_serves(&self, after: &str) {
        let answer = self.req().ask("/desk;2;99;x");
        assert_eq!(answer, "/desk;2;99;Invalid ID '99'", "{after}");
    }
}

/// Between clients and the device: sends each byte in its own packet.
pub(super) struct Dribble {
    pub(super) port: u16,
}

impl Dribble {
    /// Its threads end with the connections, and the first with the test.
    pub(super) fn before(device: &Device) -> Self {
        let listener = TcpListener::bind(("127.0.0.1", 0)).expect("a port");
        let port = listener.local_addr().expect("its address").port();
        let behind = device.port;
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
