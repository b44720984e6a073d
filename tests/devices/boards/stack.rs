//! How much stack the images use.

use std::io::{Read, Write};
use std::net::TcpStream;

use ztl_tests::lab::{ABORTED, Board, COMPLETED, OriginalClient, PATIENCE, Pin, Server, until};

use super::rig::Rig;

/// Has a table of images and bytes between marks.
const README: &str = include_str!("../../../examples/firmware/README.md");

/// The stack use of an interrupt at the deepest point: its exception frame and its handler's.
const INTERRUPT: u64 = 128;

/// Less than that below the record is not worth a new record.
const TOLERANCE: u64 = 64;

/// Compares with the record.
#[track_caller]
fn check(image: &str, board: &Board) {
    let (_, table) = README.split_once("<!-- stacks -->").expect("a table");
    let mut rows = table
        .lines()
        .map(|row| row.split('|').map(str::trim).collect());
    let row = rows.find(|row: &Vec<&str>| row.get(1) == Some(&format!("`{image}`").as_str()));
    let row = row.unwrap_or_else(|| panic!("no row for {image}"));
    let known: u64 = row[2].trim_end_matches(" bytes").parse().expect("bytes");
    let used = board.stack_used();
    println!("{image}: {used} bytes of stack, {known} recorded");
    assert!(
        (known - TOLERANCE..=known + INTERRUPT).contains(&used),
        "{image} uses {used} bytes of stack; examples/firmware/README.md says {known}"
    );
}

/// After all that a robot does.
pub(crate) fn of_the_robot(board: &str) {
    let rig = Rig::start(board);
    rig.wait_logged("desk robot started", 1);
    do_all(board, rig);
}

pub(crate) fn of_the_quiet_robot() {
    let image = "microbit-quiet";
    let board = Board::with_image("microbit", image);
    let device = board.device();
    do_all(image, Rig::quiet(board, &device));
}

fn do_all(image: &str, mut rig: Rig) {
    let home = rig.client.start("desk", "stage", "home");
    let gripper = rig.client.start("desk", "gripper", "90");
    assert_eq!(rig.client.end(home), (COMPLETED, "0.00"));
    assert_eq!(rig.client.end(gripper), (COMPLETED, "90.0"));
    assert_eq!(rig.client.trigger("desk", "stage", "9999").number, -1);
    let id = rig.start_stage("200", 100);
    assert_eq!(rig.client.stop(id), ABORTED);
    // The way back then takes 5 s, in which the button is pressed.
    let id = rig.client.start("desk", "stage", "200");
    assert_eq!(rig.client.end(id), (COMPLETED, "200.00"));
    let id = rig.start_stage("0", 10);
    rig.board.write(Pin::Stop, 1);
    assert_eq!(rig.client.end(id), (ABORTED, "emergency stop"));
    check(image, &rig.board);
}

/// The lamp: `microbit-smallest`, or the same with an async driver.
pub(crate) fn of_the_lamp(image: &str) {
    let board = Board::with_image("microbit", image);
    let gateway = Server::gateway(&[&board.device()]);
    gateway.wait_ready("desk");
    do_with_lamp(image, &board, gateway.original_client());
}

/// The robot with a network stack.
pub(crate) fn of_the_networked_robot() {
    let image = "lm3s6965evb-ethernet";
    let board = Board::with_network("lm3s6965evb", image, 7002);
    let mut clients = [(); 2].map(|()| OriginalClient::connect(board.network, "/lab"));
    for client in &mut clients {
        let id = client.start("desk", "gripper", "90");
        assert_eq!(client.end(id), (COMPLETED, "90.0"));
        assert_eq!(client.trigger("desk", "stage", "9999").number, -1);
        let id = client.start("desk", "stage", "200");
        assert_eq!(client.stop(id), ABORTED);
    }
    check(image, &board);
}

/// The lamp without a gateway.
pub(crate) fn of_the_smallest_server(board: &str) {
    let image = format!("{board}-zmtp");
    let board = Board::with_image(board, &image);
    let client = OriginalClient::connect(board.port, "/lab");
    do_with_lamp(&image, &board, client);
}

/// The baseline: an echo.
pub(crate) fn of_the_bare_port(board: &str) {
    let image = format!("{board}-uart");
    let board = Board::with_image(board, &image);
    let mut stream = TcpStream::connect(("127.0.0.1", board.port)).expect("the serial port");
    stream.set_read_timeout(Some(PATIENCE)).expect("a timeout");
    let mut back = [0; 100];
    stream.write_all(&[0xA5; 100]).expect("sent");
    stream.read_exact(&mut back).expect("what was sent");
    assert_eq!(back, [0xA5; 100]);
    check(&image, &board);
}

/// The lamp by postcard-rpc, which sends every key of one byte: its ping, its schemas, its two endpoints, and others.
pub(crate) fn of_postcard() {
    let image = "microbit-postcard";
    let board = Board::with_image("microbit", image);
    let mut stream = TcpStream::connect(("127.0.0.1", board.port)).expect("the serial port");
    stream.set_read_timeout(Some(PATIENCE)).expect("a timeout");
    for key in 0..=u8::MAX {
        // No length of key and number but one byte each; the body turns the lamp on for 1 ms.
        stream
            .write_all(&stuffed(&[0, key, key, 1, 1]))
            .expect("sent");
        let is_answer = |frame: &[u8]| frame.first() == Some(&0) && frame.get(2) == Some(&key);
        while !is_answer(&unstuffed(&mut stream)) {}
    }
    assert_eq!(board.read(Pin::Lamp), 1);
    check(image, &board);
}

/// A short frame in COBS, with its delimiter.
fn stuffed(frame: &[u8]) -> Vec<u8> {
    let mut bytes = Vec::new();
    for piece in frame.split(|byte| *byte == 0) {
        bytes.push(piece.len() as u8 + 1);
        bytes.extend(piece);
    }
    bytes.push(0);
    bytes
}

/// The next frame.
fn unstuffed(stream: &mut TcpStream) -> Vec<u8> {
    let bytes = std::io::BufReader::with_capacity(1, stream).bytes();
    let bytes = bytes.map(|byte| byte.expect("an answer"));
    let bytes: Vec<u8> = bytes.take_while(|byte| *byte != 0).collect();
    let mut frame = Vec::new();
    let mut rest = bytes.as_slice();
    while let [len, behind @ ..] = rest {
        let (piece, next) = behind.split_at(usize::from(*len) - 1);
        frame.extend(piece);
        if !next.is_empty() {
            frame.push(0);
        }
        rest = next;
    }
    frame
}

fn do_with_lamp(image: &str, board: &Board, mut client: OriginalClient) {
    assert_eq!(client.trigger("desk", "lamp", "blue").number, -1);
    let id = client.start("desk", "lamp", "pulse 3600000");
    until("light", PATIENCE, || {
        (board.read(Pin::Lamp) == 1).then_some(())
    });
    assert_eq!(client.stop(id), ABORTED);
    let id = client.start("desk", "lamp", "on");
    assert_eq!(client.end(id), (COMPLETED, "on"));
    check(image, board);
}
