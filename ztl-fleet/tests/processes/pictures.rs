//! The three pictures of docs/fleet.md, started from the files in examples/fleet.

use std::path::Path;
use std::process::Command;

use ztl_std::State;
use ztl_std::keys::KeyPair;
use ztl_tests::lab::{PATIENCE, Process, Scratch, Server, end, reserve_port, until, ztl};

use crate::requests::{client, start};
use crate::{fleet, python};

/// A fleet as in a picture: its files with the addresses of this machine.
struct Picture {
    scratch: Scratch,
    /// What was replaced in the files.
    replaced: Vec<(String, String)>,
    parts: Vec<Process>,
    servers: Vec<Server>,
    port: u16,
}

impl Picture {
    /// `keys` are the names of those who have one.
    fn new(replaced: &[(&str, String)], keys: &[&str]) -> Self {
        let scratch = Scratch::new();
        for name in keys {
            KeyPair::generate().write(&scratch.path(name)).unwrap();
        }
        let own = |(example, here): &(&str, String)| ((*example).to_owned(), here.clone());
        Self {
            scratch,
            replaced: replaced.iter().map(own).collect(),
            parts: Vec::new(),
            servers: Vec::new(),
            port: 0,
        }
    }

    /// Copies a file of the picture, with the addresses of this machine.
    fn copy(&self, file: &str, more: &[(&str, &str)]) {
        let examples = Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/fleet");
        let mut text = std::fs::read_to_string(examples.join(file)).unwrap();
        let all = self
            .replaced
            .iter()
            .map(|(example, here)| (example.as_str(), here.as_str()));
        for (example, here) in all.chain(more.iter().copied()) {
            text = text.replace(example, here);
        }
        let name = Path::new(file).file_name().unwrap();
        std::fs::write(self.scratch.path(name), text).unwrap();
    }

    fn start(&mut self, command: &str, file: &str, told: &str) {
        let name = Path::new(file).file_name().unwrap();
        let part = Process::start(&mut fleet(&[command], &self.scratch.path(name)));
        part.wait_for(told);
        self.parts.push(part);
    }

    fn router(&mut self, file: &str) {
        self.copy(file, &[]);
        self.start("router", file, "Routing at");
    }

    fn robot(&mut self, file: &str) {
        let naps = self.scratch.path("naps.yaml");
        let text = "port: 0\npublish: 0\nscopes: {/test: {nap: {for: sleep}}}\n";
        std::fs::write(&naps, text).unwrap();
        let server = Server::start(ztl().arg("serve").arg(naps));
        let port = server.process.wait_for_port("Publishing ");
        let at = [
            ("tcp://127.0.0.1:12345", server.endpoint()),
            ("tcp://127.0.0.1:12346", format!("tcp://127.0.0.1:{port}")),
        ];
        self.copy(
            file,
            &at.each_ref()
                .map(|(example, here)| (*example, here.as_str())),
        );
        self.servers.push(server);
        self.start("join", file, "has joined");
    }

    fn endpoint(&mut self, file: &str) {
        let any = [("port: 12345", "port: 0"), ("publish: 12346", "publish: 0")];
        self.copy(file, &any);
        self.start("endpoint", file, "Serving");
        self.port = self.parts.last().unwrap().wait_for_port("Serving ");
    }

    /// Each robot does a task through the endpoint, and is ready.
    #[track_caller]
    fn assert_served(&self, robots: &[&str]) {
        for robot in robots {
            let scope = format!("/{robot}/test");
            let mut remote = client(self.port, &scope);
            until("the robot is served", PATIENCE, || {
                let scopes = remote.describe().ok()??.scopes;
                scopes.contains_key(&scope).then_some(())
            });
            let id = start(&mut remote, "nap", "for", "0");
            assert_eq!(end(&mut remote, id).0, State::Completed);
        }
        let listed = Process::run(&mut fleet(&["ls"], &self.scratch.path("endpoint.yaml")));
        assert_eq!(listed.code, Some(0), "{listed:?}");
        assert_eq!(ready(&listed.stdout), robots);
    }
}

/// The robots of a list, which are ready.
#[track_caller]
fn ready(listed: &str) -> Vec<&str> {
    let name = |line| str::split_once(line, "  ready  /test  since ").map(|(name, _)| name);
    listed
        .lines()
        .map(|line| name(line).expect("ready"))
        .collect()
}

