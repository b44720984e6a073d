//! The wire itself, through libzmq's own sockets and through bare TCP streams: what silences the
//! original, and the table of the wire specification (11) that the original and ours must answer.

mod fuzz;
mod hostile;
mod limits;
mod malformed;
mod stream;
mod table;

use std::time::Duration;

use ztl_std::{
    ExecutableTask, RemoteTask, RequestError, RunningServer, TaskContext, TaskController,
    TaskError, TaskRequest, TaskServer,
};
use ztl_tests::lab::{PATIENCE, SCOPE, until};

/// What the original's client waits for an answer.
const TIMEOUT: Duration = Duration::from_secs(2);

/// A libzmq socket that sends just what it is told to.
struct Socket(zmq::Socket);

impl Socket {
    fn connect(kind: zmq::SocketType, endpoint: &str) -> Self {
        let context = zmq::Context::new();
        let socket = context.socket(kind).expect("a socket");
        socket.set_linger(0).unwrap();
        socket.set_sndtimeo(2000).unwrap();
        socket.set_rcvtimeo(2000).unwrap();
        socket.connect(endpoint).expect("an address");
        Self(socket)
    }

    /// A client as the original's.
    fn req(endpoint: &str) -> Self {
        Self::connect(zmq::REQ, endpoint)
    }

    fn dealer(endpoint: &str) -> Self {
        Self::connect(zmq::DEALER, endpoint)
    }

    #[track_caller]
    fn send<F: AsRef<[u8]>>(&self, frames: &[F]) {
        let frames = frames.iter().map(F::as_ref);
        self.0.send_multipart(frames, 0).expect("to send");
    }

    #[track_caller]
    fn receive(&self) -> Vec<Vec<u8>> {
        let frames = self.0.recv_multipart(0);
        frames.expect("an answer within 2 s")
    }

    /// Asks with one frame, and gives the answer as text.
    #[track_caller]
    fn ask(&self, body: impl AsRef<[u8]>) -> String {
        self.send(&[body]);
        let [answer] = <[_; 1]>::try_from(self.receive()).expect("one frame");
        String::from_utf8(answer).expect("UTF-8")
    }

    /// Asks for a task's status until it has ended.
    #[track_caller]
    fn ask_end(&self, status: &str) -> String {
        until("its end", PATIENCE, || {
            let answer = self.ask(status);
            (!answer.starts_with(&format!("{SCOPE};1;"))).then_some(answer)
        })
    }
}

/// A server in this process, whose tasks echo.
fn in_process() -> RunningServer {
    struct Echo;
    impl TaskController for Echo {
        fn assign(&self, request: &TaskRequest) -> Result<Box<dyn ExecutableTask>, TaskError> {
            let goal = request.goal.clone();
            Ok(Box::new(move |_: &TaskContext| Ok(goal)))
        }
    }
    let mut server = TaskServer::bind("tcp://127.0.0.1:*").expect("a port");
    server.register(SCOPE, Echo);
    server.spawn().expect("a thread")
}

/// A good client is served, at once.
#[track_caller]
fn assert_serves(endpoint: &str, after: &str) {
    let mut remote = RemoteTask::connect(endpoint, SCOPE)
        .expect("an address")
        .with_timeout(TIMEOUT);
    let answer = remote.status(99);
    let unknown = RequestError::UnknownTask {
        id: 99.into(),
        text: "Invalid ID '99'".to_owned(),
    };
    assert_eq!(answer, Err(unknown), "after {after}");
}
