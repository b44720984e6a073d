//! Many held answers on one connection. Answers that are never read are in `hostile.rs`.

use ztl_std::State;
use ztl_tests::lab::{LIMIT, PATIENCE, SCOPE, start, until};

use super::{Kind, MEMORY, Subject};
use crate::socket::Socket;

/// Requests held on one connection.
const HELD: usize = 250;

/// All held requests are answered with the final state of their task, when it ends.
fn every_held_answer_arrives(kind: Kind, reads_afterwards: bool) {
    let subject = Subject::start(kind, None, &[]);
    let mut remote = subject.client();
    // Shorter than a request is held; the finger moves there and back.
    let mut goals = match kind {
        Kind::Gateway => ["50", "0"],
        _ => ["1", "1"],
    }
    .into_iter()
    .cycle();
    // A machine that stalls for the two seconds of holding gets the same answers, but earlier.
    until("they are answered when the task ends", PATIENCE, || {
        let endpoint = subject.server.endpoint();
        let dealer = Socket::prepared(zmq::DEALER, &endpoint, PATIENCE, |dealer| {
            if reads_afterwards {
                dealer.set_rcvhwm(1).unwrap();
            }
        });
        let [handler, component, _] = subject.task;
        let id = start(
            &mut remote,
            handler,
            component,
            goals.next().unwrap_or_default(),
        );
        let client = [&b"ztl1"[..], &[7; 16]].concat();
        let send = |number: usize, payload: &str| {
            let body = format!("{SCOPE};2;{id};{payload}");
            let number = (number as u64).to_be_bytes();
            dealer.send(&[&client[..], &number, b"", body.as_bytes()]);
        };
        for number in 0..HELD {
            send(number, "wait 1999");
        }
        // The first answer, because this one is not held: then all are held.
        send(HELD, "x");
        let number = |frames: &[Vec<u8>]| frames[1][..].try_into().map(u64::from_be_bytes).ok();
        let all_held = number(&dealer.receive()) == Some(HELD as u64);
        if reads_afterwards {
            remote.wait(id, LIMIT).expect("its end");
        }
        let answers: Vec<_> = (0..HELD).map(|_| dealer.receive()).collect();
        let mut numbers: Vec<_> = answers.iter().flat_map(|frames| number(frames)).collect();
        numbers.sort_unstable();
        assert!(numbers.into_iter().eq(0..HELD as u64), "{answers:?}");
        let end = remote.wait(id, LIMIT).expect("its end");
        assert_eq!(end.state, State::Completed, "{end:?}");
        let of_end = format!("{SCOPE};5;{id};");
        let told = answers
            .iter()
            .filter(|frames| frames[3].starts_with(of_end.as_bytes()));
        let told = told.count();
        println!("{kind:?}: {HELD} answers, {told} of the end, all held: {all_held}");
        (all_held && told == HELD).then_some(())
    });
}

/// A client that asks for more than all buffers hold gets it as fast as it reads.
#[test]
fn long_answers_wait_for_their_reader() {
    const ASKED: usize = 60;
    let subject = Subject::start(Kind::TaskServer, None, &[]);
    let mut remote = subject.client();
    let goal = "x".repeat(700_000);
    let id = start(&mut remote, "test", "echo", &goal);
    assert_eq!(remote.wait(id, LIMIT).expect("its end").text, goal);
    let endpoint = subject.server.endpoint();
    let dealer = Socket::prepared(zmq::DEALER, &endpoint, PATIENCE, |dealer| {
        dealer.set_rcvhwm(1).unwrap();
    });
    let ask = format!("{SCOPE};2;{id};x");
    for _ in 0..ASKED {
        dealer.send(&["", &ask]);
    }
    // Others are served while nothing is read.
    for _ in 0..ASKED {
        assert_eq!(remote.wait(id, LIMIT).expect("its end").text.len(), 700_000);
    }
    for _ in 0..ASKED {
        let answer = dealer.receive();
        assert!(answer[1].len() > 700_000, "{} bytes", answer[1].len());
    }
    let peak = subject.server.process.peak_kib();
    println!("{ASKED} answers of 700,000 bytes: peak {peak} KiB");
    assert!(peak < MEMORY, "{peak} KiB");
}

#[test]
fn every_held_answer_of_a_gateway_arrives() {
    every_held_answer_arrives(Kind::Gateway, false);
    every_held_answer_arrives(Kind::Gateway, true);
}

#[test]
fn every_held_answer_of_ztl_serve_arrives() {
    every_held_answer_arrives(Kind::Serve, false);
    every_held_answer_arrives(Kind::Serve, true);
}

#[test]
fn every_held_answer_of_a_task_server_arrives() {
    every_held_answer_arrives(Kind::TaskServer, false);
    every_held_answer_arrives(Kind::TaskServer, true);
}
