//! A shared line behind the gateway: simulated nodes that speak one at a time, on a pty.

use std::io::Write as _;

use ztl_std::{RemoteTask, State, TaskId};
use ztl_tests::lab::{
    ABORTED, COMPLETED, LIMIT, PATIENCE, Process, SCOPE, Scratch, Server, connect, reserve_port,
    start, until, ztl,
};

/// A simulated line with a record of what its nodes did.
struct Line {
    process: Process,
    scratch: Scratch,
}

impl Line {
    fn of(nodes: &[&str]) -> Self {
        let scratch = Scratch::new();
        let mut command = ztl();
        command.args(["device", "--bus", "--buttons", "--on"]);
        command.arg(format!("pty:{}", scratch.path("line").display()));
        command.arg("--record").arg(scratch.path("record"));
        let process = Process::start(command.args(nodes));
        process.wait_for("Serve it with");
        Self { process, scratch }
    }

    /// For `ztl gateway --device`. Patient, since the threads of a busy system answer late.
    fn device(&self) -> String {
        let path = self.scratch.path("line");
        format!("arm=rs485:{}?wait=100", path.display())
    }

    fn gateway(&self) -> (Server, RemoteTask) {
        let gateway = Server::gateway(&[&self.device()]);
        let remote = connect(&gateway.endpoint());
        (gateway, remote)
    }

    /// How often something is in the record.
    fn count(&self, what: &str) -> usize {
        let record = std::fs::read_to_string(self.scratch.path("record")).expect("the record");
        record.lines().filter(|line| line.contains(what)).count()
    }
}

fn ended(remote: &mut RemoteTask, id: TaskId) -> State {
    let end = remote.wait(id, LIMIT).expect("an answer");
    println!("{end:?}");
    end.state
}

#[test]
fn tasks_of_the_original_client_run_once_on_many_nodes_at_once() {
    let names: Vec<String> = (1..=14).map(|number| format!("n{number}")).collect();
    let mut nodes: Vec<String> = names
        .iter()
        .zip(1..)
        .map(|(name, address)| format!("{name}=sim:gripper@{address}"))
        .collect();
    // These two have no address.
    nodes.extend(["top=sim:head".to_owned(), "low=sim:head".to_owned()]);
    let nodes: Vec<&str> = nodes.iter().map(String::as_str).collect();
    let line = Line::of(&nodes);
    let (gateway, _) = line.gateway();
    for name in names.iter().map(String::as_str).chain(["top", "low"]) {
        gateway.wait_ready(&format!("arm.{name}"));
    }
    let mut client = gateway.original_client();
    // It takes 18 s then, so it still runs when it is aborted.
    let aborted = "n5";
    gateway.set_speed("arm.n5", "speed", 0.1);
    let tasks: Vec<(&str, i64)> = names
        .iter()
        .map(|name| {
            let device = format!("arm.{name}");
            let id = client.start(&device, "finger", "90");
            if name == aborted {
                client.abort(id);
            }
            (name.as_str(), id)
        })
        .collect();
    let turned = client.start("arm.low", "pan", "left");
    for (name, id) in tasks {
        let state = client.end(id).number;
        let wanted = if name == aborted { ABORTED } else { COMPLETED };
        assert_eq!(state, wanted, "{name}");
        assert!(
            line.count(&format!(" {name}.finger begins ")) <= 1,
            "{name}"
        );
        if name != aborted {
            assert_eq!(line.count(&format!(" {name}.finger begins ")), 1, "{name}");
        }
    }
    assert_eq!(client.end(turned).number, COMPLETED);
    assert_eq!(line.count(" low.pan begins "), 1);
    assert_eq!(line.count(" top.pan begins "), 0);
}

#[test]
fn a_node_that_dies_loses_its_task_alone_and_is_served_again() {
    let mut line = Line::of(&["left=sim:gripper@1", "right=sim:gripper@2"]);
    let (gateway, mut remote) = line.gateway();
    gateway.wait_ready("arm.left");
    gateway.wait_ready("arm.right");
    // It takes 20 s then, so it still runs when the node dies.
    gateway.set_speed("arm.left", "speed", 0.1);
    let left = start(&mut remote, "arm.left", "finger", "100");
    let right = start(&mut remote, "arm.right", "finger", "100");
    line.process.write_line("left off");
    assert_eq!(ended(&mut remote, left), State::Failed);
    assert_eq!(ended(&mut remote, right), State::Completed);
    gateway
        .process
        .wait_for("Device 'arm.left': device is not answering");
    line.process.write_line("left on");
    let again = until("it is served again", PATIENCE, || {
        remote.trigger("arm.left", "finger", "10").ok()
    });
    let again = again.id.number().expect("a task id");
    assert_eq!(ended(&mut remote, again), State::Completed);
    assert_eq!(line.count(" left.finger begins '100'"), 1);
    assert_eq!(line.count(" right.finger begins "), 1);
    assert_eq!(line.count(" right.finger reset"), 0);
}

