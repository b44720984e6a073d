//! Compiles C programs against the library, and runs them.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Duration;

use ztl_tests::lab::{Ended, Process};

/// Longest time for a program that valgrind runs.
pub(crate) const PATIENCE: Duration = Duration::from_secs(60);

/// A way to compile a program and to run it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Build {
    /// With the static library.
    C89,
    /// The same, by the compiler for C++.
    Cpp98,
    /// With the shared library.
    Shared,
    /// With the static library, and the compiler's checks of memory, leaks and undefined behaviour.
    Sanitized,
    /// With the static library, and valgrind's checks of memory and leaks.
    Valgrind,
}

/// The exit status of a program in which valgrind finds something.
const FOUND: &str = "99";

impl Build {
    /// An example by its name, ready to be started.
    #[track_caller]
    pub(crate) fn example(self, name: &str) -> Command {
        self.program(&[root().join("examples/c").join(name)], "ztl")
    }

    /// A program of these tests by its name, ready to be started.
    #[track_caller]
    pub(crate) fn test(self, name: &str) -> Command {
        self.program(&[root().join("ztl-c/tests/c").join(name)], "ztl")
    }

    /// A program that is a node, of these sources in one directory, ready to be started.
    #[track_caller]
    pub(crate) fn node(self, directory: &str, names: &[&str]) -> Command {
        let source = |name| root().join(directory).join(name);
        let sources: Vec<PathBuf> = names.iter().map(source).collect();
        self.program(&sources, "ztl_node")
    }

    #[track_caller]
    fn program(self, sources: &[PathBuf], library: &str) -> Command {
        static NEXT: AtomicU32 = AtomicU32::new(0);
        let number = NEXT.fetch_add(1, Ordering::Relaxed);
        let name = format!("{}-{number}", std::process::id());
        let program = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
        let is_cpp = sources
            .iter()
            .any(|source| source.extension().is_some_and(|end| end == "cpp"));
        let mut compiler = match self {
            _ if is_cpp => Command::new("g++"),
            Self::Cpp98 => Command::new("g++"),
            _ => Command::new("gcc"),
        };
        match self {
            Self::Cpp98 => compiler.args(["-x", "c++", "-std=c++98"]),
            _ if is_cpp => compiler.arg("-std=c++98"),
            _ => compiler.arg("-std=c89"),
        };
        compiler.args(["-pedantic", "-Wall", "-Wextra", "-Werror", "-g"]);
        if self == Self::Sanitized {
            compiler.args(["-fsanitize=address,undefined", "-fno-sanitize-recover"]);
        }
        let place = self::library();
        compiler.arg("-I").arg(place.join("include"));
        compiler.arg("-o").arg(&program).args(sources);
        let lib = place.join("lib");
        if self == Self::Shared {
            compiler.arg("-L").arg(&lib).arg(format!("-l{library}"));
            compiler.arg(format!("-Wl,-rpath,{}", lib.display()));
        } else {
            // Not as a source of the language that `-x` tells.
            let archive = lib.join(format!("lib{library}.a"));
            compiler.args(["-x", "none"]).arg(archive);
        }
        compiler.args(["-lpthread", "-ldl", "-lm", "-lrt"]);
        let ended = Process::start(&mut compiler).end(PATIENCE);
        assert_eq!(ended.code, Some(0), "{compiler:?}:\n{}", ended.stderr);

        if self != Self::Valgrind {
            return Command::new(program);
        }
        let mut valgrind = Command::new("valgrind");
        let suppressions = root().join("ztl-c/tests/c/valgrind.supp");
        valgrind.args(["--quiet", "--leak-check=full", "--show-leak-kinds=all"]);
        valgrind.arg("--errors-for-leak-kinds=all");
        valgrind.arg(format!("--error-exitcode={FOUND}"));
        valgrind.arg(format!("--suppressions={}", suppressions.display()));
        valgrind.arg(program);
        valgrind
    }
}

/// The repository.
pub(crate) fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

/// Where the libraries and the headers are.
#[track_caller]
pub(crate) fn library() -> PathBuf {
    let place = std::env::var_os("ZTL_C").filter(|place| !place.is_empty());
    let place = place.expect("ZTL_C is not set: run `cargo xtask test --only c`");
    PathBuf::from(place)
}

/// The output of a program that succeeded; the sanitizers must report nothing.
#[track_caller]
pub(crate) fn ended_well(process: Process) -> String {
    let Ended {
        code,
        stdout,
        stderr,
        // valgrind is some 50 times slower.
    } = process.end(PATIENCE * 5);
    assert_eq!((code, stderr.as_str()), (Some(0), ""), "{stdout}");
    stdout
}
