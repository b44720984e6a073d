//! The examples and tests in C, compiled as a stranger would and run against real peers, in each of these
//! ways: as C89, as C++98, with the shared library, under the compiler's sanitizers and under valgrind.

#![cfg(target_os = "linux")]
#![expect(clippy::expect_used, reason = "a test says what is wrong by panicking")]

mod ask;
mod build;
mod cross;
mod docs;
mod misuse;
mod node;
mod serve;
mod symbols;

use build::Build;

/// Each test in each way.
macro_rules! ways {
    ($($module:ident: $build:expr),+) => {
        $(mod $module {
            use super::Build;

            const BUILD: Build = $build;

            #[test]
            fn a_program_serves_the_originals_client_from_its_main_loop() {
                crate::serve::from_its_main_loop(BUILD);
            }

            #[test]
            fn the_originals_client_runs_a_task_on_its_own_thread() {
                crate::serve::on_threads(BUILD);
            }

            #[test]
            fn a_client_reports_every_outcome_at_the_originals_server() {
                crate::ask::reports_every_outcome(BUILD);
            }

            #[test]
            fn an_id_of_any_length_is_text() {
                crate::ask::takes_ids_of_any_length(BUILD);
            }

            #[test]
            fn every_misuse_is_reported_and_nothing_is_freed_too_early() {
                crate::misuse::is_said(BUILD);
            }

            #[test]
            fn many_threads_send_requests_concurrently() {
                crate::misuse::of_many_threads(BUILD);
            }

            #[test]
            fn only_clients_with_an_allowed_key_are_served() {
                crate::misuse::of_keys(BUILD);
            }
        })+
    };
}

/// Each test of a node in each way; there is no shared library.
macro_rules! node_ways {
    ($($module:ident: $build:expr),+) => {
        $(mod $module {
            use super::Build;

            #[test]
            fn firmware_on_a_host_serves_the_originals_client() {
                crate::node::on_the_desk($build);
            }

            #[test]
            fn every_misuse_of_a_node_is_reported_and_noise_is_ignored() {
                crate::node::misused($build);
            }
        })+
    };
}

node_ways! {
    node_c89: Build::C89, node_cpp98: Build::Cpp98, node_sanitized: Build::Sanitized, node_valgrind: Build::Valgrind
}

ways! {
    c89: Build::C89, cpp98: Build::Cpp98, shared: Build::Shared, sanitized: Build::Sanitized, valgrind: Build::Valgrind
}
