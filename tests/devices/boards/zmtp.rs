//! Firmware that serves ZeroMQ itself: the original's client talks to the board directly, over the serial port, and over
//! Ethernet, TCP and the board's own network stack.

use std::io::{Read, Write};
use std::net::TcpStream;

use ztl_tests::lab::{
    ABORTED, ACCEPTED, Board, COMPLETED, OriginalClient, PATIENCE, Pin, Process, REJECTED,
    our_client, until,
};

use super::stack;

const BOARD: &str = "lm3s6965evb";
const SCOPE: &str = "/lab";

fn serial() -> Board {
    Board::with_image(BOARD, "lm3s6965evb-zmtp")
}

fn ethernet() -> Board {
    Board::with_network(BOARD, "lm3s6965evb-ethernet", 7002)
}

/// Where the stage really is.
fn place(board: &Board) -> f32 {
    board.read(Pin::Place) as f32 / 40.0
}

/// Tasks end in each way, as a client and the pins see it.
fn drive(board: &Board, client: &mut OriginalClient) {
    let id = client.start("desk", "stage", "home");
    assert_eq!(client.end(id), (COMPLETED, "0.00"));
    assert_eq!(client.status(id), (COMPLETED, "0.00"));
    assert_eq!(client.abort(id), (COMPLETED, "False"), "an end is an end");

    let id = client.start("desk", "stage", "200");
    until("the stage on its way", PATIENCE, || {
        (place(board) > 2.0).then_some(())
    });
    assert_eq!(client.status(id).number, ACCEPTED);
    let busy = client.trigger("desk", "stage", "100");
    assert_eq!(busy, (-1, "busy with another task"));
    assert_eq!(client.stop(id), ABORTED);
    let end = client.status(id);
    assert_eq!(end.number, ABORTED);
    let told: f32 = end.text.parse().expect("a position");
    assert!(
        (told - place(board)).abs() < 0.05,
        "{told}, {}",
        place(board)
    );

    for (handler, component, goal, reason) in [
        ("desk", "stage", "999", "stage takes 0 to 200 mm, or home"),
        (
            "desk",
            "arm",
            "1",
            "no component 'arm'; it has: gripper, stage, lamp",
        ),
        ("table", "stage", "1", "no device 'table'; this is desk"),
    ] {
        assert_eq!(client.trigger(handler, component, goal), (-1, reason));
    }
    let task = client.trigger("desk", "lamp", "on");
    let told = format!(
        "Initiated task '{}' with request: {{'handler': 'desk', 'component': 'lamp', 'goal': 'on'}}",
        task.number
    );
    assert_eq!(task.text, told);
    assert_eq!(client.end(task.number), (COMPLETED, "on"));
    assert_eq!(board.read(Pin::Lamp), 1);
}

#[test]
fn over_serial_tasks_are_completed_aborted_and_rejected() {
    let board = serial();
    let mut client = OriginalClient::connect(board.port, SCOPE);
    drive(&board, &mut client);
}

#[test]
fn over_serial_the_next_client_is_served_after_any_unfinished_stream() {
    let board = serial();
    let task = {
        let mut client = OriginalClient::connect(board.port, SCOPE);
        client.start("desk", "stage", "40")
    };
    for _ in 0..10 {
        let mut client = OriginalClient::connect(board.port, SCOPE);
        let number = client.status(task).number;
        assert!([ACCEPTED, COMPLETED].contains(&number), "{number}");
    }
    let mut client = OriginalClient::connect(board.port, SCOPE);
    assert_eq!(client.end(task), (COMPLETED, "40.00"));
}

/// `ztl task-client` ten times, each time a new client, where there are places for fewer.
#[track_caller]
fn drive_by_command(port: u16) {
    for goal in ["on", "off"].into_iter().cycle().take(10) {
        let mut client = our_client();
        client.args(["--exit-status", "-r", "127.0.0.1", "-s", SCOPE, "-p"]);
        client.arg(port.to_string());
        let ended = Process::run(client.arg(format!("desk:lamp:{goal}")));
        assert_eq!(ended.code, Some(0), "{ended:?}");
    }
}

#[test]
fn a_board_serves_more_clients_in_a_minute_than_it_has_records() {
    drive_by_command(serial().port);
    drive_by_command(ethernet().network);
    // It has one record.
    drive_by_command(Board::with_image("microbit", "microbit-zmtp").port);
}

#[test]
fn after_a_reset_old_ids_are_unknown_and_the_board_serves_again() {
    let board = serial();
    let task = {
        let mut client = OriginalClient::connect(board.port, SCOPE);
        client.start("desk", "stage", "home")
    };
    board.reset();
    let mut client = OriginalClient::connect(board.port, SCOPE);
    let gone = format!("Invalid ID '{task}'");
    assert_eq!(client.status(task), (REJECTED, gone.as_str()));
    drive(&board, &mut client);
}

