//! A routed task, and the same task directly, in turn.

use std::time::{Duration, Instant};

use ztl_std::{RemoteTask, State};
use ztl_tests::lab::{LIMIT, Scratch, Server, connect};

use crate::hall::Pair;
use crate::{ms, quantile};

/// Tasks of each kind.
const TASKS: usize = 2000;

struct Way {
    name: &'static str,
    remote: RemoteTask,
    /// In microseconds: of the whole task, and of its INIT and of a STATUS alone.
    times: [Vec<i64>; 3],
    _pair: Pair,
}

fn time(act: impl FnOnce()) -> i64 {
    let start = Instant::now();
    act();
    i64::try_from(start.elapsed().as_micros()).expect("a short time")
}

fn run(remote: &mut RemoteTask) -> [i64; 3] {
    let task = time(|| {
        let end = remote.run("test", "echo", "hi", LIMIT).expect("its end");
        assert_eq!(end.state, State::Completed);
    });
    let mut id = None;
    let init = time(|| id = remote.trigger("test", "echo", "hi").ok());
    let id = id.expect("it starts").id;
    remote.wait(&id, LIMIT).expect("its end");
    let status = time(|| {
        remote.status(&id).expect("known");
    });
    [task, init, status]
}

/// A fleet with so many routers between robot and endpoint.
fn way(scratch: &Scratch, name: &'static str, server: &Server, routers: usize, keys: bool) -> Way {
    let pair = Pair::start(scratch, name, server, None, routers, keys);
    Way {
        name,
        remote: pair.client(),
        times: Default::default(),
        _pair: pair,
    }
}

pub(crate) fn measure() {
    let server = Server::ours();
    let scratch = Scratch::new();
    let mut direct = connect(&server.endpoint());
    let mut ways = [
        way(&scratch, "one-router", &server, 1, false),
        way(&scratch, "two-routers", &server, 2, false),
        way(&scratch, "sealed", &server, 2, true),
    ];
    let mut alone: [Vec<i64>; 3] = Default::default();
    for _ in 0..TASKS {
        let times = run(&mut direct);
        for (all, time) in alone.iter_mut().zip(times) {
            all.push(time);
        }
        for way in &mut ways {
            let times = run(&mut way.remote);
            for (all, time) in way.times.iter_mut().zip(times) {
                all.push(time);
            }
        }
    }
    println!(
        "{TASKS} tasks of each kind in turn, in ms: p50 and p99, and of the difference to the direct one beside it"
    );
    for (what, kind) in ["task to its end", "INIT", "STATUS"].iter().zip(0..) {
        let of = |all: &[i64], share| {
            let mut all = all.to_vec();
            ms(Duration::from_micros(
                quantile(&mut all, share).unsigned_abs(),
            ))
        };
        let own = &alone[kind];
        println!(
            "{what:16} direct       {:7.2} {:7.2}",
            of(own, 0.5),
            of(own, 0.99)
        );
        for way in &ways {
            let times = &way.times[kind];
            let more: Vec<i64> = times.iter().zip(own).map(|(far, own)| far - own).collect();
            println!(
                "{what:16} {:12} {:7.2} {:7.2}    more {:6.2} {:6.2}    p50 {:.1} times",
                way.name,
                of(times, 0.5),
                of(times, 0.99),
                of(&more, 0.5),
                of(&more, 0.99),
                of(times, 0.5) / of(own, 0.5),
            );
        }
    }
}
