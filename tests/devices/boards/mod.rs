//! The original's Python client, unchanged, drives firmware on boards in QEMU: by ZeroMQ to the process of
//! `ztl gateway`, and from there over the board's serial port.
//!
//! What really moves is seen at the board's pins.

mod ends;
mod faults;
mod rig;
mod stack;
mod zmtp;

/// Each test on each board.
macro_rules! boards {
    ($($module:ident: $board:literal),+) => {
        $(mod $module {
            const BOARD: &str = $board;

            #[test]
            fn a_goal_is_reached_and_seen_on_its_way() {
                super::ends::completes(BOARD);
            }

            #[test]
            fn an_abort_stops_the_stage_where_it_is() {
                super::ends::aborts(BOARD);
            }

            #[test]
            fn what_it_does_not_take_is_refused_with_what_would_be_right() {
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
            fn after_a_reset_its_tasks_have_failed_and_it_serves_again() {
                super::faults::resets(BOARD);
            }

            #[test]
            fn without_its_link_it_stops_by_itself_and_serves_again_with_it() {
                super::faults::loses_its_link(BOARD);
            }

            #[test]
            fn it_uses_as_much_stack_as_is_recorded() {
                super::stack::of_the_robot(BOARD);
            }
        })+
    };
}

boards! {
    microbit: "microbit", lm3s6965evb: "lm3s6965evb", mps2_an386: "mps2-an386", sifive_e: "sifive-e"
}

#[test]
fn without_a_log_it_uses_as_much_stack_as_is_recorded() {
    stack::of_the_quiet_robot();
}

#[test]
fn the_smallest_node_serves_on_as_little_stack_as_is_recorded() {
    stack::of_the_smallest_node();
}
