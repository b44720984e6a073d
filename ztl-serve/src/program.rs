//! A program as the file describes it, and how it is started.

use std::io;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Once};
use std::time::Duration;

use rustix::process::Signal;
use serde::{Deserialize, Serialize};

use super::ignored;
use super::template::{Call, Template};

/// A program that does a task.
#[derive(Debug, Clone)]
pub(super) struct Program {
    pub(super) run: Arc<Invocation>,
    /// Lines of stdout that begin so are progress.
    pub(super) marker: Option<String>,
    pub(super) result: ResultKind,
    /// Most bytes of output that are kept.
    pub(super) output: usize,
    /// Exit codes by which it refuses its goal.
    pub(super) refused_by: Vec<u8>,
    /// How long it may think about that, before the client is told that it is taken.
    pub(super) decide: Duration,
    pub(super) limit: Option<Duration>,
    pub(super) abort: Abort,
    /// Whether what it has started and left behind is killed when it ends by itself.
    pub(super) tidy: bool,
}

/// How it is asked to end before its time.
#[derive(Debug, Clone)]
pub(super) struct Abort {
    /// Whether clients may ask.
    pub(super) allowed: bool,
    pub(super) by: AbortBy,
    /// How long it has to end, and all that it has started; then it is killed.
    pub(super) grace: Duration,
}

#[derive(Debug, Clone)]
pub(super) enum AbortBy {
    /// To the whole group.
    Signal(&'static str, Signal),
    Program(Arc<Invocation>),
}

/// What becomes the result.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum ResultKind {
    Last,
    All,
    Json,
    Nothing,
}

/// What is executed, and in what surroundings.
#[derive(Debug, Clone)]
pub(super) struct Invocation {
    pub(super) arguments: Vec<Argument>,
    pub(super) directory: PathBuf,
    pub(super) environment: Vec<(String, String)>,
    pub(super) user: Option<Account>,
    /// Where it stands: `robot.yaml:9`.
    pub(super) place: String,
}

/// A user of this machine.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Account {
    pub(super) name: String,
    pub(super) uid: u32,
    pub(super) gid: u32,
    pub(super) home: PathBuf,
}

/// A program with all that it is given for one task.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Launch {
    arguments: Vec<String>,
    directory: PathBuf,
    environment: Vec<(String, String)>,
    user: Option<Account>,
    place: String,
}

/// One argument.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Argument {
    pub(super) template: Template,
    /// Whether it is refused when it begins with `-`.
    pub(super) guarded: bool,
}

/// What signals are called in files and reasons.
pub(super) const SIGNALS: [(&str, Signal); 8] = [
    ("INT", Signal::INT),
    ("TERM", Signal::TERM),
    ("HUP", Signal::HUP),
    ("QUIT", Signal::QUIT),
    ("USR1", Signal::USR1),
    ("USR2", Signal::USR2),
    ("CONT", Signal::CONT),
    ("KILL", Signal::KILL),
];

/// A signal's name, as in `SIGSEGV`.
pub(super) fn signal_name(number: i32) -> String {
    const OTHERS: [(&str, Signal); 7] = [
        ("ABRT", Signal::ABORT),
        ("SEGV", Signal::SEGV),
        ("BUS", Signal::BUS),
        ("ILL", Signal::ILL),
        ("FPE", Signal::FPE),
        ("PIPE", Signal::PIPE),
        ("ALRM", Signal::ALARM),
    ];
    let mut known = SIGNALS.iter().chain(&OTHERS);
    match known.find(|(_, signal)| signal.as_raw() == number) {
        Some((name, _)) => format!("SIG{name}"),
        None => format!("signal {number}"),
    }
}

impl Invocation {
    /// What is started for a task, or why that is refused.
    pub(super) fn launch(&self, call: &Call) -> Result<Launch, String> {
        let fill = |argument: &Argument| {
            let text = argument.template.fill(call)?;
            if argument.guarded && text.starts_with('-') {
                return Err(format!(
                    "'{}' begins with '-', which the program might take for an option; whoever serves it can allow that (dashes: allowed)",
                    super::rule::shown(&text)
                ));
            }
            Ok(text)
        };
        let mut environment = self.environment.clone();
        let of_task = call.environment();
        environment.extend(of_task.map(|(name, value)| (name.to_owned(), value)));
        Ok(Launch {
            arguments: self.arguments.iter().map(fill).collect::<Result<_, _>>()?,
            directory: self.directory.clone(),
            environment,
            user: self.user.clone(),
            place: self.place.clone(),
        })
    }
}

