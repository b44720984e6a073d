//! A libzmq socket, and the servers that are asked with it.

use std::time::{Duration, Instant};

use ztl_std::{
    ExecutableTask, RequestError, RunningServer, TaskContext, TaskController, TaskError,
    TaskRequest,
};
use ztl_tests::lab::{PATIENCE, SCOPE, connect, serve, until};

/// The timeout of the original's client.
pub(crate) const TIMEOUT: Duration = Duration::from_secs(2);

/// Repeats `attempt`, which returns how long an answer took, until that is less than the original's client waits. A busy
/// machine delays the answers of some attempts, a defect those of all.
#[track_caller]
pub(crate) fn in_time_for_the_original(mut attempt: impl FnMut() -> Duration) {
    until("answers in time for the original", 2 * PATIENCE, || {
        let longest = attempt();
        println!("the longest answer took {longest:?}");
        (longest < TIMEOUT).then_some(())
    });
}

/// A libzmq socket that sends exactly the given frames.
pub(crate) struct Socket(pub(crate) zmq::Socket);

impl Socket {
    fn connect(kind: zmq::SocketType, endpoint: &str) -> Self {
        Self::prepared(kind, endpoint, PATIENCE, |_| {})
    }

    /// A socket that waits for `limit`, with further options.
    pub(crate) fn prepared(
        kind: zmq::SocketType,
        endpoint: &str,
        limit: Duration,
        prepare: impl FnOnce(&zmq::Socket),
    ) -> Self {
        let socket = zmq::Context::new().socket(kind).expect("a socket");
        socket.set_linger(0).unwrap();
        socket.set_sndtimeo(millis(limit)).unwrap();
        socket.set_rcvtimeo(millis(limit)).unwrap();
        prepare(&socket);
        socket.connect(endpoint).expect("an address");
        Self(socket)
    }

    /// A client as the original's.
    pub(crate) fn req(endpoint: &str) -> Self {
        Self::connect(zmq::REQ, endpoint)
    }

    pub(crate) fn dealer(endpoint: &str) -> Self {
        Self::connect(zmq::DEALER, endpoint)
    }

    #[track_caller]
    pub(crate) fn send<F: AsRef<[u8]>>(&self, frames: &[F]) {
        let frames = frames.iter().map(F::as_ref);
        self.0.send_multipart(frames, 0).expect("to send");
    }

    #[track_caller]
    pub(crate) fn receive(&self) -> Vec<Vec<u8>> {
        let frames = self.0.recv_multipart(0);
        frames.expect("an answer in time")
    }

    /// No answer comes for as long as the original's client waits.
    #[track_caller]
    pub(crate) fn assert_silent(&self, what: &str) {
        self.0.set_rcvtimeo(millis(TIMEOUT)).unwrap();
        let answer = self.0.recv_multipart(0);
        assert_eq!(answer, Err(zmq::Error::EAGAIN), "{what}");
        self.0.set_rcvtimeo(millis(PATIENCE)).unwrap();
    }

    /// Sends one frame and returns the reply as text.
    #[track_caller]
    pub(crate) fn ask(&self, body: impl AsRef<[u8]>) -> String {
        self.send(&[body]);
        let [answer] = <[_; 1]>::try_from(self.receive()).expect("one frame");
        String::from_utf8(answer).expect("UTF-8")
    }

    /// Asks for a task's status until it has ended.
    #[track_caller]
    pub(crate) fn ask_end(&self, status: &str) -> String {
        until("its end", PATIENCE, || {
            let answer = self.ask(status);
            (!answer.starts_with(&format!("{SCOPE};1;"))).then_some(answer)
        })
    }
}

fn millis(time: Duration) -> i32 {
    i32::try_from(time.as_millis()).expect("a short time")
}

/// Its tasks return their goals.
pub(crate) struct Echo;

impl TaskController for Echo {
    fn assign(&self, request: &TaskRequest) -> Result<Box<dyn ExecutableTask>, TaskError> {
        let goal = request.goal.clone();
        Ok(Box::new(move |_: &TaskContext| Ok(goal)))
    }
}

/// A server in this process, whose tasks echo.
pub(crate) fn in_process() -> RunningServer {
    serve(Echo)
}

/// A good client is served. Returns how long it waited.
#[track_caller]
pub(crate) fn assert_serves(endpoint: &str, after: &str) -> Duration {
    let start = Instant::now();
    let mut remote = connect(endpoint);
    let answer = remote.status(99);
    let unknown = RequestError::UnknownTask {
        id: 99.into(),
        text: "Invalid ID '99'".to_owned(),
    };
    assert_eq!(answer, Err(unknown), "after {after}");
    start.elapsed()
}
