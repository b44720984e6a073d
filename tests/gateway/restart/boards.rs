//! Boards of a shared line that have one address, one after the other: the journal tells them apart.

use super::device::{Deed, Device};
use super::rig::{LONG, ONCE};
use ztl_std::State;
use ztl_tests::lab::{LIMIT, PATIENCE, SCOPE, Scratch, Server, connect, start, status, until, ztl};

/// Frames of more than three searches, each of which asks at least two questions.
const SEARCHES: usize = 14;

/// A gateway of a shared line with this device; its journal is there.
fn gateway(device: &Device, scratch: &Scratch) -> Server {
    let url = format!("arm=rs485:tcp:127.0.0.1:{}?wait=100", device.port);
    let mut command = ztl();
    command.args(["gateway", "-p", "0", "-s", SCOPE, "-d", &url]);
    command.arg("--journal").arg(scratch.path("journal"));
    let server = Server::start(&mut command);
    server.wait_ready("arm.motors");
    server
}

#[test]
fn a_task_that_carries_on_keeps_its_state_when_another_board_has_its_address() {
    let [board, other] = [1, 2].map(|id| Device::on_bus(LONG, id));
    let scratch = Scratch::new();
    let mut first = gateway(&board, &scratch);
    let task = start(
        &mut connect(&first.endpoint()),
        "arm.motors",
        "belt",
        "7 1000",
    );
    first.process.kill();
    drop(first);
    // The same firmware at the same address, but another board.
    let mut second = gateway(&other, &scratch);
    second.process.wait_for("the board with the id 0000000000000002 answers at address 3; the tasks from before are those of the board with the id 0000000000000001");
    let before = other.world().searched;
    until("some searches", PATIENCE, || {
        (other.world().searched >= before + SEARCHES).then_some(())
    });
    let mut client = connect(&second.endpoint());
    let told = client.status(task).expect("an answer");
    assert_eq!(told.state, State::Accepted, "{told:?}");
    // It takes tasks of its own.
    let own = start(&mut client, "arm.motors", "belt", "8 1");
    assert_eq!(client.wait(own, LIMIT), Ok(status(State::Completed, "8")));
    assert_eq!(other.deed("7 1000"), Deed::default());
    second.process.kill();
    drop(second);
    // The first board has finished meanwhile, and tells its outcome.
    let third = gateway(&board, &scratch);
    let end = connect(&third.endpoint()).wait(task, LIMIT);
    assert_eq!(end, Ok(status(State::Completed, "7")));
    assert_eq!(board.deed("7 1000"), ONCE);
}

#[test]
fn a_board_that_was_reset_while_its_gateway_was_gone_is_recognised_by_its_id() {
    let board = Device::on_bus(LONG, 1);
    let scratch = Scratch::new();
    let mut first = gateway(&board, &scratch);
    let task = start(
        &mut connect(&first.endpoint()),
        "arm.motors",
        "belt",
        "7 600000",
    );
    first.process.kill();
    drop(first);
    board.world().reset = true;
    until("the reset", PATIENCE, || {
        (!board.world().reset).then_some(())
    });
    let second = gateway(&board, &scratch);
    let end = connect(&second.endpoint()).wait(task, LIMIT);
    assert_eq!(end, Ok(status(State::Failed, "device was reset")));
}
