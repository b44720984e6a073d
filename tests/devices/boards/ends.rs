//! How tasks begin and end.

use ztl_tests::lab::{ABORTED, ACCEPTED, COMPLETED, FAILED, PATIENCE, Pin, until};

use super::rig::{Rig, STEPS};

pub(crate) fn completes(board: &str) {
    let mut rig = Rig::start(board);
    assert_eq!(rig.board.read(Pin::Pulse), 0, "nobody has moved it");
    // It takes less than a second. If a busy machine sees too little of it, once more.
    until("the gripper on its way", PATIENCE, || {
        let id = rig.client.start("desk", "gripper", "90");
        let mut way = Vec::new();
        let end = until("its end", PATIENCE, || {
            let answer = rig.client.status(id);
            if answer.number != ACCEPTED {
                return Some(answer);
            }
            way.extend(answer.text.parse::<f32>());
            None
        });
        assert_eq!(end, (COMPLETED, "90.0"));
        println!("{way:?}");
        assert!(way.is_sorted(), "{way:?}");
        assert_eq!(rig.board.read(Pin::Pulse), 2000);
        // At the start, the firmware assumes it at 45 degrees.
        let between = way.iter().filter(|&&at| at > 45.0 && at < 90.0).count();
        if between < 3 {
            let back = rig.client.start("desk", "gripper", "45");
            assert_eq!(rig.client.end(back), (COMPLETED, "45.0"));
        }
        (between >= 3).then_some(())
    });

    let id = rig.client.start("desk", "lamp", "pulse 300");
    until("light", PATIENCE, || {
        (rig.board.read(Pin::Lamp) == 1).then_some(())
    });
    assert_eq!(rig.client.end(id), (COMPLETED, "off"));
    assert_eq!(rig.board.read(Pin::Lamp), 0);
}

pub(crate) fn aborts(board: &str) {
    let mut rig = Rig::start(board);
    let home = rig.client.start("desk", "stage", "home");
    assert_eq!(rig.client.end(home), (COMPLETED, "0.00"));
    let id = rig.start_stage("200", 100);
    assert_eq!(rig.client.stop(id), ABORTED);
    rig.assert_rests();
    let end = rig.client.status(id);
    assert_eq!(end.number, ABORTED);
    // It reports the truth.
    let told: f32 = end.text.parse().expect("a position");
    let place = rig.place() as f32;
    assert!((told * STEPS - place).abs() < 1.0, "{told} and {place}");
    assert!((100.0..200.0 * STEPS).contains(&place), "{place}");
    rig.assert_serves();
}

pub(crate) fn refuses(board: &str) {
    let mut rig = Rig::start(board);
    let gripper = "gripper takes 0 to 90 degrees";
    let stage = "stage takes 0 to 200 mm, or home";
    let lamp = "lamp takes on, off, or pulse 1 to 3600000 ms";
    for (component, goal, right) in [
        ("gripper", "91", gripper),
        ("gripper", "open", gripper),
        ("stage", "-1", stage),
        ("stage", "", stage),
        ("lamp", "blue", lamp),
    ] {
        let reason = format!("'desk:{component}:{goal}' refused: {right}");
        let answer = rig.client.trigger("desk", component, goal);
        assert_eq!(answer, (-1, reason.as_str()));
    }
    let reason = "'desk:arm:1' refused: no component 'arm'; it has: gripper, stage, lamp";
    assert_eq!(rig.client.trigger("desk", "arm", "1"), (-1, reason));
    assert_eq!(rig.board.read(Pin::Pulse), 0, "nothing has moved");

    // A busy component continues its task; the others are free.
    let id = rig.start_stage("200", 10);
    let reason = "'desk:stage:30' refused: busy with another task";
    assert_eq!(rig.client.trigger("desk", "stage", "30"), (-1, reason));
    rig.assert_serves();
    assert_eq!(rig.client.end(id), (COMPLETED, "200.00"));
}

pub(crate) fn reaches_its_limit(board: &str) {
    let mut rig = Rig::start(board);
    assert!(rig.place() > 0, "it starts above its switch");
    let id = rig.client.start("desk", "stage", "home");
    assert_eq!(rig.client.end(id), (COMPLETED, "0.00"));
    assert_eq!(rig.place(), 0);

    let id = rig.client.start("desk", "stage", "190");
    assert_eq!(rig.client.end(id), (COMPLETED, "190.00"));
    assert_eq!(rig.place(), 7600);
    // Something is in the way, and presses the switch.
    let id = rig.start_stage("0", 100);
    rig.board.write(Pin::Limit, 1);
    let end = rig.client.end(id);
    assert_eq!(end.number, FAILED);
    assert!(end.text.starts_with("limit switch at "), "{end:?}");
    rig.assert_rests();
    // Away from the switch it may go.
    let id = rig.client.start("desk", "stage", "200");
    assert_eq!(rig.client.end(id), (COMPLETED, "200.00"));
    assert_eq!(rig.place(), 8000);
}
