//! Who may use a server by address, and how secret keys are kept.

use ztl_tests::lab::{Ended, Keys, PATIENCE, Process, Scratch, Server, our_client_at, ztl};

/// A gateway with a simulated gripper, and these options.
#[track_caller]
pub(crate) fn gateway(options: &[&str]) -> Server {
    let server = Server::gateway_with(&["gripper=sim:gripper"], options);
    server.wait_ready("gripper");
    server
}

/// `ztl task-client` on the gripper.
#[track_caller]
pub(crate) fn client(server: &Server, options: &[&str]) -> Ended {
    let mut command = our_client_at(server.port);
    command.args(["--exit-status", "-r", "127.0.0.1"]);
    Process::run(command.args(options).arg("gripper:finger:1"))
}

#[test]
fn only_clients_of_an_allowed_network_are_served() {
    let open = gateway(&["--allow", "127.0.0.0/8", "--allow", "10.1.2.3"]);
    open.process
        .wait_for("only this machine, if its address is in 127.0.0.0/8 or 10.1.2.3/32");
    assert_eq!(client(&open, &[]).code, Some(0));

    let closed = gateway(&["--allow", "10.1.2.0/24"]);
    let ended = client(&closed, &[]);
    assert_eq!(ended.code, Some(5), "{ended:?}");
    closed
        .process
        .wait_for("A client at 127.0.0.1 without a key is not allowed");
}

#[test]
fn a_client_says_that_its_address_is_not_allowed() {
    let ended = client(&gateway(&["--allow", "10.1.2.0/24"]), &[]);
    let told = "does not admit this client: the server's --allow must name this machine's address";
    assert!(ended.stdout.contains(told), "{ended:?}");
}

#[test]
fn an_invalid_network_is_refused_with_an_example() {
    let ended = Process::run(ztl().args(["gateway", "-p", "0", "-s", "/lab", "--allow", "lab"]));
    assert_eq!(ended.code, Some(2));
    assert!(ended.stderr.contains("192.168.1.0/24"), "{ended:?}");
}

#[test]
fn a_secret_key_readable_by_others_causes_a_warning() {
    use std::os::unix::fs::PermissionsExt;

    let scratch = Scratch::new();
    let path = scratch.path("robot.key_secret");
    let key = "Yne@$w-vo<fVvi]a<NY6T1ed:M$fCG*[IaLV{hID";
    let text = format!("curve\n    public-key = \"{key}\"\n    secret-key = \"{key}\"\n");
    std::fs::write(&path, text).expect("to write");
    let file = path.display().to_string();
    let asks = ["ps", "--key", &file, "--server-key", &file, "-p", "1"];
    let serves = "gateway -p 0 -s /lab -d head=sim:head --check --key";
    let serves: Vec<&str> = serves.split(' ').chain([file.as_str()]).collect();
    for (mode, warned) in [(0o600, false), (0o640, true), (0o604, true), (0o400, false)] {
        let rights = std::fs::Permissions::from_mode(mode);
        std::fs::set_permissions(&path, rights).expect("to change its rights");
        for words in [&asks[..], &serves[..]] {
            let ended = Process::run(ztl().args(words));
            let said = format!("warning: {file}: others can use this secret key (mode {mode:03o})");
            assert_eq!(ended.stderr.contains(&said), warned, "{mode:o}: {ended:?}");
        }
    }
}

/// Each with its place, also where a file is used in several.
#[test]
fn secrets_in_a_file_of_serve_that_others_can_read_cause_warnings() {
    use std::os::unix::fs::PermissionsExt;

    let keys = Keys::make(&["near", "far"]);
    let file = keys.path("robot.yaml");
    std::fs::write(keys.path("token.txt"), "s3cret\n").expect("to write");
    let text = "naoqi: {directory: 'tcp://127.0.0.1:9', user: nao, token: token.txt}
scopes: {/test: {p: {
    far: {forward: {to: 'tcp://127.0.0.1:9', scope: /far, key: near.key_secret, server-key: far.key}},
    bearer: {http: {post: 'http://10.0.0.7/', bearer: token.txt}},
    basic: {http: {post: 'http://10.0.0.7/', basic: token.txt}}}}}
";
    std::fs::write(&file, text).expect("to write");
    let places = [
        ("1:59", "token.txt"),
        ("3:64", "near.key_secret"),
        ("4:55", "token.txt"),
        ("5:53", "token.txt"),
    ];
    for (mode, warned) in [(0o600, false), (0o644, true), (0o640, true)] {
        for (_, name) in places {
            let rights = std::fs::Permissions::from_mode(mode);
            std::fs::set_permissions(keys.path(name), rights).expect("to change its rights");
        }
        let told = |stderr: &str| {
            let told = stderr
                .lines()
                .filter(|line| line.contains("others can use this secret"));
            let told: Vec<String> = told.map(str::to_owned).collect();
            let expected: Vec<String> = match warned {
                true => places.iter().map(|(place, name)| {
                    let path = keys.path(name);
                    format!("{file}:{place}: warning: {path}: others can use this secret key (mode {mode:03o}); run: chmod 600 {path}")
                }).collect(),
                false => Vec::new(),
            };
            assert_eq!(told, expected, "{stderr}");
        };
        let ended = Process::run(ztl().args(["serve", &file, "-p", "1", "--check"]));
        assert_eq!(ended.code, Some(0), "{ended:?}");
        told(&ended.stderr);
        let server = Server::start(ztl().args(["serve", &file, "-p", "0"]));
        server.process.signal("TERM");
        told(&server.process.end(PATIENCE).stderr);
    }
}
