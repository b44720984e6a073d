//! 200 robots: when all are there, what they take, the loss of a router, and `stop-all`.

use std::time::{Duration, Instant};

use ztl_std::{RemoteTask, TaskId};
use ztl_tests::lab::{LIMIT, PATIENCE, Process, SCOPE, Server, connect, number, start};

use crate::hall::{Hall, fleet, name};
use crate::memory::{self, Memory};
use crate::requests::client;
use crate::{ms, quantile};

/// Devices of a gateway, and agents beside it: ten simulated devices take one per cent of a core, so that two cores do not
/// carry a gateway for each agent.
const DEVICES: usize = 10;
/// After a kill, the list must stay complete for so long: longer than the lease of a connection.
const QUIET: Duration = Duration::from_secs(5);

pub(crate) fn measure() {
    let robots = usize::try_from(number("ZTL_FLEET_ROBOTS", 200)).expect("a small number");
    let devices: Vec<String> = (0..DEVICES)
        .map(|device| format!("gripper-{device}=sim:gripper"))
        .collect();
    let devices: Vec<&str> = devices.iter().map(String::as_str).collect();
    let gateways: Vec<Server> = (0..robots.div_ceil(DEVICES))
        .map(|_| Server::gateway(&devices))
        .collect();
    let (hall, took) = Hall::open(robots, gateways);
    println!(
        "{robots} agents, {DEVICES} at each gateway with {DEVICES} simulated devices, 3 routers: all there after {took:.1?}"
    );
    memory(&hall);
    processor(&hall);
    drop(hall);
    let (mut hall, took) = Hall::open(robots, (0..robots).map(|_| Server::naps()).collect());
    println!(
        "{robots} agents, each beside a `ztl serve` of its own, 3 routers: all there after {took:.1?}"
    );
    for router in [1, 0] {
        loss(&mut hall, router);
    }
    stop(&hall, None);
    stop(&hall, Some(robots / 2));
}

fn memory(hall: &Hall) {
    println!(
        "memory            resident: median, most     proportional share: median, most     (MiB)"
    );
    let gateways = hall.servers.iter().map(|server| &server.process);
    for (what, processes) in [
        ("agent", hall.agents.iter().collect::<Vec<_>>()),
        ("router", hall.routers.processes.iter().collect()),
        ("endpoint", vec![&hall.endpoint]),
        ("(gateway)", gateways.collect()),
    ] {
        memory::print(
            what,
            &processes.into_iter().map(Memory::of).collect::<Vec<_>>(),
        );
    }
}

/// The processor time of idle parts.
fn processor(hall: &Hall) {
    let groups = [
        ("agent", hall.agents.iter().collect::<Vec<_>>()),
        ("router", hall.routers.processes.iter().collect()),
        ("endpoint", vec![&hall.endpoint]),
    ];
    let used = || {
        groups.each_ref().map(|(_, processes)| {
            let times = processes.iter().map(|process| process.processor_time());
            times.sum::<Duration>()
        })
    };
    let (before, begun) = (used(), Instant::now());
    // The time is measured.
    std::thread::sleep(Duration::from_secs(10));
    let took = begun.elapsed();
    for ((what, processes), (before, after)) in groups.iter().zip(before.iter().zip(used())) {
        let each = (after - *before).as_secs_f64() / processes.len() as f64;
        println!(
            "idle {what:9} {:.2} % of a core",
            each / took.as_secs_f64() * 100.0
        );
    }
}

fn tasks(remote: &mut RemoteTask) -> usize {
    remote
        .tasks()
        .expect("an answer")
        .expect("a list")
        .tasks
        .len()
}

/// A client of each robot's server.
fn directly(hall: &Hall) -> Vec<RemoteTask> {
    let servers = hall.servers.iter();
    servers.map(|server| connect(&server.endpoint())).collect()
}

/// Kills a router while each robot has a task.
fn loss(hall: &mut Hall, router: usize) {
    let mut directly = directly(hall);
    let before: Vec<usize> = directly.iter_mut().map(tasks).collect();
    let mut routed: Vec<(RemoteTask, TaskId)> = (0..hall.robots)
        .map(|robot| {
            let mut remote = client(hall.port, &format!("/{}{SCOPE}", name(robot)));
            let id = start(&mut remote, "nap", "for", "15");
            (remote, id)
        })
        .collect();
    let killed = hall.routers.kill(router);
    let (mut complete, mut fewest) = (killed, hall.robots);
    let mut asked = killed;
    while asked < complete + QUIET {
        let count = hall.served().len();
        fewest = fewest.min(count);
        asked = Instant::now();
        if count < hall.robots {
            complete = asked;
            assert!(
                complete < killed + PATIENCE,
                "only {count} robots are served"
            );
        }
    }
    let near = if router == 0 {
        "of the endpoint"
    } else {
        "of a third of the agents"
    };
    println!(
        "kill -9 of the router {near}: list complete after {:.2} s; at least {fewest} robots were listed meanwhile",
        (complete - killed).as_secs_f64()
    );
    hall.routers.restart(&hall.scratch, router);
    hall.wait_complete();
    for (robot, (remote, id)) in routed.iter_mut().enumerate() {
        let direct = &mut directly[robot];
        let told = remote.wait(*id, LIMIT).expect("its end");
        let own = direct.status(*id).expect("known");
        assert_eq!(told, own, "robot {robot} was told falsely");
        assert_eq!(
            tasks(direct),
            before[robot] + 1,
            "robot {robot} has more tasks"
        );
    }
    println!(
        "    each of {} tasks acted once and was told as its robot tells it",
        routed.len()
    );
}

/// Stops a task of each robot; one of them does not answer.
fn stop(hall: &Hall, hanging: Option<usize>) {
    let tasks: Vec<(RemoteTask, TaskId)> = directly(hall)
        .into_iter()
        .map(|mut remote| {
            let id = start(&mut remote, "nap", "for", "60");
            (remote, id)
        })
        .collect();
    if let Some(robot) = hanging {
        hall.agents[robot].signal("STOP");
    }
    let (told, mut times, begun) = std::thread::scope(|threads| {
        let waiting: Vec<_> = tasks
            .into_iter()
            .enumerate()
            .filter(|(robot, _)| Some(*robot) != hanging)
            .map(|(_, (mut remote, id))| {
                threads.spawn(move || {
                    remote.wait(id, LIMIT).expect("its end");
                    Instant::now()
                })
            })
            .collect();
        let begun = Instant::now();
        let mut stop = fleet(&["stop-all"], &hall.scratch.path("endpoint.yaml"));
        let told = Process::run(&mut stop);
        let ends: Vec<Instant> = waiting.into_iter().map(|end| end.join().unwrap()).collect();
        (told, ends, begun)
    });
    let took = begun.elapsed();
    let mut times: Vec<Duration> = times.drain(..).map(|end| end - begun).collect();
    let count = |text: &str| {
        told.stdout
            .lines()
            .filter(|line| line.contains(text))
            .count()
    };
    println!(
        "stop-all{}: from the start of the command to a robot's ABORTED p50 {:.0} ms, p99 {:.0} ms; the command took {:.1?} and named {} stopped, {} not reached, exit code {:?}",
        if hanging.is_some() {
            ", and one agent hangs"
        } else {
            ""
        },
        ms(quantile(&mut times, 0.5)),
        ms(quantile(&mut times, 0.99)),
        took,
        count("stopped: 1 tasks"),
        count("not reached"),
        told.code,
    );
    assert_eq!(told.stdout.lines().count(), hall.robots, "{}", told.stdout);
    if let Some(robot) = hanging {
        hall.agents[robot].signal("CONT");
    }
}