#[test]
fn nodes_that_flood_leave_the_others_their_turns() {
    let line = Line::of(&["a=sim:sensor@1", "b=sim:sensor@2", "hand=sim:gripper@3"]);
    let (gateway, mut remote) = line.gateway();
    for name in ["arm.a", "arm.b", "arm.hand"] {
        gateway.wait_ready(name);
    }
    for goal in ["40", "0", "30"] {
        let id = start(&mut remote, "arm.hand", "finger", goal);
        assert_eq!(ended(&mut remote, id), State::Completed);
    }
    // It takes 14 s then, so it still runs when it is aborted.
    gateway.set_speed("arm.hand", "speed", 0.1);
    let id = start(&mut remote, "arm.hand", "finger", "100");
    remote.abort(id).expect("it is asked to stop");
    assert_eq!(ended(&mut remote, id), State::Aborted);
    assert_eq!(line.count(" hand.finger begins "), 4);
}

#[test]
fn a_board_that_answers_at_the_address_of_another_one_gets_none_of_its_tasks() {
    let mut line = Line::of(&[
        "left=sim:gripper@3",
        "right=sim:head@3",
        "mid=sim:gripper@4",
    ]);
    line.process.write_line("right off");
    let (gateway, mut remote) = line.gateway();
    gateway.wait_ready("arm.left");
    line.process.write_line("left off");
    line.process.write_line("right on");
    // As soon as a search has found it, it is a device of its own.
    until("it is served under its name", PATIENCE, || {
        let taken = remote.trigger("arm.left", "pan", "left");
        assert!(taken.is_err(), "{taken:?}");
        remote.trigger("arm.right", "pan", "right").ok()
    });
    assert_eq!(line.count(" right.pan begins 'left'"), 0);
    // What the other board says of itself is not told of this one.
    let port = gateway.port.to_string();
    let shown = Process::run(ztl().args(["devices", "--json", "-p", &port])).stdout;
    let all: serde_json::Value = serde_json::from_str(&shown).expect("JSON");
    let name = |device| {
        let devices = &all.pointer("/scopes").unwrap_or(&all)[SCOPE];
        devices[device]["firmware"]["name"].clone()
    };
    assert_eq!(
        (name("arm.left"), name("arm.right")),
        ("left".into(), "right".into())
    );
}

#[test]
fn a_board_that_comes_to_the_address_of_a_moving_one_ends_no_task_and_an_abort_stops_it() {
    let mut line = Line::of(&["left=sim:gripper@3", "right=sim:gripper@3"]);
    line.process.write_line("right off");
    let (gateway, mut remote) = line.gateway();
    gateway.wait_ready("arm.left");
    gateway.set_speed("arm.left", "speed", 0.1);
    let task = start(&mut remote, "arm.left", "finger", "100");
    line.process.write_line("right on");
    gateway
        .process
        .wait_for("the answers of 'left' at address 3 are damaged");
    let told = remote.status(task).expect("an answer");
    assert_eq!(told.state, State::Accepted, "{told:?}");
    // Only the board of the session carries it out.
    remote.abort(task).expect("it is asked to stop");
    until("it stops", PATIENCE, || {
        (line.count(" left.finger aborted ") == 1).then_some(())
    });
    gateway.process.wait_for("have the same address 3");
    // A search may miss one of them on a busy system.
    until("a new task is refused", PATIENCE, || {
        let refused = remote.trigger("arm.left", "finger", "10").err()?;
        let why = refused.to_string();
        why.contains("have the same address 3").then_some(())
    });
    assert_eq!(line.count(" right.finger begins "), 0);
    line.process.write_line("right off");
    assert_eq!(ended(&mut remote, task), State::Aborted);
}