#[test]
fn over_ethernet_tasks_are_completed_aborted_and_rejected() {
    let board = ethernet();
    let mut client = OriginalClient::connect(board.network, SCOPE);
    drive(&board, &mut client);
}

#[test]
fn over_ethernet_a_third_client_waits_until_one_of_two_disconnects() {
    let board = ethernet();
    let mut one = OriginalClient::connect(board.network, SCOPE);
    let mut two = OriginalClient::connect(board.network, SCOPE);
    let stage = one.start("desk", "stage", "home");
    let gripper = two.start("desk", "gripper", "90");
    // Either sees the other's task.
    assert_eq!(two.end(stage), (COMPLETED, "0.00"));
    assert_eq!(one.end(gripper), (COMPLETED, "90.0"));
    assert_eq!(two.status(gripper), (COMPLETED, "90.0"));

    // The original's client gives up after 2 s.
    let mut three = OriginalClient::connect(board.network, SCOPE);
    assert_eq!(
        three.wait(stage, 2.0).text,
        "Again('Resource temporarily unavailable')"
    );
    assert_eq!(one.status(stage), (COMPLETED, "0.00"));
    drop(two);
    until("a place for the third", PATIENCE, || {
        (three.wait(stage, 2.0) == (COMPLETED, "0.00")).then_some(())
    });
    assert_eq!(one.status(stage), (COMPLETED, "0.00"));
}

#[test]
fn over_ethernet_connections_that_do_not_speak_zmtp_affect_no_client() {
    let board = ethernet();
    let mut client = OriginalClient::connect(board.network, SCOPE);
    let id = client.start("desk", "gripper", "90");
    assert_eq!(client.end(id), (COMPLETED, "90.0"));
    let greeting = b"\xFF\0\0\0\0\0\0\0\x01\x7F\x03\x01NULL\0\0\0\0\0\0";
    for bytes in [
        &b"GET / HTTP/1.1\r\n\r\n"[..],
        greeting,
        &[0xFF; 3000],
        &[0x00; 3000],
        b"",
    ] {
        for _ in 0..10 {
            let stream = TcpStream::connect(("127.0.0.1", board.network));
            // The board may have closed it already.
            let _ = stream.expect("a connection").write_all(bytes);
        }
        assert_eq!(client.status(id), (COMPLETED, "90.0"));
    }
    until("a place for another", PATIENCE, || {
        let mut other = OriginalClient::connect(board.network, SCOPE);
        (other.wait(id, 2.0) == (COMPLETED, "90.0")).then_some(())
    });
}

#[test]
fn over_ethernet_idle_connections_are_closed_to_free_their_slots() {
    let board = ethernet();
    let mut client = OriginalClient::connect(board.network, SCOPE);
    let id = client.start("desk", "lamp", "on");
    assert_eq!(client.end(id), (COMPLETED, "on"));
    drop(client);
    // They have both places, and say nothing. The board closes them; they do not.
    let _streams = [(); 2].map(|()| {
        until("a place", PATIENCE, || {
            let mut stream = TcpStream::connect(("127.0.0.1", board.network)).ok()?;
            stream.set_read_timeout(Some(PATIENCE)).ok()?;
            let mut partial = [0; 11];
            stream.read_exact(&mut partial).ok()?;
            Some(stream)
        })
    });
    // 20 s of the board's time: 5 for the greeting, 15 for the end. Its clock is slow if the machine is busy.
    until("a place for a client", 9 * PATIENCE, || {
        let mut other = OriginalClient::connect(board.network, SCOPE);
        (other.wait(id, 2.0) == (COMPLETED, "on")).then_some(())
    });
}

#[test]
fn over_ethernet_an_emergency_stop_ends_all_tasks_and_is_latched() {
    let board = ethernet();
    let mut client = OriginalClient::connect(board.network, SCOPE);
    let id = client.start("desk", "stage", "200");
    board.write(Pin::Stop, 1);
    assert_eq!(client.end(id), (ABORTED, "emergency stop"));
    board.write(Pin::Stop, 0);
    assert_eq!(client.trigger("desk", "lamp", "on"), (-1, "emergency stop"));
    board.write(Pin::Resume, 1);
    until("the end of the emergency", PATIENCE, || {
        (client.trigger("desk", "lamp", "on").number > 0).then_some(())
    });
}

#[test]
fn stack_use_with_a_network_stack_matches_the_record() {
    stack::of_the_networked_robot();
}

#[test]
fn stack_use_of_the_smallest_servers_matches_the_record() {
    stack::of_the_smallest_server("microbit");
    stack::of_the_smallest_server("mps2-an386");
    stack::of_the_bare_port("microbit");
    stack::of_the_bare_port("mps2-an386");
}
