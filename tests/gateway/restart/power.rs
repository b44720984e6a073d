//! A power cut, and a kill while the disk stalls. `disk.c` simulates the disk by LD_PRELOAD.

use std::collections::BTreeSet;
use std::path::Path;
use std::process::Command;

use super::device::{Deed, Device};
use super::rig::{LONG, command};
use ztl_std::gateway::{PARAMETERS, UPDATES};
use ztl_std::{RemoteTask, State};
use ztl_tests::lab::{
    LIMIT, PATIENCE, Process, Scratch, Server, connect, reserve_port, status, until,
};

/// A gateway whose journal is on a disk that the test controls.
struct OnDisk {
    device: Device,
    scratch: Scratch,
    port: u16,
    gateway: Server,
    /// Bytes of the journal that a power cut leaves.
    synced: u64,
}

impl OnDisk {
    #[track_caller]
    fn new(journal: &str) -> Self {
        let device = Device::power_on(LONG);
        let (scratch, port) = (Scratch::new(), reserve_port());
        let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("gateway/restart/disk.c");
        let mut compiler = Command::new("cc");
        compiler.args(["-shared", "-fPIC", "-Wall", "-o"]);
        let ended = Process::run(compiler.arg(scratch.path("disk.so")).arg(source));
        assert_eq!(ended.code, Some(0), "{}", ended.stderr);
        std::fs::write(scratch.path("journal"), journal).expect("to write");
        let gateway = Self::start(&device, &scratch, port);
        Self {
            device,
            scratch,
            port,
            gateway,
            synced: journal.len() as u64,
        }
    }

    #[track_caller]
    fn start(device: &Device, scratch: &Scratch, port: u16) -> Server {
        let mut command = command(device, port);
        command.arg("--journal").arg(scratch.path("journal"));
        command.env("LD_PRELOAD", scratch.path("disk.so"));
        for (name, file) in [
            ("FILE", "journal"),
            ("STALLS", "stalls"),
            ("SYNCED", "synced"),
        ] {
            command.env(format!("DISK_{name}"), scratch.path(file));
        }
        let process = Process::start(&mut command);
        process.wait_for("Serving ");
        let gateway = Server { process, port };
        gateway.wait_ready("motors");
        gateway
    }

    #[track_caller]
    fn client(&self) -> RemoteTask {
        connect(&self.gateway.endpoint())
    }

    #[track_caller]
    fn start_again(&mut self) {
        self.gateway.process.kill();
        self.gateway = Self::start(&self.device, &self.scratch, self.port);
    }

    /// The machine loses power: the journal keeps only synced bytes.
    #[track_caller]
    fn cut_the_power(&mut self) {
        self.gateway.process.kill();
        if let Ok(synced) = std::fs::read_to_string(self.scratch.path("synced")) {
            self.synced = synced.parse().expect("a length");
        }
        let mut journal = std::fs::OpenOptions::new();
        let journal = journal.write(true).open(self.scratch.path("journal"));
        let journal = journal.expect("the journal");
        journal.set_len(self.synced).expect("to cut it");
        self.gateway = Self::start(&self.device, &self.scratch, self.port);
    }
}

/// A journal in which all ids up to the highest first id of a server are assigned.
pub(super) fn journal_up_to(last: u32) -> String {
    format!(
        "{{\"event\":\"opened\",\"at\":\"2026-01-01T00:00:00.000000Z\",\"running_us\":0,\"journal\":1,\
         \"gateway\":\"0000000000000001\",\"last\":{last},\"version\":\"0.1.0\"}}\n"
    )
}

#[test]
fn no_id_is_reused_after_a_power_cut() {
    let mut rig = OnDisk::new(&journal_up_to(2_000_000_000));
    let mut given = BTreeSet::new();
    for round in 0..3 {
        let mut client = rig.client();
        for number in 0..3 {
            let goal = format!("{round}{number} 1");
            let id = client
                .trigger("motors", "arm", &goal)
                .expect("it is taken")
                .id;
            assert!(given.insert(id.number()), "{id} is given a second time");
            client.wait(id, LIMIT).expect("its end");
        }
        rig.cut_the_power();
    }
}

#[test]
fn the_id_of_a_task_that_was_refused_is_not_given_again() {
    // The server's random first id would be below this one.
    let mut rig = OnDisk::new(&journal_up_to(2_000_000_000));
    let refused = |rig: &OnDisk, component: &str| {
        let refused = rig.client().trigger("motors", component, "");
        refused.expect_err("there is no such component");
        let said = format!("'motors:{component}:' was refused");
        let line = rig.gateway.process.wait_for(&said);
        let id = line
            .split("task ")
            .nth(1)
            .and_then(|rest| rest.split(' ').next());
        id.and_then(|id| id.parse().ok()).expect("its id")
    };
    let mut given: BTreeSet<u32> = BTreeSet::new();
    for round in 0..3 {
        given.insert(refused(&rig, &format!("nothing-{round}")));
        match round {
            0 => rig.start_again(),
            _ => rig.cut_the_power(),
        }
    }
    let task = rig.client().trigger("motors", "arm", "7 1");
    let id = task.expect("it is taken").id;
    given.insert(id.number().expect("a short id").get());
    assert_eq!(given.len(), 4, "{given:?}");
}

#[test]
fn an_id_sent_while_the_disk_stalls_is_known_after_a_kill() {
    let mut rig = OnDisk::new("");
    let mut client = rig.client();
    let id = client.trigger("motors", "arm", "1 1").unwrap().id;
    client.wait(id, LIMIT).expect("its end");
    std::fs::write(rig.scratch.path("stalls"), "").expect("to write");
    // The others wait for the first one's entry. The gateway itself carries out the last three.
    let asking = [
        ("arm", "7 1"),
        ("belt", "8 1"),
        (PARAMETERS, "list"),
        (PARAMETERS, "{'set': ['speed', '1']}"),
        (UPDATES, "status"),
    ];
    let asking: Vec<_> = asking
        .into_iter()
        .map(|(motor, goal)| {
            let (mut client, goal) = (rig.client(), goal.to_owned());
            std::thread::spawn(move || client.trigger("motors", motor, &goal))
        })
        .collect();
    let told: Vec<_> = asking
        .into_iter()
        .map(|asked| asked.join().unwrap())
        .collect();
    for told in &told {
        match told {
            Ok(task) => {
                rig.gateway.process.kill();
                panic!("the id {} was told and is not in the journal", task.id);
            }
            Err(refused) => {
                let reason = refused.to_string();
                assert!(reason.contains("has not been written for "), "{reason}");
            }
        }
    }
    // A rejected task never moves, even when the disk resumes.
    std::fs::remove_file(rig.scratch.path("stalls")).expect("to remove");
    let next = until("a task is taken", PATIENCE, || {
        client.trigger("motors", "arm", "9 1").ok()
    });
    assert_eq!(
        client.wait(&next.id, LIMIT),
        Ok(status(State::Completed, "9"))
    );
    rig.start_again();
    assert_eq!(
        rig.client().status(next.id),
        Ok(status(State::Completed, "9"))
    );
    for goal in ["7 1", "8 1"] {
        assert_eq!(rig.device.deed(goal), Deed::default(), "{goal}");
    }
}
