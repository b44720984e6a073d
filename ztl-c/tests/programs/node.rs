//! Firmware in C, driven by the original's client through `ztl gateway`: in a program on the desk, and on a board
//! in QEMU, where what really moves is seen at the board's pins.

use ztl_tests::lab::{
    ABORTED, ACCEPTED, Board, COMPLETED, FAILED, OriginalClient, PATIENCE, Pin, Process, Server,
    until,
};

use crate::build::{Build, ended_well};

/// Waits until the client sees the stage move: it reports two different positions.
#[track_caller]
fn wait_moving(client: &mut OriginalClient, id: i64) {
    let mut first = None;
    until("the stage on its way", PATIENCE, || {
        let answer = client.status(id);
        let moves = answer.number == ACCEPTED && answer.text.ends_with(" mm");
        let from = moves.then(|| first.get_or_insert_with(|| answer.text.clone()))?;
        (*from != answer.text).then_some(())
    });
}

#[track_caller]
fn refuses(client: &mut OriginalClient, component: &str, goal: &str, reason: &str) {
    let answer = client.trigger("desk", component, goal);
    let refused = answer.number <= 0 && answer.text.contains(reason);
    assert!(refused, "{component}:{goal}: {answer:?}");
}

/// The behaviour of every robot of this kind.
#[track_caller]
fn drive(client: &mut OriginalClient) {
    let id = client.start("desk", "stage", "12.5");
    assert_eq!(client.wait(id, 20.0), (COMPLETED, "12.5 mm"));
    refuses(client, "stage", "100.1", "stage takes 0 to 100 mm");
    refuses(client, "stage", "up", "stage takes 0 to 100 mm");
    refuses(client, "lamp", "red", "lamp takes on or off");

    let id = client.start("desk", "stage", "100");
    wait_moving(client, id);
    refuses(client, "stage", "0", "busy with another task");
    let other = client.start("desk", "lamp", "on");
    assert_eq!(client.wait(other, 20.0), (COMPLETED, "on"));
    assert_eq!(client.abort(id).number, ABORTED);
    let answer = client.status(id);
    assert!(
        answer.number == ABORTED && answer.text.ends_with(" mm"),
        "{answer:?}"
    );
}

#[track_caller]
pub(crate) fn on_the_desk(build: Build) {
    let process = Process::start(&mut build.node("examples/c/firmware", &["desk.c", "robot.c"]));
    let line = process.wait_for("desk at ");
    let device = line.replace("desk at ", "desk=tcp:");
    let gateway = Server::gateway(&[&device]);
    gateway.wait_ready("desk");
    drive(&mut gateway.original_client());
    process.wait_for("stage at 125");
    process.wait_for("lamp on");
    drop(gateway);
    process.signal("TERM");
    ended_well(process);
}

#[track_caller]
pub(crate) fn misused(build: Build) {
    let mut program = build.node("ztl-c/tests/c", &["node_border.c"]);
    assert_eq!(ended_well(Process::start(&mut program)), "all is said\n");
}

/// A board with the firmware in C, the gateway and a client.
#[track_caller]
fn board(image: &str) -> (Board, Server, OriginalClient) {
    let board = Board::with_image("lm3s6965evb", image);
    let gateway = Server::gateway(&[&board.device()]);
    gateway.wait_ready("desk");
    let client = gateway.original_client();
    (board, gateway, client)
}

/// Waits until a pin says so.
#[track_caller]
fn wait_pin(board: &Board, pin: Pin, value: u32) {
    until("a pin", PATIENCE, || {
        (board.read(pin) == value).then_some(())
    });
}

#[test]
fn c_firmware_drives_the_boards_pins_for_the_originals_client() {
    let (board, _gateway, mut client) = board("lm3s6965evb-c");
    drive(&mut client);
    assert_eq!(board.read(Pin::Lamp), 1);
    assert!(board.read(Pin::Place) > 125);

    // An emergency stop stays until the firmware ends it. The way takes 4 s, so the stop comes before its end.
    let id = client.start("desk", "stage", "100");
    wait_moving(&mut client, id);
    board.write(Pin::Stop, 1);
    let answer = client.wait(id, 20.0);
    assert_eq!(answer, (ABORTED, "emergency stop"));
    assert_eq!(board.read(Pin::Lamp), 0);
    refuses(&mut client, "lamp", "on", "emergency stop");
    board.write(Pin::Stop, 0);
    refuses(&mut client, "lamp", "on", "emergency stop");
    board.write(Pin::Resume, 1);
    until("the end of the stop", PATIENCE, || {
        (client.trigger("desk", "lamp", "on").number > 0).then_some(())
    });
    wait_pin(&board, Pin::Lamp, 1);
    let used = board.stack_used();
    println!("stack used: {used} bytes");
    assert!(used <= 1536, "the stack took {used} bytes");
}

#[test]
fn c_firmware_handles_resets_and_a_lost_link() {
    let (board, mut gateway, mut client) = board("lm3s6965evb-cpp");
    let id = client.start("desk", "stage", "100");
    wait_moving(&mut client, id);
    board.reset();
    let answer = client.wait(id, 20.0);
    assert!(
        answer.number == FAILED && answer.text.contains("reset"),
        "{answer:?}"
    );
    let id = until("the board serves again", PATIENCE, || {
        let answer = client.trigger("desk", "stage", "100");
        (answer.number > 0).then_some(answer.number)
    });
    wait_moving(&mut client, id);

    // The stage stops by itself.
    gateway.process.kill();
    let mut last = board.read(Pin::Place);
    until("the stage at rest", PATIENCE, || {
        std::thread::sleep(std::time::Duration::from_millis(300));
        let place = board.read(Pin::Place);
        (std::mem::replace(&mut last, place) == place).then_some(())
    });
    assert!(last < 1000, "it went on to its goal");
}
