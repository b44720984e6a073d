//! One endless message, idle connections, and connections that are opened again and again.

use std::io::Write;
use std::net::TcpStream;
use std::time::{Duration, Instant};

use ztl_std::State;
use ztl_tests::lab::{
    Keys, LIMIT, PATIENCE, Process, Server, busy, gateway, reserve_port, shake_hands,
    simulated_gripper, until,
};

use super::crowd::{Crowd, Says, open};
use super::{Kind, MEMORY, Subject, is_served, with_open_files};

/// How long a client waits at most beside a crowd, or how long the server's process runs meanwhile if it shares the
/// processor with others.
const QUICK: Duration = Duration::from_millis(100);

/// Sends these bytes until the server closes the connection; returns how many it sent.
#[track_caller]
fn send_without_end(stream: &mut TcpStream, bytes: &[u8], most: usize) -> usize {
    stream.set_write_timeout(LIMIT).expect("a time");
    let mut sent = 0;
    while stream.write_all(bytes).is_ok() {
        sent += bytes.len();
        assert!(sent < most, "it is read from without end");
    }
    sent
}

fn an_endless_message_is_ended(kind: Kind) {
    let subject = Subject::start(kind, None, &[]);
    let mut remote = subject.client();
    let id = subject.start_task(&mut remote);
    let mut sent = Vec::new();
    for frames in [&b"\x01\x01x"[..], b"\x01\x00"] {
        let mut endless = shake_hands(subject.server.port);
        // The envelope may be as long as the frames of one byte.
        endless
            .write_all(&b"\x01\x01x".repeat(100))
            .expect("to write");
        sent.push(send_without_end(
            &mut endless,
            &frames.repeat(10_000),
            48 << 20,
        ));
        is_served(&mut remote);
    }
    let process = &subject.server.process;
    process.wait_for("is closed: a frame is too long");
    is_served(&mut subject.client());
    let end = remote.wait(id, LIMIT).expect("its end");
    assert_eq!(end.state, State::Completed, "{end:?}");
    let peak = process.peak_kib();
    println!("{kind:?}: {sent:?} bytes sent, peak {peak} KiB");
    assert!(peak < MEMORY, "{peak} KiB");
}

#[test]
fn an_endless_message_is_ended_by_a_gateway() {
    an_endless_message_is_ended(Kind::Gateway);
}

#[test]
fn an_endless_message_is_ended_by_ztl_serve() {
    an_endless_message_is_ended(Kind::Serve);
}

#[test]
fn an_endless_message_is_ended_by_a_task_server() {
    an_endless_message_is_ended(Kind::TaskServer);
}

/// More connections than files. The limit on open files leaves 128 for connections.
const FEW_FILES: u32 = 256;
const LEFT: usize = 128;
const MANY: usize = 290;
/// What leaves the crowd its places, were the limits not lowered.
const LARGE: [&str; 4] = ["--limit", "connections=10000", "--limit", "handshake=10min"];

/// A crowd of idle connections: so many have shaken hands, the others are silent.
fn idle(port: u16, shaken: usize) -> Vec<TcpStream> {
    let says = |place| match place < shaken {
        true => Says::Null,
        false => Says::Nothing,
    };
    let streams = (0..MANY).filter_map(|place| open(port, says(place)));
    streams.collect()
}

/// The server takes less than 2 % of a core in some two seconds.
#[track_caller]
fn is_idle(process: &Process) {
    const MEASURED: Duration = Duration::from_secs(2);
    let used = until("less than 2 % of a core are used", PATIENCE, || {
        let (start, before) = (Instant::now(), process.processor_time());
        std::thread::sleep(MEASURED);
        let used = (process.processor_time() - before).as_secs_f32();
        let share = used / start.elapsed().as_secs_f32();
        println!("{:.1} % of a core", share * 100.0);
        (share < 0.02).then_some(share)
    });
    assert!(used < 0.02);
}

/// No more files are open than the limit leaves for connections.
#[track_caller]
fn has_room(process: &Process, before: usize) {
    let open = process.open_files();
    println!("{before} files open before, {open} now");
    assert!(open <= before + LEFT, "{before} files before, {open} now");
}

fn an_idle_crowd_takes_no_time_and_no_file_of_others(kind: Kind) {
    let _one = busy();
    let subject = Subject::start(kind, Some(FEW_FILES), &LARGE);
    let process = &subject.server.process;
    process.wait_for("limit of 10000 connections is lowered to 128");
    let before = process.open_files();
    let mut early = subject.client();
    // Most have not shaken hands: others can still connect.
    let crowd = idle(subject.server.port, 100);
    is_idle(process);
    has_room(process, before);
    is_served(&mut early);
    is_served(&mut subject.client());
    drop(crowd);
    // Those that have shaken hands may take every place, but none from who is there.
    let crowd = idle(subject.server.port, MANY);
    is_idle(process);
    has_room(process, before);
    is_served(&mut early);
    let id = subject.start_task(&mut early);
    let end = early.wait(id, LIMIT).expect("its end");
    assert_eq!(end.state, State::Completed, "{end:?}");
    drop(crowd);
    is_served(&mut subject.client());
}

