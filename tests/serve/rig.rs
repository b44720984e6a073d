//! A server of programs, and the processes that it starts.

use std::fmt::Display;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use ztl_core::dispatcher::NOTHING_KNOWN;
use ztl_std::{RemoteTask, RunError, State, Status, TaskId, TriggerError};
use ztl_tests::lab::{
    ABORTED, ACCEPTED, OriginalClient, PATIENCE, SCOPE, Scratch, Server, connect, signal, until,
    ztl,
};

/// How long the original's clients wait for an answer.
pub const CLIENT_LIMIT: Duration = Duration::from_secs(2);
/// Part of the answer to an INIT that the server did not hold until the task was decided.
const UNDECIDED: &str = "nobody has taken it yet";

/// `ztl serve` with its own file, in the directory in which its programs run.
pub struct Rig {
    pub server: Server,
    pub scratch: Scratch,
}

impl Rig {
    /// Serves the components of a handler `p`, written as in the file: `name: {run: […]}`, one per line.
    #[track_caller]
    pub fn new(components: &str) -> Self {
        Self::with(components, &[])
    }

    /// The same with options.
    #[track_caller]
    pub fn with(components: &str, options: &[&str]) -> Self {
        Self::of_file(&file(components), options)
    }

    /// Serves components with another `ztl` command.
    #[track_caller]
    pub fn of_command(ztl: Command, components: &str) -> Self {
        Self::start(ztl, &file(components), &[])
    }

    /// Serves a file.
    #[track_caller]
    pub fn of_file(text: &str, options: &[&str]) -> Self {
        Self::start(ztl(), text, options)
    }

    #[track_caller]
    fn start(ztl: Command, text: &str, options: &[&str]) -> Self {
        let scratch = Scratch::new();
        let path = scratch.path("robot.yaml");
        std::fs::write(&path, text).expect("to write");
        let server = start_by(ztl, &path, options);
        Self { server, scratch }
    }

    /// A client.
    #[track_caller]
    pub fn remote(&self) -> RemoteTask {
        connect(&self.server.endpoint())
    }

    /// Runs a task and returns its outcome.
    #[track_caller]
    pub fn run(&self, component: &str, goal: &str) -> (State, String) {
        run_task(&mut self.remote(), ["p", component, goal])
    }

    /// Why a task is rejected.
    #[track_caller]
    pub fn rejection(&self, component: &str, goal: &str) -> String {
        rejection(&mut self.remote(), component, goal)
    }

    /// Waits until a program has written a file of its directory, and returns the content.
    #[track_caller]
    pub fn written(&self, name: &str) -> String {
        let path = self.scratch.path(name);
        until(name, PATIENCE, || {
            let text = std::fs::read_to_string(&path).ok()?;
            text.ends_with('\n').then(|| text.trim_end().to_owned())
        })
    }

    /// The watchdog of the server.
    #[track_caller]
    pub fn watchdog(&self) -> u32 {
        until("a watchdog", PATIENCE, || {
            let mut watchdogs = self.children().into_iter().filter(|child| {
                let line = std::fs::read_to_string(format!("/proc/{child}/cmdline"));
                line.is_ok_and(|line| line.contains("serve-watchdog"))
            });
            watchdogs.next()
        })
    }

    /// The server's child processes, including its watchdog.
    pub fn children(&self) -> Vec<u32> {
        let threads = format!("/proc/{}/task", self.server.process.id());
        let threads = std::fs::read_dir(threads).into_iter().flatten().flatten();
        let children =
            threads.map(|thread| std::fs::read_to_string(thread.path().join("children")));
        let all: String = children.flatten().collect::<Vec<_>>().join(" ");
        all.split_whitespace()
            .map(|child| child.parse().expect("a number"))
            .collect()
    }

    /// All processes in the programs' directory, with any parent.
    pub fn at_home(&self) -> Vec<PathBuf> {
        let home = std::fs::canonicalize(self.scratch.path("")).expect("a directory");
        let all = std::fs::read_dir("/proc").expect("/proc").flatten();
        let at_home = |process: &PathBuf| {
            std::fs::read_link(process.join("cwd")).is_ok_and(|directory| directory == home)
        };
        all.map(|process| process.path()).filter(at_home).collect()
    }

    /// Waits until there are none: what is killed ends a moment later.
    #[track_caller]
    pub fn wait_deserted(&self, when: impl Display) {
        until(&format!("nothing runs, {when}"), PATIENCE, || {
            self.at_home().is_empty().then_some(())
        });
    }

