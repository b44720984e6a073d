//! The memory of an agent, its router and an endpoint while the agent's connection is cut again and again, and what passes
//! over it.

use std::sync::mpsc::channel;
use std::time::{Duration, Instant};

use ztl_fleet::config::Links;
use ztl_fleet::session;
use ztl_std::State;
use ztl_tests::lab::{LIMIT, PATIENCE, Scratch, Server, number, until};

use crate::hall::{Routers, start};
use crate::line::{Line, Mode};
use crate::memory::Memory;
use crate::requests::client;

/// Robots whose connections are cut together.
const ROBOTS: usize = 5;
/// How long idle connections are measured, in seconds.
const IDLE: u64 = 20;
/// Tasks whose bytes are measured.
const TASKS: u32 = 200;

pub(crate) fn measure() {
    let reconnects = number("ZTL_FLEET_RECONNECTS", 1000);
    let (server, scratch) = (Server::ours(), Scratch::new());
    let routers = Routers::start(&scratch, 1);
    let [near, far] = [0, 0].map(|_| Line::to(&routers.addresses[0]));
    let text = format!("port: 0\nrouters: {}\n", far.address);
    let endpoint = start(&scratch, "endpoint", "endpoint.yaml", &text);
    let agents: Vec<_> = (0..ROBOTS)
        .map(|robot| {
            let text = format!(
                "name: arm-{robot}\nserver: {}\nrouters: {}\nstate: arm-{robot}\n",
                server.endpoint(),
                near.address
            );
            start(&scratch, "join", &format!("arm-{robot}.yaml"), &text)
        })
        .collect();
    let port = endpoint.wait_for_port("Serving ");
    let mut remote = client(port, "/arm-0/test");
    until("all robots are served", PATIENCE, || {
        (remote.describe().ok()??.scopes.len() == ROBOTS).then_some(())
    });

    let passed = || (near.passed(), far.passed());
    let before = passed();
    // The time is measured.
    std::thread::sleep(Duration::from_secs(IDLE));
    let idle = passed();
    println!(
        "idle, a second: {} bytes in {} chunks for each robot at its router; {} bytes for each robot at an endpoint's",
        (idle.0.bytes - before.0.bytes) / IDLE / ROBOTS as u64,
        (idle.0.chunks - before.0.chunks) / IDLE / ROBOTS as u64,
        (idle.1.bytes - before.1.bytes) / IDLE / ROBOTS as u64,
    );
    let (begun, idle) = (Instant::now(), passed());
    for _ in 0..TASKS {
        let end = remote.run("test", "echo", "hi", LIMIT).expect("its end");
        assert_eq!(end.state, State::Completed);
    }
    let (after, took) = (passed(), begun.elapsed().as_secs_f64());
    println!(
        "a task (INIT and STATUS): {} bytes between robot and router, {} between router and endpoint (with what is idle for {took:.1} s)",
        (after.0.bytes - idle.0.bytes) / u64::from(TASKS),
        (after.1.bytes - idle.1.bytes) / u64::from(TASKS),
    );

    let links = Links {
        routers: vec![routers.addresses[0].clone()],
        ..Links::default()
    };
    let observer = session::open(&links).expect("a router");
    let (sender, events) = channel();
    session::watch_presence(&observer, "*", move |_, _, is_there| {
        // The receiver is there until the end.
        let _ = sender.send(is_there);
    })
    .expect("a router");
    let seen = |wanted: bool| {
        let mut count = 0;
        while count < ROBOTS {
            let event = events.recv_timeout(PATIENCE).expect("it comes and goes");
            count += usize::from(event == wanted);
        }
    };
    seen(true);
    println!(
        "reconnects of each of {ROBOTS} agents    most resident of an agent, of the router, of the endpoint (MiB)"
    );
    let begun = Instant::now();
    for done in 0..=reconnects {
        if done % (reconnects / 10).max(1) == 0 {
            let mib = |process| Memory::of(process).resident as f64 / 1024.0;
            let agent = agents.iter().map(mib).fold(0.0, f64::max);
            println!(
                "{done:6}    {agent:6.1}    {:6.1}    {:6.1}",
                mib(&routers.processes[0]),
                mib(&endpoint)
            );
        }
        near.set(Mode::Cut);
        seen(false);
        near.set(Mode::Open);
        seen(true);
    }
    println!("in {:.0?}", begun.elapsed());
}
