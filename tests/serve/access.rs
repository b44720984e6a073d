//! Who may use a server by address, and how secret keys are kept.

use ztl_tests::lab::{Ended, Process, Scratch, Server, our_client_at, ztl};

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
