//! Resolves host names without the C library of the system: by `/etc/hosts` and by a name server.

use std::net::{Ipv4Addr, UdpSocket};
use std::process::Command;

use ztl_tests::lab::{Ended, Process, SCOPE, Server};

use super::place::Place;

/// An address of this machine that is otherwise unused.
const NAME_SERVER: Ipv4Addr = Ipv4Addr::new(127, 77, 12, 9);

#[track_caller]
fn ask(place: &Place, server: &Server, host: &str) -> Ended {
    let mut command: Command = place.ztl("task-client --exit-status -r");
    command.args([host, "-s", SCOPE, "-p", &server.port.to_string()]);
    Process::run(command.arg("test:echo:hi"))
}

#[test]
#[ignore = "for `cargo xtask dist --check`"]
fn host_names_are_resolved_from_the_hosts_file() {
    let place = Place::new();
    let server = Server::ours();
    if place.path_inside("etc") != "/etc" {
        return; // The files are the machine's own.
    }
    place.write(
        "etc/hosts",
        "127.0.0.1 localhost\n127.0.0.1 robot robot.lab\n",
    );
    for name in ["robot", "robot.lab"] {
        let ended = ask(&place, &server, name);
        assert_eq!(ended.code, Some(0), "{ended:?}");
    }
}

#[test]
#[ignore = "for `cargo xtask dist --check`"]
fn host_names_are_resolved_by_dns() {
    let place = Place::new();
    let server = Server::ours();
    if place.path_inside("etc") != "/etc" {
        return; // The files are the machine's own.
    }
    // A resolver only asks at this port, which only the superuser can open.
    let Ok(socket) = UdpSocket::bind((NAME_SERVER, 53)) else {
        return;
    };
    let answering = socket.try_clone().expect("a socket");
    std::thread::spawn(move || {
        let mut buffer = [0xA5; 512];
        while let Ok((length, from)) = answering.recv_from(&mut buffer) {
            let question = buffer.get(..length).unwrap_or_default();
            if let Some(answer) = answer(question) {
                let _ = answering.send_to(&answer, from);
            }
        }
    });
    place.write("etc/resolv.conf", &format!("nameserver {NAME_SERVER}\n"));
    let ended = ask(&place, &server, "robot.example");
    assert_eq!(ended.code, Some(0), "{ended:?}");
    let ended = ask(&place, &server, "nobody.example");
    assert_eq!(ended.code, Some(5), "{ended:?}");
    assert!(
        ended.stdout.contains("no host 'nobody.example' is known"),
        "{ended:?}"
    );
}

/// The reply of a name server that knows `robot.example`, to any query (RFC 1035).
fn answer(question: &[u8]) -> Option<Vec<u8>> {
    const KNOWN: &[u8] = b"\x05robot\x07example\x00";
    let name = question.get(12..)?;
    let end = name.iter().position(|byte| *byte == 0)? + 1;
    let (name, kind) = (name.get(..end)?, name.get(end..end + 2)?);
    let known = name == KNOWN;
    let has_address = known && kind == [0, 1];
    let mut answer = question.get(..2)?.to_vec();
    // An authoritative response; NXDOMAIN for other names.
    answer.extend([0x85, if known { 0x80 } else { 0x83 }]);
    answer.extend([0, 1, 0, u8::from(has_address), 0, 0, 0, 0]);
    answer.extend(question.get(12..12 + end + 4)?);
    if has_address {
        // The name again, A, IN, for a minute, 127.0.0.1.
        answer.extend([0xC0, 12, 0, 1, 0, 1, 0, 0, 0, 60, 0, 4, 127, 0, 0, 1]);
    }
    Some(answer)
}
