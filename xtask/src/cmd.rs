//! Runs the programs of a step, and prints each as a person would type it.

use std::ffi::{OsStr, OsString};
use std::fmt;
use std::io::{Read, Write};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::thread;
use std::time::{Duration, Instant};

/// A result whose error message tells a person what to do.
pub(crate) type Outcome<T = ()> = Result<T, String>;

/// A command line with environment variables.
pub(crate) struct Cmd {
    env: Vec<(&'static str, OsString)>,
    program: OsString,
    args: Vec<OsString>,
}

impl Cmd {
    /// A program without arguments.
    pub(crate) fn program(program: impl Into<OsString>) -> Self {
        Self {
            env: Vec::new(),
            program: program.into(),
            args: Vec::new(),
        }
    }

    /// A program and its arguments, split at spaces.
    pub(crate) fn new(line: &str) -> Self {
        let (program, args) = line.split_once(' ').unwrap_or((line, ""));
        Self::program(program).args(args)
    }

    /// Adds arguments, split at spaces.
    pub(crate) fn args(mut self, words: &str) -> Self {
        self.args
            .extend(words.split_whitespace().map(OsString::from));
        self
    }

    /// Adds one argument, which may contain spaces.
    pub(crate) fn arg(mut self, arg: impl AsRef<OsStr>) -> Self {
        self.args.push(arg.as_ref().to_owned());
        self
    }

    /// Sets an environment variable.
    pub(crate) fn env(mut self, key: &'static str, value: impl Into<OsString>) -> Self {
        self.env.push((key, value.into()));
        self
    }

    /// Prints the command and runs it; its output goes to ours.
    pub(crate) fn run(&self) -> Outcome {
        println!("$ {self}");
        let status = self.command().status().map_err(|e| self.no_start(&e))?;
        self.judge(status)
    }

    /// Like [`Cmd::run`], but kills the program after `limit`.
    pub(crate) fn run_within(&self, limit: Duration) -> Outcome {
        println!("$ {self}    (at most {} s)", limit.as_secs());
        let mut child = self.command().spawn().map_err(|e| self.no_start(&e))?;
        match wait_until(&mut child, Instant::now() + limit) {
            Ok(Some(status)) => self.judge(status),
            Ok(None) => Err(format!(
                "`{self}` was still running after {} s and was killed",
                limit.as_secs()
            )),
            Err(error) => Err(format!("cannot wait for `{self}`: {error}")),
        }
    }

    /// Sends `input` to the program and returns its stdout, which must be short. Kills it after `limit`.
    pub(crate) fn answer_within(&self, input: &[u8], limit: Duration) -> Outcome<String> {
        println!("$ {self}    (at most {} s)", limit.as_secs());
        let mut child = self
            .command()
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .map_err(|e| self.no_start(&e))?;
        let lost = |error: std::io::Error| format!("cannot exchange data with `{self}`: {error}");
        if let Some(mut stdin) = child.stdin.take() {
            stdin.write_all(input).map_err(lost)?;
        }
        let ended = wait_until(&mut child, Instant::now() + limit).map_err(lost)?;
        let mut output = Vec::new();
        if let Some(mut stdout) = child.stdout.take() {
            stdout.read_to_end(&mut output).map_err(lost)?;
        }
        let output = String::from_utf8_lossy(&output).into_owned();
        match ended {
            Some(status) => self.judge(status).map(|()| output),
            None => Err(format!(
                "`{self}` was still running after {} s and was killed; its output:\n{output}",
                limit.as_secs()
            )),
        }
    }

    /// Runs the command silently; returns whether it succeeded, its stdout and its stderr.
    pub(crate) fn capture(&self) -> Outcome<(bool, String, String)> {
        let done = self
            .command()
            .stdin(Stdio::null())
            .output()
            .map_err(|e| self.no_start(&e))?;
        let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
        Ok((
            done.status.success(),
            text(&done.stdout),
            text(&done.stderr),
        ))
    }

