//! `ztl serve` speaks to a robot's HTTP interface, plain and encrypted.

#[path = "../../serve/http/certificates.rs"]
#[expect(dead_code, reason = "the tests of HTTP use the rest")]
mod certificates;
#[path = "../../serve/http/web.rs"]
#[expect(dead_code, reason = "the tests of HTTP use the rest")]
mod web;

use ztl_std::{RemoteTask, State};
use ztl_tests::lab::{PATIENCE, Process, Scratch, Server, outcome};

use super::is_full;
use super::place::Place;
use certificates::{self_signed, server};
use web::{Web, say};

#[test]
#[ignore = "for `cargo xtask dist --check`"]
fn it_serves_robots_with_an_http_interface() {
    let place = Place::new();
    if !is_full() {
        let file = Process::run(&mut place.ztl("serve --init misty"));
        assert_eq!(file.code, Some(0), "{file:?}");
        place.write("misty.yaml", &file.stdout);
        let inside = place.path_inside("misty.yaml");
        let checked = Process::run(place.ztl("serve --check").arg(inside));
        assert_eq!(checked.code, Some(2), "{checked:?}");
        let left_out = "this ztl has no http, as the static files for 32-bit processors";
        assert!(checked.stderr.contains(left_out), "{checked:?}");
        return;
    }
    let files = Scratch::new();
    self_signed(&files, "robot", "IP:127.0.0.1");
    let plain = Web::start(|_, wire| say(wire, "200 OK", "plain"));
    let encrypted = server(&files, "robot", |_, wire| say(wire, "200 OK", "encrypted"));
    let certificate = std::fs::read_to_string(files.path("robot.pem")).expect("a certificate");
    place.write("robot.pem", &certificate);
    let [plain_port, encrypted_port] = [plain.port, encrypted.port];
    place.write(
        "robot.yaml",
        &format!(
            "http:
  plain: '127.0.0.1:{plain_port}'
  encrypted: {{host: '127.0.0.1:{encrypted_port}', certificate: robot.pem}}
scopes:
  /robot:
    arm:
      plain: {{http: {{post: 'http://{{plain}}/move', json: {{x: '{{goal}}'}}}}}}
      encrypted: {{http: {{post: 'https://{{encrypted}}/move', json: {{x: '{{goal}}'}}}}}}
"
        ),
    );
    let mut command = place.ztl("serve -p 0");
    let server = Server::start(command.arg(place.path_inside("robot.yaml")));
    let remote = RemoteTask::connect(&server.endpoint(), "/robot").expect("an address");
    // An emulated processor on a busy machine is slow.
    let mut remote = remote.with_timeout(PATIENCE);
    for (name, web) in [("plain", &plain), ("encrypted", &encrypted)] {
        let ended = outcome(&mut remote, "arm", name, "1.5");
        assert_eq!(ended, (State::Completed, name.to_owned()));
        assert_eq!(web.wait_for("POST /move").2, r#"{"x":1.5}"#);
    }
}
