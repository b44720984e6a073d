//! Emergency stop, reset and a lost link.

use ztl_tests::lab::{
    ABORTED, Board, COMPLETED, FAILED, PATIENCE, Pin, Process, reserve_port, until, ztl,
};

use super::rig::{Rig, STEPS};

pub(crate) fn stops(board: &str) {
    let mut rig = Rig::start(board);
    rig.assert_serves();
    // The gripper moves for a second. If a busy machine presses the button later, once more.
    let mut goals = ["0", "90"].into_iter().cycle();
    until("both stopped on their way", PATIENCE, || {
        let stage = rig.start_stage("200", 50);
        let gripper = rig.client.start("desk", "gripper", goals.next()?);
        rig.board.write(Pin::Stop, 1);
        let ends = [stage, gripper].map(|id| rig.client.end(id));
        println!("{ends:?}");
        let are_stopped = ends.iter().all(|end| *end == (ABORTED, "emergency stop"));
        if !are_stopped {
            resume(&mut rig);
            let home = rig.client.start("desk", "stage", "home");
            assert_eq!(rig.client.end(home), (COMPLETED, "0.00"));
            rig.assert_serves();
        }
        are_stopped.then_some(())
    });
    rig.assert_rests();
    assert_eq!(rig.board.read(Pin::Lamp), 0, "its safe state");
    let log = rig.wait_logged("emergency stop (", 1);
    assert!(log[0].contains(" WARNING:firmware:desk: ["), "{log:?}");
    let reason = "'desk:lamp:on' refused: emergency stop";
    assert_eq!(rig.client.trigger("desk", "lamp", "on"), (-1, reason));
    // It is latched: that the button is released is not enough.
    rig.board.write(Pin::Stop, 0);
    assert_eq!(rig.client.trigger("desk", "lamp", "on"), (-1, reason));
    resume(&mut rig);
    rig.assert_serves();
    let log = rig.wait_logged("emergency stop is over", 1);
    assert!(log[0].contains(" INFO:firmware:desk: ["), "{log:?}");
}

/// Ends an emergency stop.
#[track_caller]
fn resume(rig: &mut Rig) {
    rig.board.write(Pin::Stop, 0);
    rig.board.write(Pin::Resume, 1);
    until("the end of the emergency stop", PATIENCE, || {
        (rig.client.trigger("desk", "lamp", "off").number > 0).then_some(())
    });
    rig.board.write(Pin::Resume, 0);
}

pub(crate) fn resets(board: &str) {
    let mut rig = Rig::start(board);
    let started = "] desk robot started, boot ";
    rig.wait_logged(started, 1);
    let id = rig.start_stage("200", 50);
    rig.board.reset();
    assert_eq!(rig.client.end(id), (FAILED, "device was reset"));
    rig.assert_rests();
    let log = rig.wait_logged(started, 2);
    let boot = |line: &str| line.split(started).nth(1).map(str::to_owned);
    assert_ne!(boot(&log[0]), boot(&log[1]), "{log:?}");
    until("the device again", PATIENCE, || {
        (rig.client.trigger("desk", "lamp", "off").number > 0).then_some(())
    });
    rig.assert_serves();
}

pub(crate) fn loses_its_link(board: &str) {
    let board = Board::start(board);
    let (near, far) = (reserve_port(), board.port);
    let plug = || {
        let ends = [format!("tcp-listen:{near}"), format!("tcp:127.0.0.1:{far}")];
        let line = Process::start(ztl().arg("line").args(ends));
        line.wait_for("Seed ");
        line
    };
    let mut line = plug();
    let mut rig = Rig::with(board, &format!("desk=tcp:127.0.0.1:{near}"));
    let id = rig.start_stage("200", 50);
    line.kill();
    // The node stops by itself: no client can reach it.
    let place = rig.wait_rest();
    assert!(place < 200 * STEPS as u32, "it has gone all the way");
    let _plugged = plug();
    let end = rig.client.end(id);
    assert_eq!(end.number, FAILED);
    let reasons = ["device is not answering", "link was lost"];
    assert!(reasons.contains(&end.text.as_str()), "{end:?}");
    until("the device again", PATIENCE, || {
        (rig.client.trigger("desk", "lamp", "off").number > 0).then_some(())
    });
    rig.assert_serves();
}
