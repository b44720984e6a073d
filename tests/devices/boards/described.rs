//! The robot whose components say what they are.

use ztl_tests::lab::Board;

use super::rig::Rig;

#[test]
fn a_board_describes_its_servo_with_range_and_unit() {
    let board = Board::with_image("microbit", "microbit-described");
    let device = board.device();
    let mut rig = Rig::quiet(board, &device);
    rig.gateway.wait_described(&[
        "desk:gripper  a number from 0 to 90 degrees  turns to an angle; returns the commanded angle\n",
        "desk:lamp     anything                       switches on or off, or on for some ms; for example on or off or pulse 500\n",
        "desk:stage    anything                       moves to a position; home finds its zero; for example home; returns the position\n",
    ]);
    rig.assert_serves();
}
