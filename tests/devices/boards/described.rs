//! The robot whose components say what they are.

use ztl_tests::lab::{Board, PATIENCE, Process, until, ztl};

use super::rig::Rig;

#[test]
fn a_board_describes_its_servo_with_range_and_unit() {
    let board = Board::with_image("microbit", "microbit-described");
    let device = board.device();
    let mut rig = Rig::quiet(board, &device);
    let port = rig.gateway.port.to_string();
    let told = until("the last description", PATIENCE, || {
        let told = Process::run(ztl().args(["describe", "-p", &port])).stdout;
        told.contains("desk:lamp").then_some(told)
    });
    for row in [
        "desk:gripper  a number from 0 to 90 degrees  turns to an angle; returns the commanded angle",
        "desk:lamp     anything                       switches on or off, or on for some ms; for example on or off or pulse 500",
        "desk:stage    anything                       moves to a position; home finds its zero; for example home; returns the position",
    ] {
        assert!(told.contains(row), "{told}");
    }
    rig.assert_serves();
}
