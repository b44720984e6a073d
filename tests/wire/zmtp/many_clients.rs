//! Many clients, in sequence and concurrently.

use std::time::Duration;

use ztl_tests::lab::{PATIENCE, Process, our_client, until};

use super::device::{Device, PLACES};
use crate::socket::Socket;

#[test]
fn a_thousand_clients_come_and_go() {
    let device = Device::start();
    let context = zmq::Context::new();
    for number in 0..1000 {
        let socket = context.socket(zmq::REQ).expect("a socket");
        socket.set_linger(0).unwrap();
        socket.set_rcvtimeo(20_000).unwrap();
        socket.connect(&device.endpoint()).unwrap();
        socket.send(&format!("/desk;2;{number};x"), 0).unwrap();
        let answer = socket.recv_string(0).expect("an answer").unwrap();
        assert_eq!(answer, format!("/desk;2;{number};Invalid ID '{number}'"));
    }
}

#[test]
fn all_slots_are_served_and_an_extra_client_gets_a_freed_slot() {
    let device = Device::start();
    let mut clients: Vec<Socket> = (0..PLACES).map(|_| device.req()).collect();
    for round in 0..50 {
        for client in &clients {
            client.send(&[format!("/desk;2;{round};x")]);
        }
        for client in &clients {
            let answer = format!("/desk;2;{round};Invalid ID '{round}'");
            assert_eq!(client.receive(), [answer.as_bytes()]);
        }
    }
    let further = device.req();
    further.send(&["/desk;2;99;x"]);
    further.0.set_rcvtimeo(500).unwrap();
    assert_eq!(further.0.recv_bytes(0), Err(zmq::Error::EAGAIN));
    for client in &clients {
        assert_eq!(client.ask("/desk;2;1;x"), "/desk;2;1;Invalid ID '1'");
    }
    clients.pop();
    further.0.set_rcvtimeo(20_000).unwrap();
    assert_eq!(further.receive(), [b"/desk;2;99;Invalid ID '99'"]);
}

/// Each is new to the device, which keeps four records.
#[test]
fn our_command_runs_more_often_in_a_minute_than_there_are_records() {
    let device = Device::start();
    let run = |goal: &str| {
        let mut client = our_client();
        client.args(["--exit-status", "-r", "127.0.0.1", "-s", "/desk", "-p"]);
        client.arg(device.port.to_string());
        Process::run(client.arg(format!("desk:slide:{goal}")))
    };
    for goal in 1..=10 {
        let ended = run(&goal.to_string());
        assert_eq!(ended.code, Some(0), "{ended:?}");
        // A rejected client occupies no record either.
        let ended = run("far");
        assert_eq!(ended.code, Some(1), "{ended:?}");
        let told = ended.stdout.contains("slide takes 0 to 100 mm");
        assert!(told, "{ended:?}");
    }
}

#[test]
fn a_held_reply_delays_no_other_client() {
    let device = Device::start();
    let (one, two) = (device.socket(zmq::DEALER, |_| {}), device.req());
    // In the envelope of our client, so that it may wait.
    let client = [&b"ztl1"[..], &[7; 16]].concat();
    // desk:slide:100 and desk:slide:0. Each takes a second, in which a busy machine may not ask often enough.
    let goals = [
        ("ZGVzazpzbGlkZToxMDA=", "100.0 mm"),
        ("ZGVzazpzbGlkZTow", "0.0 mm"),
    ];
    let mut goals = goals.into_iter().cycle();
    until("others are answered before the held one", PATIENCE, || {
        let (payload, place) = goals.next()?;
        let answer = two.ask(format!("/desk;1;-1;{payload}"));
        let id = answer.split(';').nth(2).expect("an id").to_owned();
        let wait = format!("/desk;2;{id};wait 1900");
        one.send(&[&client[..], &[0; 8], b"", wait.as_bytes()]);
        let answers: Vec<_> = (0..20)
            .map(|_| two.ask(format!("/desk;2;{id};x")))
            .collect();
        let held = String::from_utf8(one.receive().pop().unwrap_or_default());
        println!("{answers:?}, then {held:?}");
        let running = format!("/desk;1;{id};");
        let all_run = answers.iter().all(|answer| answer.starts_with(&running));
        let end = format!("/desk;5;{id};{place}");
        (all_run && held == Ok(end)).then_some(())
    });
}

#[test]
fn running_out_of_file_descriptors_does_not_stop_the_server() {
    let example = ztl_tests::lab::example("zmtp");
    let mut few = std::process::Command::new("sh");
    few.args(["-c", "ulimit -n 7 && exec \"$0\" 127.0.0.1:0"]);
    let device = Device::of(few.arg(example.get_program()));
    let connect =
        || std::net::TcpStream::connect(("127.0.0.1", device.port)).expect("a connection");
    let crowd = [(); PLACES].map(|()| connect());
    device.process.wait_for("cannot take a client");
    drop(crowd);
    device.assert_serves("there are files again");
}

#[test]
fn unfinished_greetings_free_their_slots_after_a_timeout() {
    let device = Device::start();
    let start = std::time::Instant::now();
    let silent: Vec<_> = (0..PLACES)
        .map(|_| std::net::TcpStream::connect(("127.0.0.1", device.port)).expect("a connection"))
        .collect();
    let client = device.req();
    assert_eq!(client.ask("/desk;2;1;x"), "/desk;2;1;Invalid ID '1'");
    let waited = start.elapsed();
    assert!(waited > Duration::from_secs(4), "{waited:?}");
    drop(silent);
}
