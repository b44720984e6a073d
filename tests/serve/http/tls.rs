//! `https` and `wss`: certificates that are pinned, and those that are wrong.

use std::io::{Read as _, Write as _};
use std::net::TcpListener;
use std::time::Duration;

use ztl_std::State::Completed;
use ztl_tests::lab::Scratch;

use super::certificates::{self_signed, server, signed};
use super::web::{Request, Served, Socket, Wire, next, say};

fn answer(request: &Request, wire: &mut Wire) {
    match request.0.as_str() {
        "GET /events" => {
            let mut socket = Socket::accept(request, wire);
            while socket.send(r#"{"safe": true}"#) {
                // The end of the client is seen while the server waits.
                if socket.next(Duration::from_millis(20)).is_err() {
                    return;
                }
            }
        }
        _ => say(wire, "200 OK", "safe"),
    }
}

#[test]
fn the_right_certificate_is_accepted_and_each_wrong_one_has_its_reason() {
    let files = Scratch::new();
    self_signed(&files, "robot", "IP:127.0.0.1");
    self_signed(&files, "other", "IP:127.0.0.1");
    self_signed(&files, "named", "DNS:robot.local");
    let valid = ["20200101000000Z", "20991231000000Z"];
    let expired = ["20200101000000Z", "20200102000000Z"];
    let early = ["20980101000000Z", "20991231000000Z"];
    signed(&files, "signed", "robot", valid);
    signed(&files, "old", "robot", expired);
    signed(&files, "early", "robot", early);
    let servers =
        ["robot", "named", "signed", "old", "early"].map(|name| server(&files, name, answer));
    // It answers at once, as web servers do to what they do not understand.
    let plain = TcpListener::bind("127.0.0.1:0").expect("a port");
    let port = plain.local_addr().expect("an address").port();
    std::thread::spawn(move || {
        for mut stream in plain.incoming().flatten() {
            let _ = stream.read(&mut [0; 4096]);
            let _ = stream.write_all(b"HTTP/1.1 400 Bad Request\r\nConnection: close\r\n\r\n");
        }
    });
    let [robot, named, signed, old, early] = servers.each_ref().map(|it| it.port);
    // Name in the file, port, pinned certificate, outcome.
    let cases = [
        ("right", robot, "robot", None),
        ("by", signed, "robot", None),
        // The certificate itself, without who has signed it.
        ("leaf", signed, "signed", None),
        (
            "wrong",
            robot,
            "other",
            Some("is not the one of the file, nor signed by it"),
        ),
        ("named", named, "named", Some("is for another name: ")),
        (
            "old",
            old,
            "robot",
            Some("has expired, or this machine's clock is wrong"),
        ),
        (
            "oldleaf",
            old,
            "old",
            Some("has expired, or this machine's clock is wrong"),
        ),
        (
            "early",
            early,
            "early",
            Some("is not valid yet, or this machine's clock is wrong"),
        ),
        ("system", robot, "", Some("this system ")),
        (
            "plain",
            port,
            "robot",
            Some("does not speak TLS at this port"),
        ),
    ];
    let mut hosts = Vec::new();
    let mut components = Vec::new();
    for (name, port, pin, _) in &cases {
        let pin = match *pin {
            "" => String::new(),
            pin => format!(", certificate: {pin}.pem"),
        };
        hosts.push(format!("{name}: {{host: '127.0.0.1:{port}'{pin}}}"));
        components.push(format!("{name}: {{http: {{get: 'https://{{{name}}}/x'}}}}"));
        components.push(format!(
            "{name}-event: {{http: {{event: {{get: 'wss://{{{name}}}/events', until: {{has: safe}}}}}}}}"
        ));
    }
    let text = format!(
        "http: {{{}}}\nscopes: {{/test: {{p: {{{}}}}}}}\nstreams: {{/test: {{s: {{http-event: {{get: 'wss://{{right}}/events'}}, field: safe}}}}}}\n",
        hosts.join(", "),
        components.join(", ")
    );
    let served = Served::file_in(files, "/test", &text);
    for (name, _, _, mistake) in cases {
        let answer = served.run("p", name, "");
        let event = served.run("p", &format!("{name}-event"), "");
        match mistake {
            None => {
                assert_eq!(answer, (Completed, "safe".to_owned()), "{name}");
                assert_eq!(event, (Completed, "{'safe': True}".to_owned()), "{name}");
            }
            Some(mistake) => {
                for ended in [answer, event] {
                    assert_ne!(ended.0, Completed, "{name}: {ended:?}");
                    assert!(ended.1.contains(mistake), "{name}: {ended:?}");
                }
            }
        }
    }
    assert_eq!(next(&mut served.subscribe("/test/s")), "True");
    // Nothing was sent to who could not be trusted.
    for web in [1, 3, 4].map(|at| &servers[at]) {
        assert!(web.asked.lock().expect("requests").is_empty());
    }
}