    /// The process whose id a program has written into a file.
    #[track_caller]
    pub fn process(&self, name: &str) -> u32 {
        self.written(name).parse().expect("a number")
    }
}

/// A file of one handler, `p`, with these components.
fn file(components: &str) -> String {
    let lines = components.trim().lines();
    let lines: Vec<String> = lines.map(|line| format!("      {}", line.trim())).collect();
    format!("scopes:\n  {SCOPE}:\n    p:\n{}\n", lines.join("\n"))
}

/// Starts `ztl serve` at any free port, unless the options name one.
#[track_caller]
pub fn start(file: &Path, options: &[&str]) -> Server {
    start_by(ztl(), file, options)
}

#[track_caller]
fn start_by(mut command: Command, file: &Path, options: &[&str]) -> Server {
    command.arg("serve").arg(file).args(options);
    if !options.contains(&"-p") {
        command.args(["-p", "0"]);
    }
    Server::start(&mut command)
}

pub fn told(status: Status) -> (State, String) {
    (status.state, status.text)
}

/// Runs a task to its end. Repeats it if the machine was too busy to start it.
#[track_caller]
pub fn run_task(remote: &mut RemoteTask, [handler, component, goal]: [&str; 3]) -> (State, String) {
    until(
        "a watchdog that confirms in time",
        PATIENCE,
        || match remote.run(handler, component, goal, Some(PATIENCE)) {
            Ok(status) => (!is_starved(&status.text)).then(|| told(status)),
            Err(RunError::NotStarted(TriggerError::Rejected { reason, .. }))
                if is_starved(&reason) =>
            {
                None
            }
            Err(error) => panic!("{handler}:{component}:{goal}: {error}"),
        },
    )
}

/// Starts a task of the handler `p`, as [`trigger_task`] does.
#[track_caller]
pub fn trigger(remote: &mut RemoteTask, component: &str, goal: &str) -> TaskId {
    trigger_task(remote, ["p", component, goal])
}

/// Starts a task. Repeats it if the machine was too busy to start it.
#[track_caller]
pub fn trigger_task(remote: &mut RemoteTask, task: [&str; 3]) -> TaskId {
    until("a watchdog that confirms in time", PATIENCE, || {
        try_trigger(remote, task)
    })
}

/// Starts a task. `None` if the machine was too busy to start it.
#[track_caller]
pub fn try_trigger(
    remote: &mut RemoteTask,
    [handler, component, goal]: [&str; 3],
) -> Option<TaskId> {
    match remote.trigger(handler, component, goal) {
        Ok(task) => {
            let id = task.id.number().expect("a task id");
            is_started(remote, id, &task.reply).then_some(id)
        }
        Err(TriggerError::Rejected { reason, .. }) if is_starved(&reason) => None,
        Err(error) => panic!("{handler}:{component}:{goal}: {error}"),
    }
}

/// Whether a task with this answer to its INIT was started. On a busy machine, the answer may precede that.
#[track_caller]
fn is_started(remote: &mut RemoteTask, id: TaskId, reply: &str) -> bool {
    !reply.contains(UNDECIDED) || was_started(remote, id)
}

/// Waits until a task is decided. Returns whether it was started, and not rejected because the machine was too busy.
#[track_caller]
pub fn was_started(remote: &mut RemoteTask, id: TaskId) -> bool {
    until("the task is decided", PATIENCE, || {
        let status = remote.status(id).ok()?;
        (status.state != State::Initiated).then(|| !is_starved(&status.text))
    })
}

/// Why a task of the handler `p` is rejected, as [`rejection_of`] returns it.
#[track_caller]
pub fn rejection(remote: &mut RemoteTask, component: &str, goal: &str) -> String {
    rejection_of(remote, ["p", component, goal])
}

/// Why a task is rejected. Repeats it if the machine was too busy to decide it in time.
#[track_caller]
pub fn rejection_of(remote: &mut RemoteTask, task: [&str; 3]) -> String {
    until("a rejection in time", PATIENCE, || {
        rejected(remote, task).filter(|reason| !is_starved(reason))
    })
}

/// Why a task is rejected. `None` if the INIT was answered before the task was decided; then its end is waited for.
#[track_caller]
pub fn rejected(remote: &mut RemoteTask, [handler, component, goal]: [&str; 3]) -> Option<String> {
    match remote.trigger(handler, component, goal) {
        Err(TriggerError::Rejected { reason, .. }) => Some(reason),
        Ok(task) if task.reply.contains(UNDECIDED) => {
            let _ = remote.wait(task.id, Some(PATIENCE));
            None
        }
        other => panic!("{handler}:{component}:{goal}: {other:?}"),
    }
}

