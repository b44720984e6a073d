//! Devices behind faulty lines, and the gateway that serves them.

use std::path::PathBuf;

use ztl_std::RemoteTask;
use ztl_tests::lab::{
    PATIENCE, Process, SCOPE, Scratch, Server, number, process_status, reserve_port, ztl,
};

/// A simulated gripper behind a line.
pub struct Branch {
    pub name: String,
    pub device: Process,
    line: Option<Process>,
    line_args: Vec<String>,
    record: PathBuf,
}

impl Branch {
    #[track_caller]
    fn new(scratch: &Scratch, name: String, faults: &str) -> Self {
        let record = scratch.path(format!("{name}.record"));
        let mut device = ztl();
        device.args(["device", "sim:gripper", "--on", "tcp:0"]);
        let device = Process::start(device.arg("--record").arg(&record));
        let far = device.wait_for_port("Simulated gripper at");
        // The line is restarted at this address.
        let near = reserve_port();
        let ends = [
            "line".to_owned(),
            format!("tcp-listen:{near}"),
            format!("tcp:127.0.0.1:{far}"),
        ];
        let faults = faults.split_whitespace().map(str::to_owned);
        let mut branch = Self {
            name,
            device,
            line: None,
            line_args: ends.into_iter().chain(faults).collect(),
            record,
        };
        branch.plug();
        branch
    }

    /// For `ztl gateway --device`.
    fn url(&self) -> String {
        let port = self.line_args[1].trim_start_matches("tcp-listen:");
        format!("{}=tcp:127.0.0.1:{port}", self.name)
    }

    #[track_caller]
    fn plug(&mut self) {
        let line = Process::start(ztl().args(&self.line_args));
        line.wait_for("Seed ");
        self.line = Some(line);
    }

    /// Unplugs the line and plugs it in again.
    #[track_caller]
    pub fn replug(&mut self) {
        if let Some(mut line) = self.line.take() {
            line.kill();
        }
        self.plug();
    }

    /// Ends the line and returns its statistics.
    #[track_caller]
    pub fn unplug(&mut self) -> String {
        let line = self.line.take().expect("a line");
        line.signal("TERM");
        let ended = line.end(PATIENCE);
        let counts: Vec<&str> = ended
            .stdout
            .lines()
            .filter(|line| line.contains(" to "))
            .collect();
        counts.join("\n")
    }

    /// The device's own record of its tasks.
    pub fn record(&self) -> String {
        std::fs::read_to_string(&self.record).expect("the device's record")
    }
}

/// A gateway and its devices.
pub struct Rig {
    pub branches: Vec<Branch>,
    pub gateway: Server,
    _scratch: Scratch,
}

impl Rig {
    /// This many grippers, each behind a line with these options of `ztl line`; all ready.
    #[track_caller]
    pub fn new(count: usize, faults: &str) -> Self {
        let scratch = Scratch::new();
        let branches: Vec<Branch> = (0..count)
            .map(|number| Branch::new(&scratch, format!("gripper{number}"), faults))
            .collect();
        let urls: Vec<String> = branches.iter().map(Branch::url).collect();
        let urls: Vec<&str> = urls.iter().map(String::as_str).collect();
        let journal = scratch.path("journal").display().to_string();
        let gateway = Server::gateway_with(&urls, &["--journal", &journal]);
        for branch in &branches {
            gateway.wait_ready(&branch.name);
        }
        Self {
            branches,
            gateway,
            _scratch: scratch,
        }
    }

    #[track_caller]
    pub fn client(&self) -> RemoteTask {
        let remote = RemoteTask::connect(&self.gateway.endpoint(), SCOPE).expect("an address");
        remote.with_timeout(PATIENCE)
    }

    /// The current resources of the gateway's process.
    #[track_caller]
    pub fn use_of_gateway(&self) -> Use {
        Use::of(self.gateway.process.id())
    }
}

/// The resources of a process.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Use {
    pub resident_kib: u64,
    pub files: usize,
    pub threads: u64,
}

impl Use {
    #[track_caller]
    fn of(process: u32) -> Self {
        let files = std::fs::read_dir(format!("/proc/{process}/fd")).expect("it lives");
        Self {
            resident_kib: process_status(process, "VmRSS:"),
            files: files.count(),
            threads: process_status(process, "Threads:"),
        }
    }
}

impl std::fmt::Display for Use {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(
            f,
            "{} KiB resident, {} files, {} threads",
            self.resident_kib, self.files, self.threads
        )
    }
}

/// A number, unless the environment overrides it.
pub(super) fn count(variable: &str, default: usize) -> usize {
    usize::try_from(number(variable, default as u64)).expect("a small number")
}