impl Launch {
    /// Starts it in a process group of its own. May take its time where the program lies on a slow disk.
    /// To be called on a thread that does nothing else afterwards: it may belong to another user then.
    /// `heard`: whether what it says goes into pipes, or nowhere.
    ///
    /// # Errors
    /// Why it could not be started, and what is to be done.
    pub(super) fn spawn(&self, heard: bool) -> Result<Child, String> {
        static SIGNALS: Once = Once::new();
        SIGNALS.call_once(ignored::keep_to_oneself);
        let Some((program, rest)) = self.arguments.split_first() else {
            return Err("there is no program".to_owned());
        };
        // In an empty root: pipes, whose other ends are dropped below.
        let is_bare = !Path::new("/dev/null").exists();
        let pipe = || match heard || is_bare {
            true => Stdio::piped(),
            false => Stdio::null(),
        };
        let mut command = Command::new(program);
        command
            .args(rest)
            .current_dir(&self.directory)
            .stdin(if is_bare {
                Stdio::piped()
            } else {
                Stdio::null()
            })
            .stdout(pipe())
            .stderr(pipe())
            .process_group(0);
        if std::env::var_os("PYTHONUNBUFFERED").is_none() {
            // Else Python keeps back what it prints until it ends.
            command.env("PYTHONUNBUFFERED", "1");
        }
        if let Some(user) = &self.user {
            let name = &user.name;
            command
                .env("HOME", &user.home)
                .env("USER", name)
                .env("LOGNAME", name);
            become_user(user, &mut command).map_err(|error| {
                format!("{program}: cannot run as user '{name}': {error}; `ztl serve` must run as that user or as root ({})", self.place)
            })?;
        }
        command.envs(self.environment.iter().map(|(name, value)| (name, value)));
        let mut child = command
            .spawn()
            .map_err(|error| self.cannot_start(program, &error))?;
        drop(child.stdin.take());
        if !heard {
            drop((child.stdout.take(), child.stderr.take()));
        }
        Ok(child)
    }

    /// Why it could not be started, in words.
    fn cannot_start(&self, program: &str, error: &io::Error) -> String {
        let place = &self.place;
        let directory = self.directory.display();
        let found = find(program, &self.environment);
        let why = match error.kind() {
            io::ErrorKind::NotFound if !self.directory.is_dir() => {
                format!("the directory {directory} is not there; correct it")
            }
            io::ErrorKind::NotFound if found.is_some() => {
                "what its first line names (#!) is not there; install that or correct the line"
                    .to_owned()
            }
            io::ErrorKind::NotFound => "not found; install it or correct the path".to_owned(),
            io::ErrorKind::PermissionDenied => {
                format!("not executable; use chmod +x, and see that {directory} may be entered")
            }
            io::ErrorKind::ArgumentListTooLong => {
                return format!("the goal is too long for an argument of {program}");
            }
            io::ErrorKind::InvalidInput => {
                return "the goal contains a NUL byte, which no argument can".to_owned();
            }
            _ => return format!("{program}: cannot be started: {error} ({place})"),
        };
        format!("{program}: {why} at {place}")
    }
}

/// Where a program is.
pub(super) fn find(program: &str, environment: &[(String, String)]) -> Option<PathBuf> {
    if program.contains('/') {
        return Some(PathBuf::from(program)).filter(|path| path.is_file());
    }
    let own = environment.iter().rev().find(|(name, _)| name == "PATH");
    let path = match own {
        Some((_, path)) => path.into(),
        None => std::env::var_os("PATH").unwrap_or_default(),
    };
    let places = std::env::split_paths(&path).map(|place| place.join(program));
    places.into_iter().find(|path| path.is_file())
}

/// The path that a program of the file means: one with a `/` is relative to the file's directory.
pub(super) fn program_path(program: &str, base: &Path) -> String {
    match program.contains('/') {
        true => base.join(program).display().to_string(),
        false => program.to_owned(),
    }
}

/// What is started by this thread from now on belongs to the user, who has all their groups: the
/// kernel keeps these for each thread.
/// (`Command::uid` would take the groups away, as that of the sound card.)
#[cfg(target_os = "linux")]
fn become_user(user: &Account, _command: &mut Command) -> io::Result<()> {
    use rustix::process::{Gid, Uid, getgid, getuid};
    use rustix::thread::{set_thread_groups, set_thread_res_gid, set_thread_res_uid};

    let (uid, gid) = (Uid::from_raw(user.uid), Gid::from_raw(user.gid));
    if getuid() == uid && getgid() == gid {
        return Ok(());
    }
    let name = std::ffi::CString::new(user.name.as_str())?;
    let groups = nix::unistd::getgrouplist(&name, nix::unistd::Gid::from_raw(user.gid))
        .map_err(io::Error::from)?;
    let groups: Vec<Gid> = groups
        .iter()
        .map(|group| Gid::from_raw(group.as_raw()))
        .collect();
    set_thread_groups(&groups)?;
    set_thread_res_gid(gid, gid, gid)?;
    set_thread_res_uid(uid, uid, uid)?;
    Ok(())
}

/// The user with their first group.
#[cfg(not(target_os = "linux"))]
fn become_user(user: &Account, command: &mut Command) -> io::Result<()> {
    command.uid(user.uid).gid(user.gid);
    Ok(())
}
