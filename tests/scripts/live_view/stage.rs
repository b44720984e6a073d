//! A script, its servers, and the command that plays it in a terminal.

use std::fs;
use std::process::Command;
use std::time::{Duration, Instant};

use serde_json::Value;
use ztl_tests::lab::{PATIENCE, Process, SCOPE, Scratch, Server, Terminal, until, ztl};

/// The simulated gripper takes 1.6 s from 0 to 80 percent.
pub const SCRIPT: &str = "\
open:
  wide: {gripper: {finger: 80}}
shake:
  no hand (on_failure=ask): {gripper: {thumb: 1}}
  half: {gripper: {finger: 40}}
close:
  shut: {gripper: {finger: 0}}
";

pub struct Stage {
    pub files: Scratch,
    server: Option<Server>,
}

impl Stage {
    #[track_caller]
    pub fn new(script: &str) -> Self {
        let server = Server::gateway(&["gripper=sim:gripper"]);
        server.wait_ready("gripper");
        let port = server.port;
        Self {
            server: Some(server),
            ..Self::with(script, &[("gripper", port)])
        }
    }

    /// With these servers.
    #[track_caller]
    pub fn with(script: &str, remotes: &[(&str, u16)]) -> Self {
        let files = Scratch::new();
        fs::write(files.path("show.yaml"), script).unwrap();
        let entry = |(name, port): &(&str, u16)| {
            format!("  {name}: {{host: 127.0.0.1, port: {port}, scope: {SCOPE}}}\n")
        };
        let entries: String = remotes.iter().map(entry).collect();
        fs::write(files.path("remotes.yaml"), format!("remotes:\n{entries}")).unwrap();
        Self {
            files,
            server: None,
        }
    }

    /// Sets how fast the gripper moves: 0.1 is ten times slower than usual. The device refuses this while it moves.
    #[track_caller]
    pub fn set_speed(&self, factor: f32) {
        let server = self.server.as_ref().expect("a gripper");
        server.set_speed("gripper", "speed", factor);
    }

    /// The command that plays the script and records the run.
    pub fn command(&self) -> Command {
        let mut command = ztl();
        command.args([
            "run-script",
            "-s",
            "show.yaml",
            "-c",
            "remotes.yaml",
            "--record",
            "run.jsonl",
        ]);
        command
            .current_dir(self.files.path(""))
            .env("LANG", "C.UTF-8")
            .env_remove("LC_ALL");
        command.env_remove("NO_COLOR");
        command
    }

    #[track_caller]
    pub fn play(&self) -> Terminal {
        Terminal::start(&self.command(), (80, 24))
    }

    /// The events recorded so far.
    #[track_caller]
    pub fn record(&self) -> Vec<Value> {
        let text = fs::read_to_string(self.files.path("run.jsonl")).unwrap();
        // The last line may be half written.
        text.split_inclusive('\n')
            .filter(|line| line.ends_with('\n'))
            .map(|line| serde_json::from_str(line).expect(line))
            .collect()
    }

    /// The HTML report about the record.
    #[track_caller]
    pub fn report(&self) -> String {
        let mut command = ztl();
        command.args(["report", "run.jsonl", "-o", "report.html"]);
        let made = Process::run(command.current_dir(self.files.path("")));
        assert_eq!(made.code, Some(0), "{}", made.stderr);
        fs::read_to_string(self.files.path("report.html")).unwrap()
    }

    /// The decisions so far, and who made them.
    pub fn decided(&self) -> Vec<String> {
        let decided = |line: &Value| {
            let (what, by) = (&line["command"]["do"], &line["by"]);
            (line["event"] == "decided")
                .then(|| format!("{} {}", what.as_str().unwrap(), by.as_str().unwrap()))
        };
        self.record().iter().filter_map(decided).collect()
    }
}

/// Presses Enter until the shown scene starts: at first the key may count as held, which ends after 700 ms. Returns as soon
/// as the scene starts.
pub fn start_scene(terminal: &mut Terminal, stage: &Stage) {
    let starts = || {
        let decided = stage.decided();
        decided.iter().filter(|it| *it == "start operator").count()
    };
    let before = starts();
    until("the start of the scene", PATIENCE, || {
        terminal.type_in("\r");
        let typed = Instant::now();
        while starts() == before && typed.elapsed() < Duration::from_millis(800) {
            std::thread::sleep(Duration::from_millis(20));
        }
        (starts() > before).then_some(())
    });
}