#[test]
fn an_idle_crowd_takes_nothing_from_a_gateway() {
    an_idle_crowd_takes_no_time_and_no_file_of_others(Kind::Gateway);
}

#[test]
fn an_idle_crowd_takes_nothing_from_ztl_serve() {
    an_idle_crowd_takes_no_time_and_no_file_of_others(Kind::Serve);
}

#[test]
fn an_idle_crowd_takes_nothing_from_a_task_server() {
    an_idle_crowd_takes_no_time_and_no_file_of_others(Kind::TaskServer);
}

#[test]
fn a_device_is_reached_again_beside_an_idle_crowd() {
    let port = reserve_port();
    let power_on = || simulated_gripper(&format!("tcp:{port}"));
    let mut device = power_on();
    let mut gateway = gateway(&[&format!("gripper=tcp:127.0.0.1:{port}")]);
    let gateway = Server::start(&mut with_open_files(FEW_FILES, gateway.args(LARGE)));
    gateway.wait_ready("gripper");
    let mut remote = ztl_tests::lab::connect(&gateway.endpoint());
    is_served(&mut remote);
    let crowd = idle(gateway.port, MANY);
    device.kill();
    gateway.process.wait_for("the other end has closed it");
    drop(device);
    let _device = power_on();
    let id = until("a task is taken", PATIENCE, || {
        remote.trigger("gripper", "finger", "10").ok()
    });
    let end = remote.wait(&id.id, LIMIT).expect("its end");
    assert_eq!((end.state, end.text.as_str()), (State::Completed, "10.0"));
    drop(crowd);
}

fn connections_without_a_key_lock_out_nobody(kind: Kind) {
    let _one = busy();
    let keys = Keys::make(&["robot", "anna"]);
    let (robot, anna) = (keys.path("robot.key_secret"), keys.path("anna.key"));
    let options = [
        "--key",
        &robot,
        "--client-key",
        &anna,
        "--limit",
        "connections=50",
    ];
    let subject = Subject::start(kind, None, &options);
    let crowd = Crowd::besiege(subject.server.port, 200, false);
    until("the crowd is there", PATIENCE, || {
        (crowd.opened() > 400).then_some(())
    });
    let endpoint = subject.server.endpoint();
    let mut clients = Vec::new();
    for _ in 0..8 {
        let start = Instant::now();
        let mut client = keys.client(&endpoint, "anna", "robot");
        is_served(&mut client);
        println!("{kind:?}: served after {:?}", start.elapsed());
        clients.push(client);
    }
    for client in &mut clients {
        is_served(client);
    }
    println!("{kind:?}: beside {} connections", crowd.opened());
}

#[test]
fn connections_without_a_key_lock_out_nobody_from_a_gateway() {
    connections_without_a_key_lock_out_nobody(Kind::Gateway);
}

#[test]
fn connections_without_a_key_lock_out_nobody_from_ztl_serve() {
    connections_without_a_key_lock_out_nobody(Kind::Serve);
}

/// The median of some tries, by the clock and by the processor time of the server.
#[track_caller]
fn medians(server: &Process, mut attempt: impl FnMut()) -> [Duration; 2] {
    let times = [(); 9].map(|()| {
        let (start, before) = (Instant::now(), server.processor_time());
        attempt();
        [start.elapsed(), server.processor_time() - before]
    });
    [0, 1].map(|clock| {
        let mut times = times.map(|times| times[clock]);
        times.sort();
        times[4]
    })
}

/// Beside a restless crowd, until it has opened 5,000 connections and a median is short.
#[track_caller]
fn is_quick_beside_a_crowd(server: &Server, mut attempt: impl FnMut()) {
    let crowd = Crowd::besiege(server.port, 400, true);
    until("a median is short", PATIENCE * 3, || {
        let took = medians(&server.process, &mut attempt);
        println!("medians of {took:?} beside {} connections", crowd.opened());
        (*took.iter().min()? < QUICK && crowd.opened() >= 5000).then_some(())
    });
}

#[test]
fn an_allowed_client_is_served_at_once_beside_thousands_of_anonymous_connections() {
    let _one = busy();
    let keys = Keys::make(&["robot", "anna"]);
    let (robot, anna) = (keys.path("robot.key_secret"), keys.path("anna.key"));
    let options = ["--key", &robot, "--client-key", &anna];
    let subject = Subject::start(Kind::Gateway, None, &options);
    let endpoint = subject.server.endpoint();
    let mut client = keys.client(&endpoint, "anna", "robot");
    is_quick_beside_a_crowd(&subject.server, || is_served(&mut client));
    // Also a client that opens a new connection each time.
    is_quick_beside_a_crowd(&subject.server, || {
        is_served(&mut keys.client(&endpoint, "anna", "robot"));
    });
}

#[test]
fn an_open_server_answers_at_once_beside_thousands_of_connections() {
    let _one = busy();
    let subject = Subject::start(Kind::TaskServer, None, &[]);
    let mut client = subject.client();
    is_quick_beside_a_crowd(&subject.server, || is_served(&mut client));
    is_quick_beside_a_crowd(&subject.server, || drop(subject.client()));
}