/// The address of a router that is to start, in place of these.
fn router(examples: [&'static str; 2], protocol: &str) -> Vec<(&'static str, String)> {
    let here = format!("{protocol}/127.0.0.1:{}", reserve_port());
    examples.map(|example| (example, here.clone())).to_vec()
}

#[test]
fn one_room() {
    let addresses = router(["tcp/0.0.0.0:7447", "tcp/10.0.0.1:7447"], "tcp");
    let mut room = Picture::new(&addresses, &[]);
    room.router("room/router.yaml");
    room.robot("room/arm-1.yaml");
    room.robot("room/arm-2.yaml");
    room.endpoint("room/endpoint.yaml");
    let port = room.parts.last().unwrap().wait_for_port("Publishing ");
    let address = format!("tcp://127.0.0.1:{port}");
    let subscriber = Process::start(ztl().args(["subscribe", &address]));
    until("tasks of both robots are told", PATIENCE, || {
        room.assert_served(&["arm-1", "arm-2"]);
        let told = subscriber.stdout();
        let mut robots = ["/arm-1/test/$tasks/", "/arm-2/test/$tasks/"].iter();
        robots.all(|topic| told.contains(topic)).then_some(())
    });
}

#[test]
fn one_building_with_a_router() {
    let addresses = router(["tcp/0.0.0.0:7447", "tcp/10.0.0.1:7447"], "tcp");
    let mut building = Picture::new(&addresses, &["arm-1", "arm-2", "desk"]);
    building.router("building/router.yaml");
    building.robot("building/arm-1.yaml");
    building.robot("building/arm-2.yaml");
    building.endpoint("building/endpoint.yaml");
    building.assert_served(&["arm-1", "arm-2"]);
    let file = building.scratch.path("endpoint.yaml");
    let floor = Process::run(fleet(&["ls"], &file).args(["--group", "floor-2"]));
    assert_eq!(ready(&floor.stdout), ["arm-2"]);
}

#[test]
fn three_universities_over_the_internet() {
    let mut addresses = Vec::new();
    for example in [
        "tls/router.uni-a.example:7447",
        "tls/router.uni-b.example:7447",
        "tls/router.uni-c.example:7447",
    ] {
        addresses.extend(router([example, example], "tls"));
    }
    let mut study = Picture::new(&addresses, &["arm-a", "arm-b", "arm-c", "study"]);
    study.copy("universities/certificate.sh", &[]);
    let certificate = |directory: &Path, name: &str| {
        let mut make = Command::new("sh");
        make.args(["certificate.sh", name, "127.0.0.1"])
            .current_dir(directory);
        let made = make.output().unwrap();
        assert!(made.status.success(), "{made:?}");
    };
    let parts = [
        "router-a", "router-b", "router-c", "arm-a", "arm-b", "arm-c", "study",
    ];
    for name in parts {
        certificate(&study.scratch.path("."), name);
    }
    for (index, name) in ["a", "b", "c"].into_iter().enumerate() {
        let file = format!("universities/router-{name}.yaml");
        let at = addresses[2 * index].1.clone();
        study.replaced.push(("tls/0.0.0.0:7447".to_owned(), at));
        study.router(&file);
        study.replaced.pop();
    }
    for name in ["a", "b", "c"] {
        study.robot(&format!("universities/arm-{name}.yaml"));
    }
    study.endpoint("universities/endpoint.yaml");
    study.assert_served(&["arm-a", "arm-b", "arm-c"]);

    // Nobody else gets in: without a certificate, or with one of another authority.
    let other = Scratch::new();
    let script = study.scratch.path("certificate.sh");
    std::fs::copy(script, other.path("certificate.sh")).unwrap();
    certificate(&other.path("."), "other");
    let path = |scratch: &Scratch, name: &str| scratch.path(name).display().to_string();
    let ca = path(&study.scratch, "ca.pem");
    let theirs = [path(&other, "other.pem"), path(&other, "other.key.pem")];
    // A command sees that before it connects.
    let file = study.scratch.path("endpoint.yaml");
    let text = std::fs::read_to_string(&file).unwrap();
    let foreign = [
        ("certificate: study.pem", &theirs[0]),
        ("key: study.key.pem", &theirs[1]),
    ];
    let text = foreign.iter().fold(text, |text, (own, other)| {
        let key = own.split(' ').next().unwrap();
        text.replace(own, &format!("{key} {other}"))
    });
    let file = study.scratch.path("foreign.yaml");
    std::fs::write(&file, text).unwrap();
    let listed = Process::run(&mut fleet(&["ls"], &file));
    assert_eq!(listed.code, Some(2), "{listed:?}");
    let told = "the certificate is not signed by an authority in 'ca'";
    assert!(listed.stderr.contains(told), "{listed:?}");
    let ours = [
        path(&study.scratch, "study.pem"),
        path(&study.scratch, "study.key.pem"),
    ];
    for (own, told) in [
        (&[][..], "refused"),
        (&theirs, "refused"),
        (&ours, "let in"),
    ] {
        let mut args = vec![addresses[0].1.as_str(), &ca];
        args.extend(own.iter().map(String::as_str));
        let stranger = Process::run(&mut python("stranger.py", &args));
        assert_eq!(stranger.stdout.trim(), told, "{stranger:?}");
    }
}