#[test]
fn a_node_that_moves_after_its_line_was_opened_again_goes_on_with_its_task() {
    let mut line = Line::of(&["left=sim:gripper", "right=sim:head@32"]);
    line.process.write_line("right off");
    let between = reserve_port();
    let path = line.scratch.path("line");
    let mut command = ztl();
    command.args([
        "line",
        &format!("tcp-listen:{between}"),
        &format!("serial:{}", path.display()),
    ]);
    let mut wires = Process::start(&mut command);
    let url = format!("rs485:tcp:127.0.0.1:{between}");
    // Patient, as above.
    let gateway = Server::gateway(&[&format!("arm={url}?wait=100")]);
    gateway.wait_ready("arm.left");
    let mut remote = connect(&gateway.endpoint());
    let port = gateway.port.to_string();
    gateway.set_speed("arm.left", "speed", 0.1);
    let task = start(&mut remote, "arm.left", "finger", "100");
    wires.kill();
    let told = gateway.process.wait_for(&format!("'arm.left': {url}"));
    assert!(
        told.contains(&format!("{url}, address 32: the other end has closed it")),
        "{told}"
    );
    let _wires = Process::start(&mut command);
    let row = || {
        let shown = Process::run(ztl().args(["devices", "-p", &port])).stdout;
        let row = shown.lines().find(|row| row.contains(" arm.left at "));
        row.map(str::to_owned)
    };
    until("it is served again", PATIENCE, || {
        (!row()?.contains("not ready")).then_some(())
    });
    // The node gives way, since the gateway has given it the address.
    line.process.write_line("right on");
    gateway
        .process
        .wait_for(&format!("'arm.left' is ready at {url}, address 31"));
    gateway.wait_ready("arm.right");
    let shown = row().expect("its row");
    assert!(shown.contains("address 31"), "{shown}");
    assert_eq!(ended(&mut remote, task), State::Completed);
    assert_eq!(line.count(" left.finger begins "), 1);
}

