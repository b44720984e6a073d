//! Old and other ZeroMQ implementations against ours, both ways (`tests/peers/README.md`).

use ztl_std::{RemoteTask, State};
use ztl_tests::lab::{
    ABORTED, ACCEPTED, COMPLETED, PATIENCE, Peer, REJECTED, SCOPE, Server, until,
};

/// Runs the test with each peer, and reports the failing ones.
#[track_caller]
fn with_each(test: impl Fn(Peer)) {
    let peers = Peer::here();
    assert!(peers.len() >= Peer::ALL.len() - 1, "only {peers:?}");
    for peer in peers {
        println!("with {peer:?}");
        test(peer);
    }
}

#[test]
fn each_peers_client_runs_tasks_on_our_server() {
    let server = Server::ours();
    with_each(|peer| {
        let mut client = peer.client(server.port, SCOPE);
        let id = client.start("test", "echo", "with : and ; in it");
        assert_eq!(client.end(id), (COMPLETED, "with : and ; in it"));
        let long = "long ".repeat(20_000);
        let id = client.start("test", "echo", &long);
        assert_eq!(client.end(id), (COMPLETED, long.as_str()));
        let id = client.start("test", "sleep", "5");
        assert_eq!(client.status(id), (ACCEPTED, "None"));
        assert_eq!(client.abort(id).number, ACCEPTED);
        assert_eq!(client.end(id), (COMPLETED, "True"));
        assert_eq!(client.status(99), (REJECTED, "Invalid ID '99'"));
        assert_eq!(client.trigger("robot", "echo", "hi").number, -1);
    });
}

#[test]
fn each_peers_client_drives_a_device_through_the_gateway() {
    let gateway = Server::gateway(&["gripper=sim:gripper"]);
    gateway.wait_ready("gripper");
    // A task of 20 s then still runs when it is aborted.
    gateway.set_speed("gripper", "speed", 0.1);
    with_each(|peer| {
        let mut client = peer.client(gateway.port, SCOPE);
        let id = client.start("gripper", "finger", "3");
        let end = client.end(id);
        assert_eq!(end.number, COMPLETED, "{end:?}");
        let id = client.start("gripper", "finger", "100");
        assert_eq!(client.stop(id), ABORTED);
        let id = client.start("gripper", "finger", "0");
        assert_eq!(client.end(id).number, COMPLETED);
    });
}

#[test]
fn our_client_runs_tasks_on_each_peers_server() {
    with_each(|peer| {
        let server = peer.server();
        let remote = RemoteTask::connect(&server.endpoint(), SCOPE).expect("an address");
        let mut remote = remote.with_timeout(PATIENCE);
        let long = "long ".repeat(20_000);
        for goal in ["with : and ; in it", &long] {
            let id = remote.trigger("test", "echo", goal).expect("taken").id;
            let end = remote.wait(id, Some(PATIENCE)).expect("its end");
            assert_eq!((end.state, end.text.as_str()), (State::Completed, goal));
        }
        let id = remote.trigger("test", "sleep", "5").expect("taken").id;
        until("the task to run", PATIENCE, || {
            let now = remote.status(&id).expect("an answer").state;
            assert!(!now.is_final(), "{now:?}");
            (now == State::Accepted).then_some(())
        });
        let end = remote.wait(id, Some(PATIENCE)).expect("its end");
        assert_eq!((end.state, end.text.as_str()), (State::Completed, "True"));
        let refused = remote.trigger("robot", "echo", "hi");
        assert!(refused.is_err(), "{refused:?}");
        // It is not one of our servers, and our client detects that safely.
        assert_eq!(remote.ask_server("tasks").expect("an answer"), None);
    });
}
