//! A routed task, and the same task directly, in turn.

use std::time::{Duration, Instant};

use ztl_std::keys::KeyPair;
use ztl_std::{RemoteTask, State};
use ztl_tests::lab::{LIMIT, PATIENCE, Process, Scratch, Server, connect, connect_to, until};

use crate::hall::{Routers, start};
use crate::{ms, quantile};

/// Tasks of each kind.
const TASKS: usize = 2000;

struct Way {
    name: &'static str,
    remote: RemoteTask,
    /// In microseconds: of the whole task, and of its INIT and of a STATUS alone.
    times: [Vec<i64>; 3],
    /// Killed when they are dropped.
    _processes: Vec<Process>,
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

/// A robot at the last router, and an endpoint at the first one.
fn way(scratch: &Scratch, name: &'static str, server: &Server, routers: usize, keys: bool) -> Way {
    let routers_of = Routers::start(scratch, routers);
    let (first, last) = (&routers_of.addresses[0], &routers_of.addresses[routers - 1]);
    let mut texts = [
        format!(
            "name: arm\nserver: {}\nrouters: {last}\nstate: {name}\n",
            server.endpoint()
        ),
        format!("port: 0\nrouters: {first}\n"),
    ];
    if keys {
        for key in ["arm", "desk"] {
            let pair = KeyPair::generate();
            pair.write(&scratch.path(key)).expect("to write");
        }
        texts[0] += "fleet-key: arm.key_secret\nclient-keys: desk.key\n";
        texts[1] += "fleet-key: desk.key_secret\nrobots: {arm: {key: arm.key}}\n";
    }
    let agent = start(scratch, "join", &format!("{name}-agent.yaml"), &texts[0]);
    let endpoint = start(scratch, "endpoint", &format!("{name}.yaml"), &texts[1]);
    let port = endpoint.wait_for_port("Serving ");
    let mut remote = connect_to(&format!("tcp://127.0.0.1:{port}"), "/arm/test");
    until("the robot is served", PATIENCE, || {
        let scopes = remote.describe().ok()??.scopes;
        scopes.contains_key("/arm/test").then_some(())
    });
    let mut processes = routers_of.processes;
    processes.extend([agent, endpoint]);
    Way {
        name,
        remote,
        times: Default::default(),
        _processes: processes,
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
