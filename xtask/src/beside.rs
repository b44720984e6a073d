//! Steps that run at the same time as the others, in a process of their own at the lowest priority: they use the processor
//! while tests wait, and delay no test. They get the usual priority when only they are left.

use std::env;
use std::fs::File;
use std::io;
use std::os::unix::process::CommandExt as _;
use std::path::PathBuf;
use std::process::{Child, ChildStdin, Command, Stdio};

use anyhow::{Context as _, Result, ensure};

use crate::project::Project;

/// Runs its arguments. When its input ends, also because this program was killed, it kills its whole process group.
const SCRIPT: &str =
    "exec 3<&0 </dev/null; (cat <&3 >/dev/null; kill 0) & exec 3<&- nice -n 19 \"$@\"";

/// Gives a process group the priority of this program. Not everybody may raise one.
const RAISE: &str = "renice -n \"$(nice)\" -g \"$1\" >/dev/null 2>&1";

/// The running process. Dropping this kills the process and everything that the process has started.
pub(crate) struct Beside {
    child: Child,
    input: Option<ChildStdin>,
    /// File with the output of the process, which [`end`](Self::end) prints.
    log: PathBuf,
}

impl Beside {
    /// Starts this program with these arguments.
    pub(crate) fn start<'a>(
        project: &Project,
        arguments: impl IntoIterator<Item = &'a str>,
    ) -> Result<Self> {
        let log = project.target.join("beside.log");
        Self::start_command(Command::new(env::current_exe()?).args(arguments), log)
    }

    fn start_command(command: &Command, log: PathBuf) -> Result<Self> {
        let output = File::create(&log).with_context(|| log.display().to_string())?;
        let mut child = Command::new("sh")
            .args(["-c", SCRIPT, "sh"])
            .arg(command.get_program())
            .args(command.get_args())
            .process_group(0)
            .stdin(Stdio::piped())
            .stderr(output.try_clone()?)
            .stdout(output)
            .spawn()?;
        let input = child.stdin.take();
        Ok(Self { child, input, log })
    }

    /// Checks without waiting whether the process has failed.
    ///
    /// # Errors
    /// If the process has failed.
    pub(crate) fn has_not_failed(&mut self) -> Result<()> {
        let ended = self.child.try_wait()?;
        match ended.is_none_or(|status| status.success()) {
            true => Ok(()),
            false => self.end(),
        }
    }

    /// Waits for the end of the process, and prints its output.
    ///
    /// # Errors
    /// If the process has failed.
    pub(crate) fn end(&mut self) -> Result<()> {
        // At the lowest priority, it could take hours beside busy programs of others. Has no effect where
        // priorities may not be raised, or if the process has ended already.
        let group = self.child.id().to_string();
        let _ = Command::new("sh")
            .args(["-c", RAISE, "sh", &group])
            .status()?;
        let status = self.child.wait()?;
        io::copy(&mut File::open(&self.log)?, &mut io::stdout())?;
        ensure!(status.success(), "a step beside the others failed");
        Ok(())
    }
}

impl Drop for Beside {
    fn drop(&mut self) {
        drop(self.input.take());
        let _ = self.child.wait();
    }
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::io::Read as _;

    use super::*;

    fn start(script: &str) -> Beside {
        let name = format!("ztl-beside-{}-{script:.4}", std::process::id());
        let log = env::temp_dir().join(name);
        Beside::start_command(Command::new("sh").args(["-c", script]), log).unwrap()
    }

    #[test]
    fn a_failure_is_reported_with_the_output() {
        let mut fine = start("true");
        fine.end().unwrap();
        fine.has_not_failed().unwrap();
        let mut failing = start("exit 3");
        assert!(failing.end().is_err());
        assert!(failing.has_not_failed().is_err());
        for beside in [fine, failing] {
            fs::remove_file(&beside.log).unwrap();
        }
    }

    #[test]
    fn it_has_the_usual_priority_when_its_end_is_waited_for() {
        let usual = Command::new("nice").output().unwrap().stdout;
        let usual = String::from_utf8(usual).unwrap();
        let usual = usual.trim();
        // Root may raise a priority, except in most containers.
        let mut raise = Command::new("nice");
        raise.args(["sh", "-c", "renice -n $1 $$", "sh", usual]);
        if !raise.status().unwrap().success() {
            eprintln!("not run: this program may not raise a priority");
            return;
        }
        let mut beside = start(&format!(
            "nice; for i in $(seq 3000); do [ $(nice) = {usual} ] && exit; sleep 0.01; done; exit 3"
        ));
        while !fs::read_to_string(&beside.log).unwrap().ends_with('\n') {
            std::thread::sleep(std::time::Duration::from_millis(1));
            beside.has_not_failed().unwrap();
        }
        beside.end().unwrap();
        fs::remove_file(&beside.log).unwrap();
    }

    #[test]
    fn dropping_it_ends_all_that_it_has_started() {
        let fifo = env::temp_dir().join(format!("ztl-beside-{}", std::process::id()));
        let made = Command::new("mkfifo").arg(&fifo).status();
        assert!(made.unwrap().success());
        let fifo_shown = fifo.display();
        // Writes a line only if it is not killed.
        let beside = start(&format!("(sleep 60; echo alive) > '{fifo_shown}' & wait"));
        // Waits until the subshell has opened the other end. Reading then ends when every process with the other end has ended.
        let mut started = File::open(&fifo).unwrap();
        let log = beside.log.clone();
        drop(beside);
        let mut said = String::new();
        started.read_to_string(&mut said).unwrap();
        assert_eq!(said, "");
        fs::remove_file(log).unwrap();
        fs::remove_file(fifo).unwrap();
    }
}
