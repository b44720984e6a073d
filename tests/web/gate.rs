//! What strangers get from the console, byte by byte.

use std::fs;
use std::io::{Read as _, Write as _};
use std::net::{TcpListener, TcpStream};

use ztl_tests::lab::{PATIENCE, Process, Scratch, Terminal, reserve_port, until, ztl};

use crate::console::{Console, ROBOT, certificate_and_key, from_port, node, robot, web};

/// The status and the whole answer to a request with these headers.
fn ask(port: &str, path: &str, headers: &str) -> (u16, String) {
    answer(
        port,
        &format!("GET {path} HTTP/1.1\r\n{headers}Connection: close\r\n\r\n"),
    )
}

fn answer(port: &str, request: &str) -> (u16, String) {
    let mut stream = TcpStream::connect(format!("127.0.0.1:{port}")).expect("a connection");
    stream.set_read_timeout(Some(PATIENCE)).expect("a limit");
    stream.write_all(request.as_bytes()).expect("a request");
    let mut answer = String::new();
    stream.read_to_string(&mut answer).expect("an answer");
    let status = answer
        .split(' ')
        .nth(1)
        .and_then(|status| status.parse().ok());
    (status.expect("a status"), answer)
}

/// The status and the whole answer to a form.
fn post(port: &str, headers: &str, form: &str) -> (u16, String) {
    let kind = "Content-Type: application/x-www-form-urlencoded";
    let headers = format!("{headers}{kind}\r\nContent-Length: {}\r\n", form.len());
    answer(
        port,
        &format!("POST / HTTP/1.1\r\n{headers}Connection: close\r\n\r\n{form}"),
    )
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

fn port(url: &str) -> String {
    crate::console::port(url).to_string()
}

#[test]
fn other_hosts_and_origins_are_refused_on_pages_and_on_the_socket() {
    let console = Console::of_one();
    let port = port(&console.url);
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
fn only_programs_of_this_machine_need_no_token() {
    let console = Console::of_one();
    let port = port(&console.url);
    for host in ["127.0.0.1", "localhost", "[::1]"] {
        let here = format!("Host: {host}:{port}\r\n");
        assert_eq!(
            (ask(&port, "/", &here).0, upgrade(&port, &here)),
            (200, 101)
        );
    }
    // What comes through a proxy or a forwarded port of this machine has another name, or says so.
    for headers in [
        format!("Host: 10.0.0.7:{port}\r\n"),
        format!("Host: 127.0.0.1:{port}\r\nX-Forwarded-For: 10.0.0.9\r\n"),
        format!("Host: localhost:{port}\r\nForwarded: for=10.0.0.9\r\n"),
        format!("Host: localhost:{port}\r\nX-Real-IP: 10.0.0.9\r\n"),
        format!("Host: localhost:{port}\r\nVia: 1.1 proxy\r\n"),
    ] {
        let (status, page) = ask(&port, "/", &headers);
        assert_eq!((status, upgrade(&port, &headers)), (401, 401), "{headers}");
        assert!(page.contains("Open the link again"), "{page}");
        assert_eq!(ask(&port, "/console.js", &headers).0, 401, "{headers}");
    }
}

#[test]
fn other_addresses_need_a_token() {
    let robot = reserve_port();
    let options = ["--bind", "0.0.0.0", "--host", "robot.local"];
    let (_process, link) = web(0, &[("ours", robot)], &options);
    assert!(link.contains("http://robot.local:"), "{link}");
    let link = from_port(&link);
    let (port, token) = link.split_once("/?token=").expect("a token");
    let port = port.trim_start_matches(':');
    let here = "Host: robot.local\r\n";
    // Also on this machine: a proxy here looks the same.
    let local = "Host: localhost\r\n";
    for none in [here, local] {
        assert_eq!((ask(port, "/", none).0, upgrade(port, none)), (401, 401));
    }
    let (status, page) = ask(port, &format!("/?token={token}"), here);
    let set = format!("ztl-console-{port}={token}; HttpOnly; SameSite=Strict");
    assert!(status == 200 && page.contains(&set), "{page}");
    let cookie = format!("{here}Cookie: ztl-console-{port}={token}\r\n");
    assert_eq!(
        (ask(port, "/", &cookie).0, upgrade(port, &cookie)),
        (200, 101)
    );
    for wrong in [
        format!("ztl-console-{port}={}", "0".repeat(32)),
        // The cookie of another console of the same machine.
        format!("ztl-console-1={token}"),
    ] {
        let wrong = format!("{here}Cookie: {wrong}\r\n");
        assert_eq!(
            (ask(port, "/", &wrong).0, upgrade(port, &wrong)),
            (401, 401)
        );
        assert_eq!(ask(port, "/?token=", &wrong).0, 401);
    }
}

#[test]
fn on_a_terminal_a_phone_can_read_the_links() {
    let scratch = Scratch::new();
    let mut command = ztl();
    command.args(["web", "-c", "/dev/null", "-p", "0", "--host", "robot.local"]);
    command.args(["--task", "ours", "127.0.0.1", "1", "/test"]);
    let terminal = Terminal::start(&command, (100, 90));
    // It comes line by line.
    for who in ["watchers", "operators"] {
        terminal.shows_that(&format!("the link and the code of {who}"), |screen| {
            let after = screen.split_once(&format!("{who}: "));
            let Some((link, code)) = after.and_then(|(_, after)| after.split_once('\n')) else {
                return false;
            };
            let code: Vec<&str> = code
                .lines()
                .take_while(|line| !line.contains("://"))
                .collect();
            fs::write(scratch.path("code"), code.join("\n")).expect("a file");
            let read = Process::run(node("qr.mjs").arg(scratch.path("code")));
            !link.is_empty() && read.stdout.trim() == link.trim()
        });
    }
}

#[test]
fn one_address_gets_a_limited_number_of_sockets() {
    let console = Console::of_one();
    let port = port(&console.url);
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

#[test]
fn watchers_leave_sockets_to_operators() {
    let console = Console::of_one();
    let robots = [("ours", console.robot.port)];
    // The first link is that of the watchers.
    let (_process, link) = web(0, &robots, &["--bind", "0.0.0.0"]);
    let link = from_port(&link);
    let (port, token) = link.split_once("/?token=").expect("a token");
    let port = port.trim_start_matches(':');
    let operator = format!("Host: localhost:{port}\r\n");
    let watcher = format!("{operator}Authorization: Bearer {token}\r\n");
    let watchers: Vec<_> = (0..24).map(|_| socket(port, &watcher)).collect();
    assert!(watchers.iter().all(|(status, _)| *status == 101));
    assert_eq!(upgrade(port, &watcher), 429);
    assert_eq!(upgrade(port, &operator), 101);
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
    let (process, _) = web(0, &[("ours", robot)], &["--host", "robot.local"]);
    let link = process.wait_for("watchers:");
    let (port, token) = link.split_once("/?token=").expect("a token");
    let (_, port) = port.rsplit_once(':').expect("a port");
    let here = "Host: robot.local\r\n";
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
fn a_page_of_ones_own_and_its_forms_are_answered_as_by_the_original() {
    let console = Console::of_one();
    let page = console.files.path("page.html");
    fs::write(&page, "<title>first</title>").expect("a file");
    let robots = [("test", console.robot.port)];
    let options = ["-s", &page.display().to_string()];
    let (_process, url) = web(0, &robots, &options);
    let port = port(&url);
    let here = format!("Host: 127.0.0.1:{port}\r\n");
    let get = |path: &str| ask(&port, path, &here);
    assert!(get("/").1.ends_with("<title>first</title>"));
    fs::write(&page, "<title>second</title>").expect("a file");
    for path in ["/", "/any/path/"] {
        let (status, answer) = get(path);
        assert!(
            status == 200 && answer.ends_with("<title>second</title>"),
            "{answer}"
        );
    }
    for (path, place) in [
        ("/logo.png", "/logo.png/"),
        ("//evil.example", "/evil.example/"),
    ] {
        let (status, answer) = get(path);
        let place = format!("location: {place}\r\n");
        assert!(status == 303 && answer.contains(&place), "{answer}");
    }
    assert!(get("/console").1.contains("Stop everything"));
    let post = |form: &str| post(&port, &here, form);
    let (status, answer) = post("test%3Amark=a+b&test%3Amark=c");
    assert!(
        status == 200 && answer.ends_with("<title>second</title>"),
        "{answer}"
    );
    console.has_marks(1);
    let (status, answer) = post("port=1061");
    assert!(
        status == 303 && answer.contains("location: http://127.0.0.1:1061\r\n"),
        "{answer}"
    );
    for (form, status) in [("nobody%3Amark=x", 200), ("test=x", 200), ("a:b:c=x", 200)] {
        assert_eq!(post(form).0, status, "{form}");
    }
    for wrong in ["", "{}", "test:mark", "port=99999", "port=//evil.example"] {
        assert_eq!(post(wrong).0, 400, "{wrong}");
    }
    let foreign = format!("{here}Origin: http://evil.example\r\n");
    assert_eq!(self::post(&port, &foreign, "test:mark=x").0, 403);
    let elsewhere = format!(
        "{here}Sec-Fetch-Site: cross-site\r\nSec-Fetch-Mode: navigate\r\nSec-Fetch-Dest: document\r\n"
    );
    assert_eq!(self::post(&port, &elsewhere, "test:mark=x").0, 403);
    assert_eq!(ask(&port, "/", &elsewhere).0, 200);
    let forwarded = format!("{here}X-Forwarded-For: 10.0.0.9\r\n");
    assert_eq!(self::post(&port, &forwarded, "test:mark=x").0, 401);
    fs::remove_file(&page).expect("no page");
    assert_eq!(get("/").0, 500);
    console.has_marks(1);
}

#[test]
fn a_private_key_that_others_can_read_causes_a_warning() {
    use std::os::unix::fs::PermissionsExt;

    let scratch = Scratch::new();
    let (certificate, key) = certificate_and_key(&scratch, "ours");
    for (mode, warned) in [(0o600, false), (0o644, true)] {
        let rights = fs::Permissions::from_mode(mode);
        fs::set_permissions(&key, rights).expect("to change its rights");
        let (process, _) = web(0, &[("ours", 1)], &["--tls", &certificate, &key]);
        let said = format!(
            "ztl: warning: {key}: others can use this secret key (mode {mode:03o}); run: chmod 600 {key}\n"
        );
        process.signal("TERM");
        let told = process.end(PATIENCE).stderr;
        assert_eq!(told.contains(&said), warned, "{told}");
    }
}

#[test]
fn it_says_what_is_wrong_with_its_files() {
    let scratch = Scratch::new();
    let wrong = scratch.path("wrong").display().to_string();
    fs::write(&wrong, "operator x\n").expect("a file");
    let missing = scratch.path("missing").display().to_string();
    let [(certificate, _), (_, other)] =
        ["ours", "other"].map(|name| certificate_and_key(&scratch, name));
    for (options, says) in [
        (
            vec!["--tokens", &wrong],
            "wrong: expected the lines `operator TOKEN`",
        ),
        (vec!["--tls", &missing, &wrong], "missing: "),
        (
            vec!["--tls", &wrong, &wrong],
            "wrong: no certificate: expected PEM",
        ),
        (
            vec!["--tls", &certificate, &wrong],
            "wrong: no private key: expected PEM",
        ),
        (
            vec!["--tls", &certificate, &other],
            &format!("other.pem: not the key of {certificate}"),
        ),
        (
            vec!["--tls", "/dev/zero", &wrong],
            "/dev/zero: it is not a regular file",
        ),
        (vec!["-s", &missing], "missing: No such file"),
        (
            vec!["--host", "https://robot.local"],
            "expected a name such as robot.local, without http:// and without a port",
        ),
        (vec!["--host", "robot.local:1060"], "without a port"),
    ] {
        let mut command = ztl();
        command.args([
            "web",
            "-c",
            "/dev/null",
            "-p",
            "0",
            "--task",
            "ours",
            "localhost",
            "1",
            "/test",
        ]);
        let ended = Process::run(command.args(&options));
        assert_eq!(ended.code, Some(2), "{options:?}: {ended:?}");
        assert!(ended.stderr.contains(says), "{options:?}: {ended:?}");
    }
}

#[test]
fn a_missing_robot_is_logged_once_and_when_it_is_back() {
    let scratch = Scratch::new();
    let at = reserve_port();
    let (process, _) = web(0, &[("ours", at)], &[]);
    process.wait_for("robot 'ours' is missing: no answer from");
    let mut robot = robot(&scratch, ROBOT, at);
    process.wait_for("robot 'ours' is there again");
    robot.process.kill();
    let log = || process.stderr();
    until("it is missing again", PATIENCE, || {
        (log().matches("is missing").count() == 2).then_some(())
    });
    assert!(!log().contains("Networking error"), "{}", log());
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
