//! Real clients: tasks are completed, aborted and rejected.

use zmq::SocketEvent;
use ztl_std::{RemoteTask, State};
use ztl_tests::lab::{
    ABORTED, ACCEPTED, COMPLETED, LIMIT, OriginalClient, PATIENCE, Peer, REJECTED, until,
};

use super::device::{Device, Dribble, SCOPE};

/// Tasks of a slow slide end in each way.
#[track_caller]
fn drive(mut client: OriginalClient, who: &str) {
    let task = client.trigger("desk", "slide", "2");
    let told = format!(
        "Initiated task '{}' with request: {{'handler': 'desk', 'component': 'slide', 'goal': '2'}}",
        task.number
    );
    assert_eq!(task.text, told, "{who}");
    assert_eq!(client.end(task.number), (COMPLETED, "2.0 mm"), "{who}");

    let task = client.start("desk", "slide", "100");
    let way = until("the slide on its way", PATIENCE, || {
        let answer = client.status(task);
        assert_eq!(answer.number, ACCEPTED, "{who}: {answer:?}");
        let place: f32 = answer.text.strip_suffix(" mm")?.parse().ok()?;
        (place > 2.1).then_some(place)
    });
    let busy = client.trigger("desk", "slide", "0");
    assert_eq!(busy, (-1, "busy with another task"), "{who}");
    assert_eq!(client.abort(task), (ABORTED, "True"), "{who}");
    let end = client.status(task);
    assert_eq!(end.number, ABORTED, "{who}");
    let place: f32 = end.text.trim_end_matches(" mm").parse().expect("a place");
    assert!((way..100.0).contains(&place), "{who}: {place}");

    for (component, goal, reason) in [
        ("slide", "101", "slide takes 0 to 100 mm"),
        ("slide", "", "slide takes 0 to 100 mm"),
        ("arm", "1", "no component 'arm'; it has: slide"),
    ] {
        assert_eq!(
            client.trigger("desk", component, goal),
            (-1, reason),
            "{who}"
        );
    }
    assert_eq!(client.status(7), (REJECTED, "Invalid ID '7'"), "{who}");
}

#[test]
fn the_originals_client_runs_tasks_over_libzmq_4_3() {
    let device = Device::slow();
    drive(OriginalClient::connect(device.port, SCOPE), "whole");
    let slow = Dribble::before(&device);
    drive(OriginalClient::connect(slow.port, SCOPE), "byte by byte");
}

/// libzmq 4.1, JeroMQ of ZMTP 2.0, zeromq.js.
#[test]
fn old_and_other_zeromq_peers_run_tasks() {
    for peer in Peer::here() {
        let device = Device::slow();
        drive(peer.client(device.port, SCOPE), &format!("{peer:?}, whole"));
        let slow = Dribble::before(&device);
        drive(
            peer.client(slow.port, SCOPE),
            &format!("{peer:?}, byte by byte"),
        );
    }
}

#[test]
fn our_client_runs_tasks_and_gets_the_servers_description() {
    let device = Device::slow();
    let client = RemoteTask::connect(&device.endpoint(), SCOPE).expect("an address");
    let mut client = client.with_timeout(PATIENCE);
    let id = client.trigger("desk", "slide", "3").expect("taken").id;
    let end = client.wait(id, LIMIT).expect("an end");
    assert_eq!((end.state, end.text.as_str()), (State::Completed, "3.0 mm"));
    let id = client.trigger("desk", "slide", "100").expect("taken").id;
    let end = client.abort(id).expect("an answer");
    assert_eq!(end.state, State::Aborted);
}

/// The events of a socket up to this one.
fn events_until(monitor: &zmq::Socket, wanted: SocketEvent) -> Vec<SocketEvent> {
    let mut seen = Vec::new();
    while seen.last() != Some(&wanted) {
        let frames = monitor.recv_multipart(0).expect("an event");
        let number = u16::from_le_bytes([frames[0][0], frames[0][1]]);
        seen.push(SocketEvent::from_raw(number));
    }
    seen
}

/// As libzmq itself sees it.
#[test]
fn libzmq_reports_a_clean_handshake_and_gets_its_heartbeats_answered() {
    let device = Device::start();
    let context = zmq::Context::new();
    for kind in [zmq::REQ, zmq::DEALER] {
        let socket = context.socket(kind).expect("a socket");
        socket.set_linger(0).unwrap();
        socket.set_rcvtimeo(20_000).unwrap();
        // Without an answer to each it would disconnect.
        socket.set_heartbeat_ivl(50).unwrap();
        socket.set_heartbeat_timeout(4000).unwrap();
        socket.set_heartbeat_ttl(5000).unwrap();
        let address = format!("inproc://events-{kind:?}");
        socket
            .monitor(&address, SocketEvent::ALL.to_raw().into())
            .unwrap();
        let monitor = context.socket(zmq::PAIR).expect("a socket");
        monitor.set_rcvtimeo(20_000).unwrap();
        monitor.connect(&address).unwrap();
        socket.connect(&device.endpoint()).unwrap();
        let seen = events_until(&monitor, SocketEvent::HANDSHAKE_SUCCEEDED);
        assert_eq!(seen.len(), 3, "{seen:?}");
        assert_eq!(seen[1], SocketEvent::CONNECTED);

        if kind == zmq::DEALER {
            socket.send("", zmq::SNDMORE).unwrap();
        }
        socket.send("/desk;2;99;x", 0).unwrap();
        let answer = socket.recv_multipart(0).expect("an answer");
        assert_eq!(answer.last().unwrap(), b"/desk;2;99;Invalid ID '99'");
        // Nothing else happens for longer than a heartbeat may take.
        monitor.set_rcvtimeo(5000).unwrap();
        assert_eq!(monitor.recv_multipart(0), Err(zmq::Error::EAGAIN));
    }
}

#[test]
fn a_dealer_gets_its_envelope_back_and_its_pipelined_requests_in_order() {
    let device = Device::start();
    let dealer = device.socket(zmq::DEALER, |_| {});
    for number in 0..100_u32 {
        let number = number.to_be_bytes();
        let body = format!("/desk;2;{};x", u32::from_be_bytes(number));
        dealer.send(&[&b"client"[..], &number, b"", body.as_bytes()]);
    }
    for number in 0..100_u32 {
        let body = format!("/desk;2;{number};Invalid ID '{number}'");
        let frames = [&b"client"[..], &number.to_be_bytes(), b"", body.as_bytes()];
        assert_eq!(dealer.receive(), frames);
    }
}
