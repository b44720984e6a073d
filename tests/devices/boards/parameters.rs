//! Parameters that a board saves in its flash.

use ztl_tests::lab::{Board, Ended, PATIENCE, Process, Server, until, ztl};

#[track_caller]
fn param(server: &Server, words: &[&str]) -> Ended {
    let port = server.port.to_string();
    Process::run(ztl().arg("param").args(words).args(["-p", &port]))
}

#[test]
fn a_board_keeps_saved_parameters_over_a_reset_and_loses_others() {
    let board = Board::with_image("microbit", "microbit-flash");
    let gateway = Server::gateway(&[&board.device()]);
    gateway.wait_ready("desk");
    let list = |text: &str| {
        until(text, PATIENCE, || {
            let list = param(&gateway, &["list", "desk"]).stdout;
            list.contains(text).then_some(list)
        })
    };
    list("gain   1 1/s   0 to 10           default");
    // More changes than fit a page of 1 KiB.
    for round in 0..60 {
        let gain = (f64::from(round) / 8.0).to_string();
        assert_eq!(
            param(&gateway, &["set", "desk", "gain", &gain]).code,
            Some(0)
        );
        let saved = param(&gateway, &["save", "desk"]);
        assert_eq!(saved.stdout, "desk: saved\n", "{saved:?}");
    }
    assert_eq!(
        param(&gateway, &["set", "desk", "label", "left arm"]).code,
        Some(0)
    );
    list("label  'left arm'");
    board.reset();
    list("label  'desk'");
    let told = param(&gateway, &["get", "desk", "gain"]);
    assert_eq!(told.stdout, "7.375\n", "{told:?}");
}