/// Starts a task with the original's client. Repeats it if the machine was too busy.
#[track_caller]
pub fn start_originally(
    client: &mut OriginalClient,
    remote: &mut RemoteTask,
    [handler, component, goal]: [&str; 3],
) -> i64 {
    until("the original's client starts a task", PATIENCE, || {
        let answer = client.trigger(handler, component, goal);
        let id = u32::try_from(answer.number).ok().and_then(TaskId::new);
        let Some(id) = id else {
            // A task that was accepted late may be in the way of the next.
            let is_busy = answer.text.contains(" is busy with task ");
            let is_late = is_starved(&answer.text) || is_busy;
            assert!(is_late, "{handler}:{component}:{goal}: {answer:?}");
            abort_all(remote);
            return None;
        };
        is_started(remote, id, &answer.text).then_some(answer.number)
    })
}

/// Starts a task with the original's client and aborts it. Repeats that until the answer to the ABORT says that the task has
/// ended: a busy machine may answer before. Returns the task's id.
#[track_caller]
pub fn abort_originally(
    client: &mut OriginalClient,
    remote: &mut RemoteTask,
    task: [&str; 3],
) -> i64 {
    until(
        "the answer to an ABORT comes after the end",
        PATIENCE,
        || {
            let id = start_originally(client, remote, task);
            let answer = client.abort(id);
            if answer == (ABORTED, "True") {
                return Some(id);
            }
            assert_eq!(answer, (ACCEPTED, "aborting"), "{task:?}");
            abort_all(remote);
            None
        },
    )
}

/// Aborts all tasks, and waits until none runs.
#[track_caller]
fn abort_all(remote: &mut RemoteTask) {
    until("no task runs", PATIENCE, || {
        let mut tasks = remote.tasks().ok()??.tasks;
        tasks.retain(|task| task.may_run);
        for task in &tasks {
            // The next round shows whether it has ended.
            let _ = remote.abort(&task.id);
        }
        tasks.is_empty().then_some(())
    });
}

/// Waits for a task's end.
#[track_caller]
pub fn end(remote: &mut RemoteTask, id: TaskId) -> (State, String) {
    told(remote.wait(id, Some(PATIENCE)).expect("its end"))
}

/// Aborts a task and waits for its end, which a busy machine may reach after the answer to the ABORT. Returns its text.
#[track_caller]
pub fn abort(remote: &mut RemoteTask, id: TaskId) -> String {
    remote.abort(id).expect("an answer");
    let (state, text) = end(remote, id);
    assert_eq!(state, State::Aborted, "{text}");
    text
}

/// Waits until a task reports this progress. (The text of a task without progress is `None`, which
/// also contains `on`.)
#[track_caller]
pub fn progress(remote: &mut RemoteTask, id: TaskId, part: &str) {
    until(part, PATIENCE, || {
        let status = remote.status(id).ok()?;
        assert_eq!(status.state, State::Accepted, "{status:?}");
        (status.text != NOTHING_KNOWN && status.text.contains(part)).then_some(())
    });
}

/// Whether any thread of a process runs; one that has ended and was not reaped does not. The first thread may
/// end before the others, which hold its files and ports open.
pub fn lives(process: u32) -> bool {
    let threads = std::fs::read_dir(format!("/proc/{process}/task"));
    threads.into_iter().flatten().flatten().any(|thread| {
        let stat = std::fs::read_to_string(thread.path().join("stat"));
        stat.is_ok_and(|stat| {
            let rest = stat.rsplit_once(") ").map(|(_, rest)| rest.to_owned());
            !rest.is_none_or(|rest| rest.starts_with('Z') || rest.starts_with('X'))
        })
    })
}

#[track_caller]
pub fn dies(process: u32) {
    until("the process ends", PATIENCE, || {
        (!lives(process)).then_some(())
    });
}

/// Whether a task was not started because the machine is busy. A task is not forwarded to a server that does not answer within
/// 2 s.
pub fn is_starved(text: &str) -> bool {
    text.contains("the watchdog has not confirmed within") || text.contains("; nothing was sent")
}

/// Ends a process.
#[track_caller]
pub fn kill(process: u32) {
    signal(process, "KILL");
}

/// A file of the project.
pub fn project(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(path)
}
