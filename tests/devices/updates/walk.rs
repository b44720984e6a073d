//! The walk of `docs/update.md` with a board: the real gateway and the real command update a micro:bit in QEMU.

use std::io::{ErrorKind, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::os::unix::net::UnixStream;
use std::time::Duration;

use ztl_tests::lab::{Ended, PATIENCE, Process, Scratch, Server, ztl};

use super::rig::{NEW, OLD, Rig, signed};

/// The document, with the commands of its walk.
const WALK: &str = include_str!("../../../docs/update.md");

/// QEMU verifies slowly on a busy system.
const LIMIT: Duration = PATIENCE.saturating_mul(8);

/// Copies bytes until an end is closed. The port of the board does not block.
fn copy(mut from: impl Read, mut to: impl Write) {
    let mut buffer = [0; 256];
    loop {
        match from.read(&mut buffer) {
            Ok(0) => return,
            Ok(count) => {
                let mut left = &buffer[..count];
                while !left.is_empty() {
                    match to.write(left) {
                        Ok(count) => left = &left[count..],
                        Err(error) if error.kind() == ErrorKind::WouldBlock => wait(),
                        Err(_) => return,
                    }
                }
            }
            Err(error) if error.kind() == ErrorKind::WouldBlock => wait(),
            Err(_) => return,
        }
    }
}

fn wait() {
    std::thread::sleep(Duration::from_millis(1));
}

/// Puts the board's serial port behind TCP, as ser2net does. Returns the port.
fn behind_tcp(serial: &UnixStream) -> u16 {
    let listener = TcpListener::bind("127.0.0.1:0").expect("a port");
    let port = listener.local_addr().expect("its address").port();
    let serial = serial.try_clone().expect("a socket");
    std::thread::spawn(move || {
        for stream in listener.incoming() {
            let clone = |stream: &TcpStream| stream.try_clone();
            let (Ok(stream), Ok(port)) = (stream, serial.try_clone()) else {
                return;
            };
            let (Ok(back), Ok(serial)) = (clone(&stream), serial.try_clone()) else {
                return;
            };
            let down = std::thread::spawn(move || copy(stream, serial));
            copy(port, back);
            let _ = down.join();
        }
    });
    port
}

/// Runs the only command of the walk that begins like this, with its own port and file.
#[track_caller]
fn run(begin: &str, gateway: &Server, file: &str) -> Ended {
    let commands = WALK.split('`').filter(|code| code.starts_with(begin));
    let commands: Vec<&str> = commands.collect();
    let [command] = commands[..] else {
        panic!("{begin}: {commands:?}");
    };
    let port = gateway.port.to_string();
    let words = command.split(' ').skip(1).map(|word| match word {
        "lamp.update" => file,
        "12345" => &port,
        word => word,
    });
    let running = Process::start(ztl().args(words));
    running.end(LIMIT)
}

#[test]
fn the_gateway_and_the_command_of_the_document_update_a_board() {
    let mut rig = Rig::start();
    rig.board.run();
    let port = behind_tcp(&rig.board.serial);
    let begin = "`ztl gateway --device desk=serial:/dev/ttyACM0 -p 12345 -s /lab`";
    assert!(WALK.contains(begin));
    let gateway = Server::gateway(&[&format!("desk=tcp:127.0.0.1:{port}")]);
    gateway.wait_ready("desk");
    let scratch = Scratch::new();
    let path = |name: &str| scratch.path(name).display().to_string();
    let update = "ztl firmware update desk ";
    std::fs::write(path("lamp.update"), &rig.file).expect("a file");
    let ended = run(update, &gateway, &path("lamp.update"));
    assert_eq!(ended.code, Some(0), "{ended:?}");
    let last = format!("desk: runs {NEW}, before {OLD}\n");
    assert!(ended.stdout.ends_with(&last), "{ended:?}");
    // It is confirmed, and an older image is refused.
    std::fs::write(path("old.update"), signed(&rig.images[0], OLD, "microbit")).expect("a file");
    let ended = run(update, &gateway, &path("old.update"));
    assert_eq!(ended.code, Some(5), "{ended:?}");
    let begin = format!("desk: runs {NEW}; the image is {OLD}\n");
    assert!(ended.stdout.starts_with(&begin), "{ended:?}");
    drop(gateway);
    rig.board.halt();
    rig.board.cut_power();
    assert_eq!(rig.assert_serves("after the walk"), NEW);
}
