//! What strangers get from the console, byte by byte.

use std::io::{Read as _, Write as _};
use std::net::{TcpListener, TcpStream};

use ztl_tests::lab::{PATIENCE, Process, reserve_port, until, ztl};

use crate::console::{Console, port, web};

/// The status and the whole answer to a request with these headers.
fn ask(port: &str, path: &str, headers: &str) -> (u16, String) {
    let mut stream = TcpStream::connect(format!("127.0.0.1:{port}")).expect("a connection");
    stream.set_read_timeout(Some(PATIENCE)).expect("a limit");
    let request = format!("GET {path} HTTP/1.1\r\n{headers}Connection: close\r\n\r\n");
    stream.write_all(request.as_bytes()).expect("a request");
    let mut answer = String::new();
    stream.read_to_string(&mut answer).expect("an answer");
    let status = answer
        .split(' ')
        .nth(1)
        .and_then(|status| status.parse().ok());
    (status.expect("a status"), answer)
}

/// A WebSocket's first request: its status, and the connection.
fn socket(port: &str, headers: &str) -> (u16, TcpStream) {
    let mut stream = TcpStream::connect(format!("127.0.0.1:{port}")).expect("a connection");
    stream.set_read_timeout(Some(PATIENCE)).expect("a limit");
    let request = format!(
        "GET /rosbridge HTTP/1.1\r\n{headers}Connection: Upgrade\r\nUpgrade: websocket\r\n\
         Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
    );
    stream.write_all(request.as_bytes()).expect("a request");
    let mut status = [0; 12];
    stream.read_exact(&mut status).expect("a status");
    let status = String::from_utf8_lossy(&status);
    let status = status.rsplit(' ').next().and_then(|code| code.parse().ok());
    (status.expect("a number"), stream)
}

fn upgrade(port: &str, headers: &str) -> u16 {
    socket(port, headers).0
}

#[test]
fn other_hosts_and_origins_are_refused_on_pages_and_on_the_socket() {
    let console = Console::of_one();
    let port = port(&console.url).to_string();
    let here = format!("Host: 127.0.0.1:{port}\r\n");
    let (status, page) = ask(&port, "/", &here);
    assert_eq!(status, 200);
    for needed in [
        "content-security-policy: default-src 'none'",
        "x-content-type-options: nosniff",
    ] {
        assert!(page.contains(needed), "{page}");
    }
    assert_eq!(upgrade(&port, &here), 101);
    let own = format!("{here}Origin: http://127.0.0.1:{port}\r\n");
    assert_eq!((ask(&port, "/", &own).0, upgrade(&port, &own)), (200, 101));
    let rebound = format!("Host: evil.example:{port}\r\n");
    let same = format!("{rebound}Origin: http://evil.example:{port}\r\n");
    let foreign = format!("{here}Origin: http://evil.example\r\n");
    let neighbour = format!("{here}Origin: http://127.0.0.1:1\r\n");
    let sandboxed = format!("{here}Origin: null\r\n");
    for hostile in [rebound, same, foreign, neighbour, sandboxed] {
        assert_eq!(ask(&port, "/", &hostile).0, 403, "{hostile}");
        assert_eq!(ask(&port, "/console.js", &hostile).0, 403, "{hostile}");
        assert_eq!(upgrade(&port, &hostile), 403, "{hostile}");
    }
}

#[test]
fn other_addresses_need_a_token() {
    let robot = reserve_port();
    let (process, _) = web(
        0,
        &[("ours", robot)],
        &["--bind", "0.0.0.0", "--host", "robot.local"],
    );
    let link = process.wait_for("watchers:");
    let (_, link) = link.split_once("robot.local:").expect("the name");
    let (port, token) = link.trim().split_once("/?token=").expect("a token");
    let here = "Host: robot.local\r\n";
    assert_eq!((ask(port, "/", here).0, upgrade(port, here)), (401, 401));
    let (status, page) = ask(port, &format!("/?token={token}"), here);
    assert!(
        status == 200 && page.contains("HttpOnly; SameSite=Strict"),
        "{page}"
    );
    let cookie = format!("{here}Cookie: ztl-console={token}\r\n");
    assert_eq!(
        (ask(port, "/", &cookie).0, upgrade(port, &cookie)),
        (200, 101)
    );
    let wrong = format!("{here}Cookie: ztl-console={}\r\n", "0".repeat(32));
    assert_eq!(
        (ask(port, "/", &wrong).0, upgrade(port, &wrong)),
        (401, 401)
    );
    assert_eq!(ask(port, "/?token=", &wrong).0, 401);
}

