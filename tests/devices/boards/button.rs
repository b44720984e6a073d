//! A lamp that shines while its button is pressed.

use ztl_tests::lab::{Board, PATIENCE, Pin, Process, Server, until, ztl};

#[test]
fn a_button_of_a_board_starts_and_aborts_a_task_that_clients_see_and_abort_as_well() {
    let board = Board::with_image("microbit", "microbit-button");
    let gateway = Server::gateway(&[&board.device()]);
    gateway.wait_ready("desk");
    let port = gateway.port.to_string();
    let shines = |light| {
        until("the lamp shines, or not", PATIENCE, || {
            (board.read(Pin::Lamp) == light).then_some(())
        });
    };
    let listed = |text: &str| {
        until(text, PATIENCE, || {
            let list = Process::run(ztl().args(["ps", "-a", "-p", &port])).stdout;
            list.contains(text).then_some(())
        });
    };
    board.write(Pin::Resume, 1);
    shines(1);
    listed("(by the device)");
    board.write(Pin::Resume, 0);
    shines(0);
    listed("ABORTED");

    // Who holds the button is overruled.
    board.write(Pin::Resume, 1);
    shines(1);
    listed("ACCEPTED");
    let stopped = Process::run(ztl().args(["abort", "--all", "-p", &port]));
    assert_eq!(stopped.code, Some(0), "{stopped:?}");
    shines(0);
    board.write(Pin::Resume, 0);

    // While a client's task runs, the button is refused.
    gateway
        .original_client()
        .start("desk", "lamp", "pulse 60000");
    shines(1);
    board.write(Pin::Resume, 1);
    gateway.process.wait_for("busy with another task");
    assert_eq!(board.read(Pin::Lamp), 1);
}
