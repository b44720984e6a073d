//! Where the journal is kept, and what happens when the disk is full.

use std::process::Command;

use super::device::Device;
use super::rig::{GatewayRig, LONG, ONCE, USUAL, command, start_gateway};
use ztl_std::{State, TaskId, TriggerError};
use ztl_tests::lab::{
    LIMIT, PATIENCE, Process, Scratch, Server, connect, reserve_port, status, until,
};

/// A gateway whose files are limited to a few blocks of 512 bytes, like on a full disk.
#[track_caller]
fn start_limited(lab_device: &Device, scratch: &Scratch, port: u16, blocks: u32) -> Server {
    let full = command(lab_device, port);
    let mut limited = Command::new("sh");
    let script = format!("trap '' XFSZ; ulimit -f {blocks}; exec \"$@\"");
    limited.args(["-c", &script, "sh"]);
    limited.arg(full.get_program()).args(full.get_args());
    limited.arg("--journal").arg(scratch.path("journal"));
    let process = Process::start(&mut limited);
    process.wait_for("Serving ");
    let gateway = Server { process, port };
    gateway.wait_ready("motors");
    gateway
}

#[test]
fn on_a_full_disk_new_tasks_are_rejected_and_running_ones_finish() {
    let device = Device::power_on(LONG);
    let (scratch, port) = (Scratch::new(), reserve_port());
    let blocks = 4;
    let mut gateway = start_limited(&device, &scratch, port, blocks);
    let mut client = connect(&gateway.endpoint());
    let refused = |refused: TriggerError| {
        let reason = refused.to_string();
        assert!(reason.contains("refused: the journal "), "{reason}");
        assert!(
            reason.contains("cannot be written: File too large"),
            "{reason}"
        );
    };
    // Fill it until there is room for a task's start but not for its outcome.
    let mut ends = Vec::new();
    loop {
        let number = ends.len();
        let task = match client.trigger("motors", "arm", &format!("{number} 1")) {
            Ok(task) => task,
            Err(error) => {
                refused(error);
                break;
            }
        };
        let why = "task ended; result withheld until journaled: the journal ";
        let told = until("it has ended", PATIENCE, || {
            let told = client.status(&task.id).unwrap();
            (told.state.is_final() || told.text.starts_with(why)).then_some(told)
        });
        if told.state.is_final() {
            ends.push((task.id, told));
            continue;
        }
        // It has ended, but the outcome is withheld until it is journaled.
        assert_eq!(told.state, State::Accepted);
        let end = status(State::Completed, &number.to_string());
        ends.push((task.id, end));
        refused(client.trigger("motors", "arm", "100 1").unwrap_err());
    }
    let len = std::fs::metadata(scratch.path("journal")).unwrap().len();
    assert!(len <= u64::from(blocks) * 512);
    assert!(ends.len() >= 2, "{ends:?}");
    gateway.process.kill();

    // There is room again: every outcome is the expected one.
    let gateway = start_gateway(&device, &scratch, port);
    let mut client = connect(&gateway.endpoint());
    for (id, end) in ends {
        assert_eq!(client.wait(id, LIMIT), Ok(end));
    }
    gateway.wait_ready("motors");
    let id = client.trigger("motors", "arm", "101 1").unwrap().id;
    assert_eq!(client.wait(id, LIMIT), Ok(status(State::Completed, "101")));
    assert!(device.world().deeds.values().all(|deed| *deed == ONCE));
}

#[test]
fn the_journal_is_kept_in_the_service_managers_or_users_directory() {
    let scratch = Scratch::new();
    let device = Device::power_on(USUAL);
    let port = reserve_port();
    let name = format!("gateway-{port}-test.jsonl");
    let home = scratch.path("home");
    let state = scratch.path("state");
    for (variable, path) in [("HOME", &home), ("STATE_DIRECTORY", &state)] {
        let mut command = command(&device, port);
        command.env_clear().env(variable, path);
        let process = Process::start(&mut command);
        let said = process.wait_for("Journal: ");
        let expected = match variable {
            "HOME" => home.join(".local/state/ztl").join(&name),
            _ => state.join(&name),
        };
        assert_eq!(said, format!("Journal: {}", expected.display()));
        assert!(expected.exists());
    }
}

