//! The original's Python client, unchanged, drives firmware on boards in QEMU: by ZeroMQ to the process of
//! `ztl gateway`, and from there over the board's serial port.
//!
//! The board's pins show the real motion.

mod button;
mod described;
mod ends;
mod faults;
mod parameters;
mod rig;
mod stack;
mod zmtp;

use ztl_tests::lab::{Board, COMPLETED, PATIENCE, Pin, Server, until};

/// Each test on each board.
macro_rules! boards {
    ($($module:ident: $board:literal),+) => {
        $(mod $module {
            const BOARD: &str = $board;

            #[test]
            fn a_task_reports_progress_and_reaches_its_goal() {
                super::ends::completes(BOARD);
            }

            #[test]
            fn an_abort_stops_the_stage_at_its_current_position() {
                super::ends::aborts(BOARD);
            }

            #[test]
            fn an_invalid_goal_is_rejected_with_the_valid_ones() {
                super::ends::refuses(BOARD);
            }

            #[test]
            fn the_limit_switch_stops_the_stage() {
                super::ends::reaches_its_limit(BOARD);
            }

            #[test]
            fn an_emergency_stop_stays_until_the_firmware_ends_it() {
                super::faults::stops(BOARD);
            }

            #[test]
            fn a_reset_fails_the_boards_tasks_and_it_serves_again() {
                super::faults::resets(BOARD);
            }

            #[test]
            fn a_board_stops_without_its_link_and_serves_again_with_it() {
                super::faults::loses_its_link(BOARD);
            }

            #[test]
            fn stack_use_matches_the_record() {
                super::stack::of_the_robot(BOARD);
            }
        })+
    };
}

boards! {
    microbit: "microbit", lm3s6965evb: "lm3s6965evb", mps2_an386: "mps2-an386", sifive_e: "sifive-e"
}

#[test]
fn stack_use_without_a_log_matches_the_record() {
    stack::of_the_quiet_robot();
}

#[test]
fn the_smallest_node_runs_on_the_recorded_stack() {
    stack::of_the_lamp("microbit-smallest");
}

#[test]
fn a_board_on_a_shared_line_serves_tasks_and_disables_its_driver() {
    let board = Board::with_image("microbit", "microbit-bus");
    let line = board.device().replace("desk=tcp:", "arm=rs485:tcp:");
    // Patient, since QEMU answers late on a busy system.
    let gateway = Server::gateway(&[&format!("{line}?wait=200")]);
    gateway.wait_ready("arm.desk");
    let mut client = gateway.original_client();
    let id = client.start("arm.desk", "lamp", "on");
    assert_eq!(client.end(id), (COMPLETED, "on"));
    assert_eq!(board.read(Pin::Lamp), 1);
    // What the GPIO drives, and its third pin.
    let enabled = || board.read_word(0x5000_0504) & 1 << 3 != 0;
    until("the driver disabled between two answers", PATIENCE, || {
        (!enabled()).then_some(())
    });
}

#[test]
fn the_node_to_compare_with_runs_on_the_recorded_stack() {
    stack::of_postcard();
}

#[test]
fn an_async_driver_runs_on_the_recorded_stack() {
    stack::of_the_lamp("microbit-async");
}
