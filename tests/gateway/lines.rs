//! Faulty lines: what the gateway logs about them, and how often.

use std::io::{Cursor, Read, Write};
use std::net::{Shutdown, TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::spawn;

use ztl_sim::{Device, Kind};
use ztl_std::gateway::{Devices, Endpoint, Gateway, Line};
use ztl_std::{RemoteTask, RunningServer, State, Status, TaskServer};
use ztl_tests::lab::{
    PATIENCE, Process, SCOPE, Server, connect, gateway, reserve_port, until, ztl,
};

/// The problem that the gateway reports for a device.
#[track_caller]
pub(crate) fn problem(watch: &Devices, device: &str) -> String {
    until("a problem", PATIENCE, || {
        watch.reports().remove(device)?.problem
    })
}

/// A gateway that serves in this process.
#[track_caller]
pub(crate) fn serve(gateway: Gateway) -> (RunningServer, RemoteTask) {
    let mut server = TaskServer::bind("tcp://127.0.0.1:*").expect("a port");
    server.register_handler(SCOPE, gateway);
    let server = server.spawn().expect("a thread");
    let remote = connect(server.endpoint());
    (server, remote)
}

/// Whether a task has failed because the device or the gateway heard nothing for the link timeout, as on a busy machine.
pub(crate) fn has_lost_link(end: &Status) -> bool {
    end.state == State::Failed && ["device is not answering", "link was lost"].contains(&&*end.text)
}

/// Starts a task as soon as it is accepted, and waits for its end. Starts it again if its link was lost.
#[track_caller]
pub(crate) fn complete(
    remote: &mut RemoteTask,
    device: &str,
    component: &str,
    goal: &str,
) -> String {
    until("a task ends with its link", PATIENCE, || {
        let id = remote.trigger(device, component, goal).ok()?.id;
        let end = remote.wait(id, Some(PATIENCE)).expect("its end");
        if has_lost_link(&end) {
            return None;
        }
        assert_eq!(end.state, State::Completed, "{end:?}");
        Some(end.text)
    })
}

/// The next connection.
#[track_caller]
fn accept(listener: &TcpListener) -> TcpStream {
    listener.set_nonblocking(true).expect("a listener");
    until("a connection", PATIENCE, || {
        listener.accept().ok().map(|(stream, _)| stream)
    })
}

#[test]
fn a_path_that_is_not_a_serial_port_is_reported() {
    let mut gateway = Gateway::new();
    let program = std::env::current_exe().expect("a file");
    let (_device, pty) = Device::new(Kind::Head).on_pty(None).expect("a pty");
    let url = format!("serial:{pty}");
    let endpoint: Endpoint = url.parse().expect("a URL");
    let _taken = endpoint.open().expect("it is free");
    for (name, url) in [
        ("file", format!("serial:{}", program.display())),
        ("directory", "serial:/tmp".to_owned()),
        ("null", "serial:/dev/null".to_owned()),
        ("absent", "serial:/no/such/port".to_owned()),
        ("taken", url),
    ] {
        gateway
            .add(name, url.parse().expect("a URL"))
            .expect("a thread");
    }
    let watch = gateway.devices();
    for (name, text) in [
        ("file", "it is a file, not a serial port"),
        ("directory", "it is a directory, not a serial port"),
        ("null", "it is something else, not a serial port"),
        ("absent", "there is no such port; is it plugged in?"),
        ("taken", "another program uses it"),
    ] {
        let said = problem(&watch, name);
        assert!(said.ends_with(&format!(": {text}")), "{name}: {said}");
    }
}

#[test]
fn a_pty_ignores_the_line_rate() {
    for rate in [300, 9600, 115_200, 1_234_567] {
        let (_device, pty) = Device::new(Kind::Gripper).on_pty(None).expect("a pty");
        let mut gateway = Gateway::new();
        let url = format!("serial:{pty}?baud={rate}");
        gateway
            .add("gripper", url.parse().expect("a URL"))
            .expect("a thread");
        let (_server, mut remote) = serve(gateway);
        assert_eq!(complete(&mut remote, "gripper", "finger", "2"), "2.0");
    }
}

/// The output of a bootloader before the firmware runs.
const NOISE: &[u8] =
    b"\xff\xfe\x00ets Jan 8 2013,rst cause:1, boot mode:(3,6)\r\n\x00\x01\x07garbage";

#[test]
fn a_board_that_resets_when_its_port_opens_is_served() {
    let opened = Arc::new(AtomicU32::new(0));
    let count = Arc::clone(&opened);
    // The firmware since the latest reset; the earlier one has lost power.
    let power = Mutex::new(None);
    let mut gateway = Gateway::new();
    gateway
        .add_line("gripper", "a board", move || {
            let (device, address) = Device::new(Kind::Gripper).on_tcp("127.0.0.1:0")?;
            let Line { reader, writer, .. } = Line::tcp(TcpStream::connect(address)?)?;
            *power.lock().expect("no panic") = Some(device);
            // The first two lines break as soon as the noise is read.
            let broken = count.fetch_add(1, Ordering::SeqCst) < 2;
            Ok(match broken {
                true => Line::new(Cursor::new(NOISE), writer),
                false => Line::new(Cursor::new(NOISE).chain(reader), writer),
            })
        })
        .expect("a thread");
    let watch = gateway.devices();
    let (_server, mut remote) = serve(gateway);
    assert_eq!(complete(&mut remote, "gripper", "finger", "2"), "2.0");
    assert_eq!(opened.load(Ordering::SeqCst), 3);
    assert_eq!(watch.reports()["gripper"].problem, None);
}

#[test]
fn a_broken_connection_is_reopened() {
    let peer = TcpListener::bind("127.0.0.1:0").expect("a port");
    let address = peer.local_addr().expect("its address");
    let mut gateway = Gateway::new();
    let url = format!("tcp:{address}");
    gateway
        .add("arm", url.parse().expect("a URL"))
        .expect("a thread");
    // Kept open without answers, like a device without power.
    let connections = [accept(&peer), accept(&peer)];
    drop(connections);
}

/// Passes on what both ends of two connections send, until one is closed. While `deaf`, nothing is passed on. Both stay
/// open until the returned function ends them.
fn forward(ends: [TcpStream; 2], deaf: &Arc<AtomicBool>) -> impl FnOnce() + use<> {
    let pass = |from: &TcpStream, to: &TcpStream| {
        let [mut from, mut to] = [from, to].map(|end| end.try_clone().expect("a socket"));
        let deaf = Arc::clone(deaf);
        spawn(move || {
            let mut bytes = [0; 256];
            while let Ok(count @ 1..) = from.read(&mut bytes) {
                if !deaf.load(Ordering::SeqCst) && to.write_all(&bytes[..count]).is_err() {
                    break;
                }
            }
        })
    };
    let [line, nodes] = &ends;
    line.set_nonblocking(false).expect("a socket");
    let threads = [pass(line, nodes), pass(nodes, line)];
    move || {
        for end in ends {
            // The other end may have closed it.
            let _ = end.shutdown(Shutdown::Both);
        }
        for thread in threads {
            thread.join().expect("no panic");
        }
    }
}

/// An adapter that was switched off does not close its connection.
#[test]
fn a_shared_line_over_tcp_without_answers_is_connected_again() {
    let mut device = ztl();
    let bus =
        Process::start(device.args(["device", "--bus", "left=sim:gripper@1", "--on", "tcp:0"]));
    let said = bus.wait_for("Simulated bus at rs485:tcp:");
    let (_, address) = said.split_once("tcp:").expect("an address");
    let address = address.split(". ").next().expect("an address");
    let nodes = || TcpStream::connect(address).expect("the bus");
    let peer = TcpListener::bind("127.0.0.1:0").expect("a port");
    let place = peer.local_addr().expect("its address");
    let gateway = Server::gateway(&[&format!("arm=rs485:tcp:{place}?wait=100")]);
    // No node was ever found.
    let _silent = accept(&peer);
    let deaf = Arc::default();
    let end = forward([accept(&peer), nodes()], &deaf);
    gateway.wait_ready("arm.left");
    deaf.store(true, Ordering::SeqCst);
    let again = accept(&peer);
    end();
    let end = forward([again, nodes()], &Arc::default());
    complete(
        &mut connect(&gateway.endpoint()),
        "arm.left",
        "finger",
        "10",
    );
    end();
}

#[test]
fn a_device_that_reconnects_constantly_does_not_flood_the_log() {
    let port = reserve_port();
    let peer = TcpListener::bind(("127.0.0.1", port)).expect("a port");
    let gateway = Process::start(&mut gateway(&[&format!("arm=tcp:127.0.0.1:{port}")]));
    for _ in 0..6 {
        drop(accept(&peer));
    }
    // The listener is closed, too.
    drop(peer);
    gateway.wait_for("refused");
    gateway.signal("TERM");
    let ended = gateway.end(PATIENCE);
    let lines = ended.stderr.lines().filter(|line| line.contains("'arm'"));
    let closed = lines.filter(|line| line.contains("has closed it")).count();
    // It is logged once, and again each time the gateway has had time to find that nothing answers.
    assert!((1..6).contains(&closed), "{ended:?}");
}

#[test]
fn a_device_link_that_changes_its_target_is_reopened() {
    let scratch = ztl_tests::lab::Scratch::new();
    let (link, silent) = (scratch.path("gripper"), scratch.path("silent"));
    // An open port that never answers, like a port that now belongs to another program.
    let nobody = TcpListener::bind("127.0.0.1:0").expect("a port");
    let mut line = ztl();
    let address = nobody.local_addr().expect("its address");
    line.args([
        "line",
        &format!("pty:{}", silent.display()),
        &format!("tcp:{address}"),
    ]);
    let _line = Process::start(&mut line);
    until("the silent port", PATIENCE, || {
        silent.exists().then_some(())
    });
    std::os::unix::fs::symlink(&silent, &link).expect("a link");
    let gateway = Server::gateway(&[&format!("gripper=serial:{}", link.display())]);
    gateway.process.wait_for("device is not answering");

    let (_device, pty) = Device::new(Kind::Gripper).on_pty(None).expect("a pty");
    std::fs::remove_file(&link).expect("the link");
    std::os::unix::fs::symlink(pty, &link).expect("a link");
    let mut remote = connect(&gateway.endpoint());
    assert_eq!(complete(&mut remote, "gripper", "finger", "3"), "3.0");
}

#[test]
fn a_pty_recreated_under_the_same_name_is_found() {
    let scratch = ztl_tests::lab::Scratch::new();
    let link = scratch.path("gripper");
    let gateway = Server::gateway(&[&format!("gripper=serial:{}", link.display())]);
    let mut remote = connect(&gateway.endpoint());
    for round in 0..4 {
        let (device, pty) = Device::new(Kind::Gripper).on_pty(None).expect("a pty");
        let _ = std::fs::remove_file(&link);
        std::os::unix::fs::symlink(pty, &link).expect("a link");
        let goal = (round + 1).to_string();
        assert_eq!(
            complete(&mut remote, "gripper", "finger", &goal),
            format!("{goal}.0")
        );
        // Unplugged; its link remains and leads nowhere. (The pty's number could soon be reused.)
        std::fs::remove_file(&link).expect("the link");
        std::os::unix::fs::symlink(scratch.path("nowhere"), &link).expect("a link");
        drop(device);
        // The port may be busy while it still exists.
        until("it is missed", PATIENCE, || {
            let refused = remote.trigger("gripper", "finger", "1").err()?;
            (!refused.to_string().contains("busy")).then_some(())
        });
    }
    gateway.process.signal("TERM");
    let ended = gateway.process.end(PATIENCE);
    let ready = ended.stderr.matches("Device 'gripper' is ready").count();
    // A busy machine may also lose it for a moment.
    assert!(ready >= 4, "{ended:?}");
}