#[test]
fn without_a_journal_directory_the_gateway_says_what_to_do() {
    let scratch = Scratch::new();
    let device = Device::power_on(USUAL);
    std::fs::write(scratch.path("file"), "").unwrap();
    let impossible = scratch.path("file/journal");
    for (args, said) in [
        (
            vec![],
            "nor HOME is set; give --journal FILE, or --no-journal",
        ),
        (
            vec!["--journal", impossible.to_str().unwrap()],
            "(--journal FILE, or --no-journal)",
        ),
    ] {
        let mut command = command(&device, reserve_port());
        command.env_clear().args(&args);
        let ended = Process::run(&mut command);
        assert_eq!(ended.code, Some(1), "{}", ended.stderr);
        assert!(ended.stderr.contains(said), "{}", ended.stderr);
    }
}

#[test]
fn without_a_journal_the_gateway_reports_the_lost_guarantees() {
    let device = Device::power_on(USUAL);
    for (port, args, said) in [
        (
            reserve_port(),
            vec!["--no-journal"],
            "Without a journal: after a restart",
        ),
        (
            0,
            vec![],
            "Without a journal, as the port is another at each start",
        ),
    ] {
        let mut command = command(&device, port);
        command.env_clear().args(&args);
        let process = Process::start(&mut command);
        process.wait_for(said);
        process.wait_for("Serving ");
    }
}

#[test]
fn an_idle_gateway_notices_an_altered_journal_and_starts_a_new_one() {
    let mut rig = GatewayRig::new(LONG);
    let mut client = rig.client();
    let id = client.trigger("motors", "arm", "7 1").unwrap().id;
    let end = client.wait(&id, LIMIT).unwrap();
    let journal = || std::fs::OpenOptions::new().append(true).open(rig.journal());
    journal().unwrap().set_len(0).unwrap();
    rig.gateway.process.wait_for(" was cut: ");
    until("the lines are there again", PATIENCE, || {
        (rig.lines().len() >= 2).then_some(())
    });
    std::io::Write::write_all(&mut journal().unwrap(), b"{}").unwrap();
    rig.gateway
        .process
        .wait_for(" was changed by another program: 2 bytes were added");
    std::fs::remove_file(rig.journal()).unwrap();
    rig.gateway.process.wait_for(" was removed");
    until("it is there again", PATIENCE, || {
        rig.journal().exists().then_some(())
    });
    rig.kill();
    rig.start_again();
    assert_eq!(rig.client().status(id), Ok(end));
}

#[test]
fn exhausted_ids_are_reported_by_the_gateway_and_to_its_clients() {
    let device = Device::power_on(LONG);
    let (scratch, port) = (Scratch::new(), reserve_port());
    let last_but_one = super::power::journal_up_to(u32::MAX - 1);
    std::fs::write(scratch.path("journal"), last_but_one).unwrap();
    let mut gateway = start_gateway(&device, &scratch, port);
    gateway.process.wait_for("only 1 task id is left");
    gateway.wait_ready("motors");
    let mut client = connect(&gateway.endpoint());
    let id = client.trigger("motors", "arm", "7 1").unwrap().id;
    assert_eq!(id, TaskId::MAX);
    let end = status(State::Completed, "7");
    assert_eq!(client.wait(&id, LIMIT), Ok(end.clone()));
    let used_up = |error: TriggerError| {
        let said = error.to_string();
        let help = "restart the server, without its journal if it has one";
        let wanted = format!("all task ids are used up; {help}");
        assert!(said.contains(&wanted), "{said}");
    };
    used_up(client.trigger("motors", "arm", "8 1").unwrap_err());
    gateway.process.wait_for("All task ids are used up: every further task is refused. Restart the server, without its journal if it has one.");
    gateway.process.kill();
    let gateway = start_gateway(&device, &scratch, port);
    gateway
        .process
        .wait_for("all task ids are used up. Stop the gateway, move the journal away");
    let mut client = connect(&gateway.endpoint());
    assert_eq!(client.status(id), Ok(end));
    used_up(client.trigger("motors", "arm", "9 1").unwrap_err());
}
