use std::io::Read;
use std::sync::mpsc::Receiver;

use ztl_core::link::{BusMessage, Turn};
use ztl_link::bus::TURNAROUND;

use super::*;

fn worker() -> (Worker, Receiver<Input>) {
    let (inputs, inbox) = channel();
    let opener = Opener {
        label: "rs485:test".to_owned(),
        baud: None,
        may_be_half_open: false,
        path: None,
        seat: None,
        open: Arc::new(|| Err(io::ErrorKind::NotFound.into())),
    };
    let mut worker = Worker::new(
        "arm",
        opener,
        Bus::new(115_200, TURNAROUND),
        Ports::new(inputs),
        LineStatus::default(),
        Box::new(|_, _, _| Ok(())),
    );
    worker.line = LineState::Open(Box::new(io::sink()));
    (worker, inbox)
}

fn problem(worker: &Worker) -> Option<String> {
    worker.status.lock().problem.clone()
}

#[test]
fn a_search_without_an_answer_says_nothing_while_a_node_answers() {
    let (mut worker, _inbox) = worker();
    worker.bus.add(Instant::ZERO, 4);
    let later = now() + Duration::from_secs(1);
    assert!(worker.bus.poll_transmit(later).is_some());
    worker.bus.handle_bytes(later, &Turn::Idle.encode(4));
    worker.on_found(&[], NOTHING);
    assert_eq!(problem(&worker), None);
    worker.bus.remove(4);
    for _ in 1..TELL {
        worker.on_found(&[], NOTHING);
        assert_eq!(problem(&worker), None);
    }
    worker.on_found(&[], NOTHING);
    assert_eq!(problem(&worker).as_deref(), Some(NOTHING));
}

#[test]
fn a_port_that_is_closed_says_why() {
    let (mut worker, _inbox) = worker();
    let why = |line: &mut Line| {
        let end = line.reader.read(&mut [0; 8]);
        end.expect_err("it is closed").to_string()
    };
    let seat = Arc::<Seat>::default();
    seat.set_address(4);
    let mut open = || worker.open_port(Arc::clone(&seat)).expect("a port");
    let (mut first, mut second) = (open(), open());
    assert_eq!(why(&mut first), "another node is served at its address now");
    worker.close_port(4, "it has moved");
    assert_eq!(why(&mut second), "it has moved");
    let mut third = worker.open_port(seat).expect("a port");
    let number = worker.number;
    worker.on_closed(&io::Error::other("unplugged"));
    assert_eq!(why(&mut third), "unplugged");
    // The reading thread ends later.
    let ended = io::Error::new(io::ErrorKind::UnexpectedEof, "the other end has closed it");
    worker.on_input(Input::Line(number, LineEvent::Closed(ended)));
    assert_eq!(problem(&worker).as_deref(), Some("unplugged"));
    // It was found while writing.
    worker.on_closed(&io::ErrorKind::BrokenPipe.into());
    let closed = "the other end has closed it";
    assert_eq!(problem(&worker).as_deref(), Some(closed));
}

#[test]
fn a_node_that_moves_closes_its_own_port_only() {
    let (mut worker, _inbox) = worker();
    let found = |id, address| Found {
        id,
        address,
        name: format!("n{id}"),
    };
    worker.on_found(&[found(1, 4)], NOTHING);
    // It is not heard beside another one at its address, which is served there.
    worker.on_found(&[found(2, 4)], NOTHING);
    let seat = |worker: &Worker, id| Arc::clone(&worker.nodes.of_id(id).expect("a node").seat);
    let second = seat(&worker, 2);
    let _line = worker.open_port(Arc::clone(&second)).expect("a port");
    worker.on_found(&[found(1, 5), found(2, 4)], NOTHING);
    assert!(worker.ports.has(4, &second));
    let first = seat(&worker, 1);
    let _line = worker.open_port(Arc::clone(&first)).expect("a port");
    worker.on_found(&[found(1, 6), found(2, 4)], NOTHING);
    assert!(!worker.ports.has(5, &first));
}

#[test]
fn a_node_takes_no_tasks_while_its_id_is_heard_at_two_addresses() {
    let (mut worker, _inbox) = worker();
    let seat = Arc::<Seat>::default();
    seat.set_address(4);
    let _line = worker.open_port(Arc::clone(&seat)).expect("a port");
    for address in [4, 3] {
        worker.drive();
        assert_eq!(seat.conflict(), None);
        let mut frame = [0; 32];
        let here = BusMessage::Here { id: 7, name: "arm" };
        let len = here.encode(address, &mut frame).expect("it fits");
        worker.bus.handle_bytes(Instant::ZERO, &frame[..len]);
    }
    worker.drive();
    assert!(seat.conflict().is_some());
}

#[test]
fn answers_that_are_damaged_are_told_once_until_they_are_intact_or_not_asked_for() {
    let (mut worker, _inbox) = worker();
    let found = |id| Found {
        id,
        address: 4,
        name: format!("n{id}"),
    };
    worker.on_found(&[found(1)], NOTHING);
    let seat = Arc::clone(&worker.nodes.of_id(1).expect("a node").seat);
    let _line = worker.open_port(Arc::clone(&seat)).expect("a port");
    worker.on_event(BusEvent::Garbled(4));
    assert_eq!(worker.damaged[&4], "n1");
    // Its device opens the port again, and the line knows it as damaged.
    let _line = worker.open_port(Arc::clone(&seat)).expect("a port");
    let mut garbled = 0;
    for second in 1..10 {
        let at = now() + Duration::from_secs(second);
        worker.bus.poll_transmit(at).expect("a question");
        worker.bus.handle_bytes(at, &[1, 2, 3, 0]);
        while let Some(event) = worker.bus.poll_event() {
            garbled += u32::from(event == BusEvent::Garbled(4));
        }
    }
    assert_eq!(garbled, 0);
    worker.on_found(&[found(1)], NOTHING);
    assert!(worker.damaged.contains_key(&4));
    worker.on_found(&[found(1), found(2)], NOTHING);
    assert!(worker.damaged.is_empty());
}

#[test]
fn one_search_is_for_all_nodes_that_ask_for_one() {
    let (mut worker, _inbox) = worker();
    let mut lines = Vec::new();
    for address in [4, 5] {
        let seat = Arc::<Seat>::default();
        seat.set_address(address);
        seat.want_search();
        lines.push(worker.open_port(seat).expect("a port"));
    }
    assert!(worker.ports.want_search());
    assert!(!worker.ports.want_search());
}

#[test]
fn each_mistake_is_logged_once_while_it_lasts() {
    let (mut worker, _inbox) = worker();
    let found = |id, address| Found {
        id,
        address,
        name: format!("n{id}"),
    };
    let told = |worker: &mut Worker, all: &[Found]| {
        worker.told_ready = true;
        worker.on_found(all, NOTHING);
        !worker.told_ready
    };
    let (one, two) = ([found(1, 4), found(2, 4)], [found(3, 5), found(4, 5)]);
    assert!(told(&mut worker, &one));
    assert!(!told(&mut worker, &one[..1]));
    assert!(told(&mut worker, &[one.clone(), two.clone()].concat()));
    assert!(!told(&mut worker, &one));
    assert!(!told(&mut worker, &[two, one].concat()));
}