#[test]
fn a_restarted_gateway_names_another_board_at_the_address_of_one_with_tasks() {
    let scratch = Scratch::new();
    let path = scratch.path("line").display().to_string();
    let line = |nodes: &[&str]| {
        let on = format!("pty:{path}");
        let line = Process::start(ztl().args(["device", "--bus", "--on", &on]).args(nodes));
        line.wait_for("Serve it with");
        line
    };
    let journal = scratch.path("journal").display().to_string();
    let gateway = || {
        let device = format!("arm=rs485:{path}?wait=100");
        Server::gateway_with(&[&device], &["--journal", &journal])
    };
    let board = || {
        let journal = std::fs::read_to_string(&journal).expect("the journal");
        let (_, rest) = journal.split_once(r#""board":""#)?;
        Some(rest.split_once('"')?.0.to_owned())
    };
    let first = line(&["left=sim:gripper@3"]);
    let mut server = gateway();
    server.wait_ready("arm.left");
    let mut remote = connect(&server.endpoint());
    // On this patient line, a search waits for the turns of a node with a task.
    let earlier = until("a search has found the board", PATIENCE, || {
        let short = start(&mut remote, "arm.left", "finger", "0");
        assert_eq!(ended(&mut remote, short), State::Completed);
        board()
    });
    // It takes 20 s then, so it still runs when the gateway is killed.
    server.set_speed("arm.left", "speed", 0.1);
    let task = start(&mut remote, "arm.left", "finger", "100");
    server.process.kill();
    drop((server, first));
    // The same firmware at the same address, as the second node of its line with another id.
    let _second = line(&["right=sim:gripper@4", "left=sim:gripper@3"]);
    let server = gateway();
    let told = server
        .process
        .wait_for("the tasks from before are those of the board");
    assert!(told.contains(&format!("with the id {earlier}")), "{told}");
    assert_eq!(told.matches(&earlier).count(), 1, "{told}");
    assert!(told.contains("answers at address 3"), "{told}");
    // The board had to stop by itself after its link timeout, wherever it is.
    let mut remote = connect(&server.endpoint());
    let end = remote.wait(task, LIMIT).expect("its end");
    assert_eq!(end.state, State::Failed, "{end:?}");
    let says = "device was reset, or another board has its address";
    assert!(end.text.contains(says), "{end:?}");
}

#[test]
fn two_nodes_with_one_address_are_named_and_do_not_disturb_the_third() {
    let line = Line::of(&[
        "left=sim:gripper@3",
        "right=sim:gripper@3",
        "top=sim:head@4",
    ]);
    until("a search hears both of them first", PATIENCE, || {
        let (gateway, mut remote) = line.gateway();
        gateway.wait_ready("arm.top");
        let id = start(&mut remote, "arm.top", "pan", "left");
        assert_eq!(ended(&mut remote, id), State::Completed);
        gateway.process.wait_for("have the same address 3");
        let port = gateway.port.to_string();
        let shown = Process::run(ztl().args(["devices", "-p", &port])).stdout;
        // On a busy system, one of them may be late, and the other one is served until a search hears both.
        if ["arm.left", "arm.right"]
            .iter()
            .any(|name| shown.contains(name))
        {
            return None;
        }
        let row = shown.lines().find(|row| row.contains(" arm at rs485:"));
        let row = row.unwrap_or_else(|| panic!("{shown}"));
        for part in ["not ready: '", "'left' (id ", "'right' (id ", "address 3"] {
            assert!(row.contains(part), "{row}");
        }
        let refused = remote.trigger("arm.left", "finger", "10");
        let why = refused.expect_err("no such device").to_string();
        assert!(why.contains("no device 'arm.left'"), "{why}");
        Some(())
    });
}

#[test]
fn a_line_that_is_not_there_is_named_and_served_when_it_comes() {
    let scratch = Scratch::new();
    let path = scratch.path("line");
    let device = format!("arm=rs485:{}?wait=100", path.display());
    let gateway = Server::gateway(&[&device]);
    gateway.process.wait_for("there is no such port");
    let on = format!("pty:{}", path.display());
    let _line = Process::start(ztl().args(["device", "--bus", "sim:head", "--on", &on]));
    gateway.wait_ready("arm.head");
}

#[test]
fn a_line_without_nodes_is_not_ready_and_noise_is_told_from_silence() {
    let mut line = Line::of(&["left=sim:gripper@1"]);
    line.process.write_line("left off");
    let (gateway, _) = line.gateway();
    gateway.process.wait_for("no node answers");
    let port = gateway.port.to_string();
    let row = || {
        let shown = Process::run(ztl().args(["devices", "-p", &port])).stdout;
        let row = shown.lines().find(|row| row.contains(" arm at rs485:"));
        row.map(str::to_owned)
    };
    let shown = row().expect("the line");
    assert!(shown.contains("not ready: no node answers"), "{shown}");
    line.process.write_line("left on");
    gateway.wait_ready("arm.left");
    until("the line is ready", PATIENCE, || {
        (!row()?.contains("not ready")).then_some(())
    });
    // Noise: a line whose other end sends bytes at random.
    let noise = Noise::new();
    let gateway = Server::gateway(&[&format!("arm=rs485:tcp:127.0.0.1:{}", noise.port)]);
    gateway.process.wait_for("what is received is noise");
}

/// Sends bytes that are no frame, until it is dropped.
struct Noise {
    port: u16,
}

impl Noise {
    fn new() -> Self {
        let listener = std::net::TcpListener::bind("127.0.0.1:0").expect("a port");
        let port = listener.local_addr().expect("its address").port();
        std::thread::spawn(move || {
            for stream in listener.incoming() {
                let Ok(mut stream) = stream else { return };
                // Until the gateway closes it.
                while stream.write_all(&[0x55, 0xaa, 0x13, 0]).is_ok() {
                    std::thread::sleep(std::time::Duration::from_millis(5));
                }
            }
        });
        Self { port }
    }
}

/// The walk of `docs/bus.md`.
const WALK: &str = include_str!("../../docs/bus.md");

/// The options of the walk's only line that begins like this, with its own path and port.
#[track_caller]
fn of_walk(begin: &str, path: &str, port: &str) -> Vec<String> {
    let lines = WALK.lines().filter_map(|line| line.strip_prefix("ztl "));
    let mut lines = lines.filter(|line| line.starts_with(begin));
    let (line, others) = (lines.next().expect("a line"), lines.count());
    assert_eq!(others, 0, "{begin}");
    let own = |word: &str| word.replace("/tmp/arm", path).replace("12345", port);
    line.split(' ').map(own).collect()
}

#[test]
fn the_walk_of_the_documentation_works() {
    let scratch = Scratch::new();
    let path = scratch.path("arm").display().to_string();
    let mut line = Process::start(ztl().args(of_walk("device ", &path, "0")));
    line.wait_for("Serve it with");
    let begin = "gateway --device arm=rs485:/tmp/arm ";
    let mut command = ztl();
    // Patient, since the threads of a busy system answer late.
    let patient = format!("{path}?wait=100");
    command
        .args(of_walk(begin, &patient, "0"))
        .arg("--no-journal");
    let gateway = Server::start(&mut command);
    let port = gateway.port.to_string();
    for node in ["arm.left", "arm.right", "arm.head"] {
        gateway.wait_ready(node);
    }
    let shown = Process::run(ztl().args(of_walk("devices ", &path, &port)));
    assert!(shown.stdout.contains("arm.head at rs485:"), "{shown:?}");
    for task in ["arm.left:finger:40", "arm.head:pan:left"] {
        let begin = format!("task-client -r 127.0.0.1 -p 12345 -s /lab {task}");
        let mut command = ztl();
        command
            .args(of_walk(&begin, &path, &port))
            .arg("--exit-status");
        let ended = Process::run(&mut command);
        assert_eq!(ended.code, Some(0), "{ended:?}");
    }
    line.write_line("left off");
    gateway
        .process
        .wait_for("'arm.left': device is not answering");
    line.write_line("left on");
    gateway.process.wait_for("Device 'arm.left' is ready");
    until("the button starts a task", PATIENCE, || {
        line.write_line("left press 40");
        let tasks = Process::run(ztl().args(["ps", "-p", &port])).stdout;
        tasks.contains("arm.left:finger:40").then_some(())
    });
}

#[test]
fn mistakes_of_a_shared_line_say_what_is_right() {
    let run = |args: &[&str]| {
        let ended = Process::run(ztl().args(args));
        assert_eq!(ended.code, Some(2), "{ended:?}");
        ended.stderr
    };
    let gateway = |device| run(&["gateway", "--check", "-s", "/lab", "-p", "1", "-d", device]);
    assert!(gateway("arm=rs485:").contains("rs485:/dev/ttyUSB0?baud=115200"));
    assert!(gateway("arm=rs485:/dev/x?wait=1").contains("?wait=8"));
    let device = |device| run(&["device", "--on", "tcp:0", device]);
    assert!(device("sim:head@33").contains("'33' is not an address from 1 to 32"));
}

/// A gateway with these two lines joined to one, and what joins them.
#[track_caller]
fn joined(lines: [&Line; 2]) -> (Server, Process) {
    let pair = lines[0].scratch.path("pair").display().to_string();
    let ends = lines.map(|line| format!("serial:{}", line.scratch.path("line").display()));
    let mut command = ztl();
    command
        .args(["line", "--half-duplex", &format!("pty:{pair}")])
        .args(ends);
    let wires = Process::start(&mut command);
    wires.wait_for("Seed ");
    let gateway = Server::gateway(&[&format!("arm=rs485:{pair}?wait=100")]);
    (gateway, wires)
}

#[test]
fn boards_on_a_half_duplex_line_are_found_and_served() {
    let left = Line::of(&["left=sim:gripper@1"]);
    let right = Line::of(&["right=sim:gripper@2"]);
    let (gateway, _wires) = joined([&left, &right]);
    let mut remote = connect(&gateway.endpoint());
    for name in ["arm.left", "arm.right"] {
        gateway.wait_ready(name);
    }
    let tasks = ["arm.left", "arm.right"].map(|name| start(&mut remote, name, "finger", "40"));
    for task in tasks {
        assert_eq!(ended(&mut remote, task), State::Completed);
    }
    assert_eq!(left.count(" left.finger begins "), 1);
    assert_eq!(right.count(" right.finger begins "), 1);
}

#[test]
fn an_id_at_two_addresses_is_named_and_no_node_with_it_gets_tasks() {
    // Boards with equal places on their lines have equal ids.
    let first = Line::of(&["left=sim:gripper@1", "right=sim:gripper@2"]);
    let mut second = Line::of(&["left=sim:gripper@3"]);
    let (gateway, _wires) = joined([&first, &second]);
    gateway.process.wait_for("several nodes have the id");
    let mut remote = connect(&gateway.endpoint());
    let refused = remote.trigger("arm.left", "finger", "10");
    assert!(refused.is_err(), "{refused:?}");
    gateway.wait_ready("arm.right");
    let id = start(&mut remote, "arm.right", "finger", "40");
    assert_eq!(ended(&mut remote, id), State::Completed);
    // One of them goes.
    second.process.write_line("left off");
    let id = until("the other one is served", PATIENCE, || {
        remote.trigger("arm.left", "finger", "20").ok()
    });
    let id = id.id.number().expect("a task id");
    assert_eq!(ended(&mut remote, id), State::Completed);
    assert_eq!(first.count(" left.finger begins '20'"), 1);
    assert_eq!(second.count(" left.finger begins "), 0);
}
