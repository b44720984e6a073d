//! The root directory in which the static program runs.

use std::path::Path;
use std::process::Command;

use ztl_tests::lab::{Process, Scratch, python};

/// An empty root that holds only the program, and its emulator or random number devices.
pub struct Place {
    scratch: Scratch,
    /// The emulator's options, if there is one; it is `/emulator`.
    emulator: Option<Vec<String>>,
    kernel: Option<String>,
    /// Whether the directory is the program's root. Only the superuser can make devices for random
    /// numbers in it, which old kernels need.
    is_root: bool,
}

fn variable(name: &str) -> Option<String> {
    std::env::var(name).ok().filter(|value| !value.is_empty())
}

fn is_superuser() -> bool {
    Process::run(Command::new("id").arg("-u")).stdout.trim() == "0"
}

impl Place {
    #[track_caller]
    pub fn new() -> Self {
        let program = variable("ZTL_DIST").expect("run this as `cargo xtask dist --check`");
        let scratch = Scratch::new();
        let copy = |from: &Path, to: &str| {
            std::fs::copy(from, scratch.path(to))
                .unwrap_or_else(|error| panic!("{}: {error}", from.display()));
        };
        copy(Path::new(&program), "ztl");
        let emulator = variable("ZTL_DIST_EMULATOR").map(|line| {
            let mut words = line.split(' ').map(str::to_owned);
            let name = words.next().expect("an emulator");
            copy(&Path::new("/usr/bin").join(name), "emulator");
            words.collect()
        });
        let kernel = variable("ZTL_DIST_KERNEL");
        let is_root = kernel.is_none() || is_superuser();
        if kernel.is_some() && is_root {
            std::fs::create_dir(scratch.path("dev")).expect("a directory");
            // Before it reads the second, it checks the first for enough entropy.
            for (name, minor) in [("random", "8"), ("urandom", "9")] {
                let mut mknod = Command::new("mknod");
                mknod
                    .args(["-m", "666"])
                    .arg(scratch.path("dev").join(name));
                let made = Process::run(mknod.args(["c", "1", minor]));
                assert_eq!(made.code, Some(0), "{made:?}");
            }
        }
        Self {
            scratch,
            emulator,
            kernel,
            is_root,
        }
    }

    /// Whether signals can be caught here. QEMU 7.2's emulation of 32-bit x86 crashes on every
    /// processor when a thread resumes after a signal (after `rt_sigreturn`). The same program works on a
    /// real kernel, which is tested, too (`ZTL_DIST_KERNEL`).
    pub fn can_catch_signals(&self) -> bool {
        let emulator = variable("ZTL_DIST_EMULATOR").unwrap_or_default();
        let can = !emulator.starts_with("qemu-i386");
        if !can {
            eprintln!("left out: what needs signals, which {emulator} cannot");
        }
        can
    }

    /// Writes a file into it.
    #[track_caller]
    pub fn write(&self, name: &str, text: &str) {
        let path = self.scratch.path(name);
        let directory = path.parent().expect("a directory");
        std::fs::create_dir_all(directory).expect("a directory");
        std::fs::write(path, text).expect("a file");
    }

    /// The path of a file in it, as the program sees it.
    pub fn path_inside(&self, name: &str) -> String {
        match self.is_root {
            true => format!("/{name}"),
            false => self.scratch.path(name).display().to_string(),
        }
    }

    /// The arguments that start the program for a process inside.
    pub fn words_inside(&self) -> Vec<String> {
        let mut words = Vec::new();
        if let Some(options) = &self.emulator {
            words.push(self.path_inside("emulator"));
            words.extend(options.iter().cloned());
        }
        words.push(self.path_inside("ztl"));
        words
    }

    /// `ztl` with these arguments.
    pub fn ztl(&self, line: &str) -> Command {
        let mut command = self.enter();
        command.args(self.words_inside());
        command.args(line.split(' '));
        command
    }

    /// `ztl --version` on a kernel that reports this version; only an emulator can do that.
    pub fn ztl_on_kernel(&self, release: &str) -> Option<Command> {
        self.emulator.as_ref()?;
        let mut words = self.words_inside();
        words.splice(1..1, ["-r".to_owned(), release.to_owned()]);
        let mut command = self.enter();
        command.args(words).arg("--version");
        Some(command)
    }

    /// What starts a program inside.
    fn enter(&self) -> Command {
        let mut words = Vec::new();
        if let Some(kernel) = &self.kernel {
            let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("command/dist/old_kernel.py");
            words.push(python().display().to_string());
            words.push(script.display().to_string());
            words.push(kernel.clone());
        }
        let root = self.scratch.path("").display().to_string();
        if self.is_root {
            match is_superuser() {
                true => words.push("chroot".to_owned()),
                false => words.extend(["unshare", "--map-root-user", "--root"].map(str::to_owned)),
            }
            words.push(root);
        }
        let Some((first, rest)) = words.split_first() else {
            // `env` only runs the program that follows.
            return Command::new("env");
        };
        let mut command = Command::new(first);
        command.args(rest);
        command
    }
}
