//! Sockets, and clients that run in parallel.

use ztl_tests::lab::PATIENCE;

/// Runs these concurrently, each on its own thread.
#[track_caller]
pub(super) fn side_by_side(runs: Vec<Box<dyn FnOnce() + Send>>) {
    assert!(!runs.is_empty());
    let runs: Vec<_> = runs.into_iter().map(std::thread::spawn).collect();
    // Each is joined; its thread has printed any failure.
    let failed = runs.into_iter().filter_map(|run| run.join().err()).count();
    assert_eq!(failed, 0, "of the runs above");
}

/// A libzmq socket that knows when it has waited long enough.
pub(super) fn socket(context: &zmq::Context, kind: zmq::SocketType) -> zmq::Socket {
    let socket = context.socket(kind).expect("a socket");
    let limit = i32::try_from(PATIENCE.as_millis()).expect("a short time");
    socket.set_linger(0).unwrap();
    socket.set_sndtimeo(limit).unwrap();
    socket.set_rcvtimeo(limit).unwrap();
    socket
}
