//! Runs the examples as their first lines say.

use std::process::Command;
use std::time::{Duration, Instant};

use ztl_std::{RemoteTask, State, TriggerError};
use ztl_tests::lab::{OriginalClient, PATIENCE, Process, SCOPE, Server, example, until};

/// The example `handler`, and its ZeroMQ address.
#[track_caller]
fn handler() -> (Process, String) {
    let handler = Process::start(example("handler").arg("tcp://127.0.0.1:*"));
    let line = handler.wait_for("serving /robot at ");
    let endpoint = line.trim_start_matches("serving /robot at ").to_owned();
    (handler, endpoint)
}

#[test]
fn the_client_drives_the_handler_and_prints_the_documented_output() {
    let (_handler, endpoint) = handler();
    // A busy machine shows less of the way.
    let ended = until("more than five lines of the way", PATIENCE, || {
        let start = Instant::now();
        let ended = Process::run(example("client").arg(&endpoint));
        assert_eq!(ended.code, Some(0), "{ended:?}");
        // It drives for two seconds and reports its progress.
        assert!(start.elapsed() > Duration::from_secs(2));
        (ended.stdout.lines().count() > 2 + 5).then_some(ended)
    });
    let lines: Vec<&str> = ended.stdout.lines().collect();
    let [first, way @ .., last] = lines.as_slice() else {
        panic!("{ended:?}");
    };
    assert_eq!((*first, *last), ("started", "COMPLETED: arrived"));
    let percent: Vec<u32> = way
        .iter()
        .filter_map(|line| {
            line.strip_prefix("… ")?
                .strip_suffix(" percent")?
                .parse()
                .ok()
        })
        .collect();
    assert!(percent.is_sorted_by(|one, next| one < next), "{way:?}");
    // At most the first reply comes before the task reported progress.
    assert!(percent.len() + 1 >= way.len(), "{way:?}");
}

#[test]
fn the_handler_rejects_unsupported_tasks_and_stops_on_request() {
    let (_handler, endpoint) = handler();
    let remote = RemoteTask::connect(&endpoint, "/robot").expect("an address");
    let mut remote = remote.with_timeout(PATIENCE);
    for (component, goal, reason) in [
        ("base", "up", "no goal 'up'; base takes: forward"),
        ("arm", "up", "no component 'arm'; it has: base"),
    ] {
        let refused = TriggerError::Rejected {
            id: (-1).into(),
            reason: format!("Controller threw exception: {reason}"),
        };
        assert_eq!(remote.trigger("robot", component, goal), Err(refused));
    }
    // A busy machine may be so late that it has arrived.
    let end = until("it is stopped on its way", PATIENCE, || {
        let id = remote
            .trigger("robot", "base", "forward")
            .expect("taken")
            .id;
        until("it has come some way", PATIENCE, || {
            let status = remote.status(&id).expect("an answer");
            let is_on_its_way = status.text.ends_with(" percent") && status.text != "0 percent";
            (is_on_its_way || status.state.is_final()).then_some(())
        });
        remote.abort(&id).expect("an answer");
        let end = remote.wait(&id, Some(PATIENCE)).expect("its end");
        (end.state == State::Aborted).then_some(end)
    });
    assert!(end.text.starts_with("stopped at "), "{end:?}");
}

#[test]
fn the_client_reports_a_missing_handler() {
    let nobody = format!("tcp://127.0.0.1:{}", ztl_tests::lab::reserve_port());
    let ended = Process::run(example("client").arg(&nobody));
    assert_eq!(ended.code, Some(1), "{ended:?}");
    assert_eq!(ended.stdout, "");
    assert!(ended.stderr.contains("NotConnected"), "{ended:?}");
}

#[test]
fn the_example_component_runs_behind_a_gateway() {
    let mut command: Command = example("component");
    let component = Process::start(command.arg("127.0.0.1:0"));
    let line = component.wait_for("waiting for a gateway at tcp:");
    let address = line.trim_start_matches("waiting for a gateway at ");
    let gateway = Server::gateway(&[&format!("desk={address}")]);
    gateway.wait_ready("desk");

    let mut client: OriginalClient = gateway.original_client();
    let id = client.start("desk", "lamp", "on");
    assert_eq!(client.end(id), (5, "on"));
    component.wait_for("lamp on");
    let reason = "'desk:lamp:dim' refused: lamp takes on or off";
    assert_eq!(client.trigger("desk", "lamp", "dim"), (-1, reason));
    let id = client.start("desk", "lamp", "off");
    assert_eq!(client.end(id), (5, "off"));
    component.wait_for("lamp off");

    // Its loop accepts the next gateway when this one disconnects.
    drop(gateway);
    let gateway = Server::gateway(&[&format!("desk={address}")]);
    gateway.wait_ready("desk");
    let mut client = OriginalClient::connect(gateway.port, SCOPE);
    let id = client.start("desk", "lamp", "on");
    assert_eq!(client.end(id), (5, "on"));
}