    /// Runs the command silently; returns its stdout without surrounding whitespace.
    pub(crate) fn stdout(&self) -> Outcome<String> {
        match self.capture()? {
            (true, stdout, _) => Ok(stdout.trim().to_owned()),
            (false, _, stderr) => Err(format!("`{self}` failed: {}", stderr.trim())),
        }
    }

    fn command(&self) -> Command {
        let mut command = Command::new(&self.program);
        command.args(&self.args);
        command.envs(self.env.iter().map(|(key, value)| (key, value)));
        command
    }

    fn judge(&self, status: ExitStatus) -> Outcome {
        if status.success() {
            Ok(())
        } else {
            Err(format!("`{self}` ended with {status}"))
        }
    }

    fn no_start(&self, error: &std::io::Error) -> String {
        format!("cannot start `{self}`: {error}")
    }
}

/// Waits for the child; kills it after the deadline and returns `None`.
fn wait_until(child: &mut Child, deadline: Instant) -> std::io::Result<Option<ExitStatus>> {
    while Instant::now() < deadline {
        if let Some(status) = child.try_wait()? {
            return Ok(Some(status));
        }
        thread::sleep(Duration::from_millis(50));
    }
    child.kill()?;
    child.wait()?;
    Ok(None)
}

/// The form that can be pasted into a shell.
impl fmt::Display for Cmd {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (key, value) in &self.env {
            write!(f, "{key}={} ", quoted(value))?;
        }
        write!(f, "{}", quoted(&self.program))?;
        for arg in &self.args {
            write!(f, " {}", quoted(arg))?;
        }
        Ok(())
    }
}

/// The word, in single quotes if a shell would split it.
fn quoted(word: &OsStr) -> String {
    let word = word.to_string_lossy();
    let plain = |c: char| c.is_ascii_alphanumeric() || "-_=+./,:@%".contains(c);
    if !word.is_empty() && word.chars().all(plain) {
        word.into_owned()
    } else {
        format!("'{}'", word.replace('\'', r"'\''"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_printed_command_survives_the_shell() {
        let command = Cmd::new("printf %s,")
            .args("a b=1")
            .arg("it's two words")
            .arg("");
        assert_eq!(
            command.to_string(),
            r"printf %s, a b=1 'it'\''s two words' ''"
        );
        let typed = Cmd::new("sh -c").arg(command.to_string());
        assert_eq!(typed.stdout(), command.stdout());
        assert_eq!(typed.stdout().unwrap(), "a,b=1,it's two words,,");
    }

    #[test]
    fn an_environment_variable_is_set_and_shown() {
        let command = Cmd::new("sh -c").arg("echo $SEEN").env("SEEN", "a b");
        assert_eq!(command.to_string(), "SEEN='a b' sh -c 'echo $SEEN'");
        assert_eq!(command.stdout().unwrap(), "a b");
    }

    #[test]
    fn a_failure_names_the_command() {
        let message = Cmd::new("false").run().unwrap_err();
        assert!(message.starts_with("`false` ended with"), "{message}");
        let message = Cmd::new("no-such-program x").run().unwrap_err();
        assert!(message.contains("`no-such-program x`"), "{message}");
    }

    #[test]
    fn a_program_that_hangs_is_killed() {
        let begin = Instant::now();
        let message = Cmd::new("sleep 30")
            .run_within(Duration::from_millis(100))
            .unwrap_err();
        assert!(message.contains("still running"), "{message}");
        let message = Cmd::new("sh -c")
            .arg("head -c 3; sleep 30 >&-")
            .answer_within(b"abc", Duration::from_millis(300))
            .unwrap_err();
        assert!(message.ends_with("its output:\nabc"), "{message}");
        assert!(begin.elapsed() < Duration::from_secs(10));
    }

    #[test]
    fn a_program_gets_input_and_answers() {
        let answer = Cmd::new("head -c 2").answer_within(b"abc", Duration::from_secs(10));
        assert_eq!(answer.unwrap(), "ab");
    }
}
