//! The original's Python client, unchanged, drives simulated devices through `ztl gateway`.

use std::time::{Duration, Instant};

use ztl_tests::lab::{ABORTED, ACCEPTED, COMPLETED, OriginalClient, PATIENCE, Server, until};

/// A gateway with devices that are ten times slower than usual, so that a busy machine sees and stops them on their way.
#[track_caller]
fn slow() -> Server {
    let gateway = Server::simulated();
    for device in ["gripper", "head"] {
        gateway.set_speed(device, "speed", 0.1);
    }
    gateway
}

/// Where a running task's device is, or `None` while it is not known.
fn position(client: &mut OriginalClient, id: i64) -> Option<f32> {
    let answer = client.status(id);
    assert_eq!(answer.number, ACCEPTED, "{answer:?}");
    answer.text.parse().ok()
}

#[track_caller]
fn wait_beyond(client: &mut OriginalClient, id: i64, place: f32) -> f32 {
    until("the device has come so far", PATIENCE, || {
        position(client, id).filter(|position| *position > place)
    })
}

#[test]
fn a_task_reports_progress_and_its_final_position() {
    let gateway = slow();
    let mut client = gateway.original_client();
    let start = Instant::now();
    let id = client.start("gripper", "finger", "25");
    let mut way = Vec::new();
    let end = until("its end", PATIENCE, || {
        let answer = client.status(id);
        if answer.number != ACCEPTED {
            return Some(answer);
        }
        way.extend(answer.text.parse::<f32>());
        None
    });
    assert_eq!(end, (COMPLETED, "25.0"));
    // 25 percent at 5 percent a second.
    assert!(start.elapsed() >= Duration::from_millis(4990));
    assert!(way.is_sorted(), "{way:?}");
    let between = way.iter().filter(|&&at| at > 0.0 && at < 25.0).count();
    assert!(between >= 3, "{way:?}");
}

#[test]
fn abort_stops_the_device_at_its_current_position() {
    let gateway = slow();
    let mut client = gateway.original_client();
    let id = client.start("gripper", "finger", "100");
    let seen = wait_beyond(&mut client, id, 1.0);
    assert_eq!(client.stop(id), ABORTED);

    let end = client.status(id);
    assert_eq!(end.number, ABORTED);
    let stopped: f32 = end.text.parse().expect("a position");
    assert!((seen..100.0).contains(&stopped), "{seen}, then {stopped}");
    assert_eq!(client.abort(id), (ABORTED, "False"));

    // One that had gone on would be 5 percent further after a second.
    let told = Instant::now();
    until("a second", PATIENCE, || {
        (told.elapsed() > Duration::from_secs(1)).then_some(())
    });
    let back = client.start("gripper", "finger", "0");
    let at: f32 = until("a position", PATIENCE, || {
        client.status(back).text.parse().ok()
    });
    assert!(at < stopped + 0.1, "{at}");
    assert_eq!(client.end(back), (COMPLETED, "0.0"));
    // Exactly one final state, which never changes.
    assert_eq!(client.status(id), end);
}

#[test]
fn any_client_may_abort() {
    let gateway = slow();
    let mut starter = gateway.original_client();
    let mut other = gateway.original_client();
    let id = starter.start("gripper", "finger", "100");
    wait_beyond(&mut starter, id, 1.0);
    assert_eq!(other.stop(id), ABORTED);
    assert_eq!(starter.end(id).number, ABORTED);
}

#[test]
fn a_goal_out_of_range_is_rejected_with_the_valid_range() {
    let gateway = Server::simulated();
    let mut client = gateway.original_client();
    let finger = "finger takes 0 to 100 percent";
    let pan = "pan takes -90 to 90 degrees, or left, straight, right";
    for (device, component, goal, right) in [
        ("gripper", "finger", "140", finger),
        ("gripper", "finger", "-1", finger),
        ("gripper", "finger", "NaN", finger),
        ("gripper", "finger", "", finger),
        ("gripper", "finger", "4 0", finger),
        ("head", "pan", "up", pan),
        ("head", "pan", "1e9", pan),
    ] {
        let reason = format!("'{device}:{component}:{goal}' refused: {right}");
        let answer = client.trigger(device, component, goal);
        assert_eq!(answer, (-1, reason.as_str()));
    }
    // Nothing has moved: it is already at 0.
    let id = client.start("gripper", "finger", "0");
    let end = until("its end", PATIENCE, || {
        let answer = client.status(id);
        let at: Option<f32> = answer.text.parse().ok();
        assert!(at.is_none_or(|at| at == 0.0), "{answer:?}");
        (answer.number != ACCEPTED).then_some(answer)
    });
    assert_eq!(end, (COMPLETED, "0.0"));
}

#[test]
fn an_unknown_device_is_refused_with_the_known_ones() {
    let gateway = Server::simulated();
    let mut client = gateway.original_client();
    let reason = "no device 'arm'; there are: gripper, head";
    assert_eq!(client.trigger("arm", "finger", "40"), (-1, reason));
    let reason = "'gripper:thumb:40' refused: no component 'thumb'; it has: finger";
    assert_eq!(client.trigger("gripper", "thumb", "40"), (-1, reason));
}

#[test]
fn two_clients_move_two_devices_at_once() {
    let gateway = slow();
    let mut one = gateway.original_client();
    let mut other = gateway.original_client();
    let finger = one.start("gripper", "finger", "40");
    let pan = other.start("head", "pan", "left");
    let first = wait_beyond(&mut one, finger, 0.0);
    let second = wait_beyond(&mut other, pan, 0.0);
    assert!(first < 40.0 && second < 90.0, "{first}, {second}");
    // The first still moves while the second does.
    wait_beyond(&mut one, finger, first);
    assert_eq!(one.end(finger), (COMPLETED, "40.0"));
    assert_eq!(other.end(pan), (COMPLETED, "90.0"));
}

#[test]
fn a_busy_component_rejects_a_second_task_and_continues_the_first() {
    let gateway = slow();
    let mut one = gateway.original_client();
    let mut other = gateway.original_client();
    let finger = one.start("gripper", "finger", "25");
    let reason = "'gripper:finger:20' refused: busy with another task";
    assert_eq!(other.trigger("gripper", "finger", "20"), (-1, reason));
    assert_eq!(one.end(finger), (COMPLETED, "25.0"));
    let finger = other.start("gripper", "finger", "20");
    assert_eq!(other.end(finger), (COMPLETED, "20.0"));
}

#[test]
fn a_stopped_gateway_reports_it_and_exits() {
    let gateway = slow();
    let mut client = gateway.original_client();
    let id = client.start("gripper", "finger", "100");
    wait_beyond(&mut client, id, 1.0);
    gateway.process.signal("INT");
    let end = gateway.process.end(PATIENCE);
    assert_eq!(end.code, Some(0), "{end:?}");
    assert!(end.stdout.contains("Stopped."));
}