#[test]
fn one_address_gets_a_limited_number_of_sockets() {
    let console = Console::of_one();
    let port = port(&console.url).to_string();
    let headers = format!("Host: localhost:{port}\r\n");
    let open: Vec<_> = (0..32).map(|_| socket(&port, &headers)).collect();
    assert!(open.iter().all(|(status, _)| *status == 101));
    assert_eq!(upgrade(&port, &headers), 429);
    // The page is still there for those who have a socket.
    assert_eq!(ask(&port, "/", &headers).0, 200);
    drop(open);
    until("a free socket", PATIENCE, || {
        (upgrade(&port, &headers) == 101).then_some(())
    });
}

/// A connection to the console, which says nothing.
fn silent(port: &str) -> TcpStream {
    let stream = TcpStream::connect(format!("127.0.0.1:{port}")).expect("a connection");
    stream.set_read_timeout(Some(PATIENCE)).expect("a limit");
    stream
}

#[test]
fn strangers_keep_nobody_out_and_are_closed() {
    let robot = reserve_port();
    let (process, _) = web(0, &[("ours", robot)], &["--bind", "0.0.0.0"]);
    let link = process.wait_for("watchers:");
    let (port, token) = link.split_once("/?token=").expect("a token");
    let (_, port) = port.rsplit_once(':').expect("a port");
    let here = "Host: 127.0.0.1\r\n";
    let ours = format!("{here}Authorization: Bearer {}\r\n", token.trim());
    // More than there is room for, of which none says anything.
    let mut strangers: Vec<_> = (0..300).map(|_| silent(port)).collect();
    assert_eq!((ask(port, "/", &ours).0, upgrade(port, &ours)), (200, 101));
    for stranger in &mut strangers {
        let ended = stranger.read(&mut [0; 1]);
        assert!(matches!(ended, Ok(0) | Err(_)), "{ended:?}");
    }
    // Whoever is refused is not kept either, although it does not ask to be closed.
    for headers in [here, "Host: evil.example\r\n"] {
        let mut stream = silent(port);
        let request = format!("GET / HTTP/1.1\r\n{headers}\r\n");
        stream.write_all(request.as_bytes()).expect("a request");
        let mut answer = String::new();
        stream.read_to_string(&mut answer).expect("an end");
        assert!(
            answer.starts_with("HTTP/1.1 40") && answer.contains("connection: close"),
            "{answer}"
        );
    }
}

#[test]
fn it_says_what_is_missing() {
    let none = Process::run(ztl().args(["web", "-c", "/dev/null", "-p", "0"]));
    assert_eq!(none.code, Some(2), "{none:?}");
    assert!(
        none.stderr
            .contains("no robots: give --task NAME HOST PORT SCOPE"),
        "{none:?}"
    );
    let taken = TcpListener::bind("127.0.0.1:0").expect("a port");
    let taken = taken.local_addr().expect("its address").port().to_string();
    let task = ["--task", "ours", "localhost", "1", "/test"];
    let ended = Process::run(
        ztl()
            .args(["web", "-c", "/dev/null", "-p", &taken])
            .args(task),
    );
    assert_eq!(ended.code, Some(1), "{ended:?}");
    assert!(
        ended
            .stderr
            .contains(&format!("cannot serve at 127.0.0.1 port {taken}")),
        "{ended:?}"
    );
}
