//! Starts programs.

use std::io;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::Once;

use rustix::process::Signal;
use serde::{Deserialize, Serialize};
use ztl_std::describe::shown;

use super::ignored;
use super::template::Template;
use crate::call::Call;

/// A command as the file describes it.
#[derive(Debug, Clone, Default)]
pub(crate) struct Invocation {
    pub(crate) arguments: Vec<Argument>,
    pub(crate) directory: PathBuf,
    pub(crate) environment: Vec<(String, String)>,
    pub(crate) user: Option<Account>,
    /// Its place in the file: `robot.yaml:9`.
    pub(crate) place: String,
}

/// A user of this machine.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Account {
    pub(crate) name: String,
    pub(crate) uid: u32,
    pub(crate) gid: u32,
    pub(crate) home: PathBuf,
}

/// A command for one task, or one start of a stream.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Launch {
    arguments: Vec<String>,
    directory: PathBuf,
    environment: Vec<(String, String)>,
    user: Option<Account>,
    pub(crate) place: String,
}

/// One argument.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Argument {
    pub(crate) template: Template,
    /// Whether a task is rejected for which it begins with `-`.
    pub(crate) guarded: bool,
}

/// Signals by their names in files and reasons.
pub(crate) const SIGNALS: [(&str, Signal); 8] = [
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
pub(crate) fn signal_name(number: i32) -> String {
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
    /// The command for a task, or why the task is rejected.
    pub(crate) fn launch(&self, call: &Call) -> Result<Launch, String> {
        let fill = |argument: &Argument| {
            let text = argument.template.fill(call)?;
            if argument.guarded && text.starts_with('-') {
                return Err(format!(
                    "'{}' begins with '-', which the program might take for an option; `dashes: allowed` in the server's file allows it",
                    shown(&text)
                ));
            }
            Ok(text)
        };
        let arguments = self.arguments.iter().map(fill).collect::<Result<_, _>>()?;
        let of_task = [
            ("ZTL_GOAL", call.goal.text.as_str()),
            ("ZTL_ID", &call.id.to_string()),
            ("ZTL_HANDLER", &call.handler),
            ("ZTL_COMPONENT", &call.component),
            ("ZTL_SCOPE", &call.scope),
        ];
        Ok(self.with(arguments, &of_task))
    }

    /// The command for a stream, which has no placeholders.
    pub(crate) fn launch_stream(&self, scope: &str, id: &str) -> Launch {
        let arguments = self.arguments.iter();
        let arguments = arguments.map(|argument| argument.template.beginning().to_owned());
        self.with(arguments.collect(), &[("ZTL_ID", id), ("ZTL_SCOPE", scope)])
    }

    fn with(&self, arguments: Vec<String>, more: &[(&str, &str)]) -> Launch {
        let mut environment = self.environment.clone();
        let more = more.iter();
        environment.extend(more.map(|(name, value)| ((*name).to_owned(), (*value).to_owned())));
        Launch {
            arguments,
            directory: self.directory.clone(),
            environment,
            user: self.user.clone(),
            place: self.place.clone(),
        }
    }
}

impl Launch {
    /// Starts the program in a process group of its own. May block, as on a slow disk. Call this on a thread of
    /// its own, which may belong to another user afterwards. `piped`: whether its output goes into pipes or is
    /// discarded.
    pub(crate) fn spawn(&self, piped: bool) -> Result<Child, String> {
        static SIGNALS: Once = Once::new();
        SIGNALS.call_once(ignored::do_not_inherit);
        let Some((program, rest)) = self.arguments.split_first() else {
            return Err("there is no program".to_owned());
        };
        // An empty root has no /dev/null. Pipes do, with their other ends dropped below.
        let is_bare = !Path::new("/dev/null").exists();
        let pipe = || match piped || is_bare {
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
            // Python would print everything at its end.
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
        if !piped {
            drop((child.stdout.take(), child.stderr.take()));
        }
        Ok(child)
    }

    fn cannot_start(&self, program: &str, error: &io::Error) -> String {
        let place = &self.place;
        let directory = self.directory.display();
        let found = find(program, &self.environment);
        let why = match error.kind() {
            io::ErrorKind::NotFound if !self.directory.is_dir() => {
                format!("there is no directory {directory}; correct it")
            }
            io::ErrorKind::NotFound if found.is_some() => {
                "there is no interpreter as its first line (#!) names; install it or correct the line"
                    .to_owned()
            }
            io::ErrorKind::NotFound => "not found; install it or correct the path".to_owned(),
            io::ErrorKind::PermissionDenied => {
                format!("not executable; use chmod +x, and check the permissions of {directory}")
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

/// Finds a program as the system does.
pub(crate) fn find(program: &str, environment: &[(String, String)]) -> Option<PathBuf> {
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

/// The path of a program in the file: with a `/`, relative to the file's directory.
pub(crate) fn program_path(program: &str, base: &Path) -> String {
    match program.contains('/') {
        true => base.join(program).display().to_string(),
        false => program.to_owned(),
    }
}

/// Changes this thread's user and groups, which its children inherit. `Command::uid` would drop the user's groups,
/// such as that of the sound card.
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

/// Only the user and their first group.
#[cfg(not(target_os = "linux"))]
fn become_user(user: &Account, command: &mut Command) -> io::Result<()> {
    command.uid(user.uid).gid(user.gid);
    Ok(())
}
