//! Where the project is, and the shell that runs its commands.

use std::env;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result};
use xshell::{Cmd, Shell};

/// The package of the command `ztl`.
pub(crate) const PACKAGE: &str = "ztl";

/// The packages whose programs, tests and examples are built together, so that each library is compiled once: Cargo
/// compiles one again for each set of features. The C library has fewer, and the simulation its own profile.
pub(crate) const TOGETHER: &str = "--workspace --exclude ztl-c --exclude ztl-simulation";

/// The project's directories. The working directory is the root of the repository.
pub(crate) struct Project {
    pub(crate) sh: Shell,
    /// The root of the repository.
    pub(crate) root: PathBuf,
    /// Cargo's target directory.
    pub(crate) target: PathBuf,
}

impl Project {
    /// Finds the directories and changes to the root.
    pub(crate) fn enter() -> Result<Self> {
        // Read at run time: a compiled-in path would become wrong when the tree is moved.
        let xtask = env::var_os("CARGO_MANIFEST_DIR").map(PathBuf::from);
        let root = xtask.as_deref().and_then(Path::parent);
        let root = root.context("run this program as `cargo xtask`")?;
        env::set_current_dir(root)?;
        // This program is in <target>/debug, independent of CARGO_TARGET_DIR and the configuration.
        let program = env::current_exe()?;
        let target = program.ancestors().nth(2);
        Ok(Self {
            sh: Shell::new()?,
            root: root.to_owned(),
            target: target.context("run this program as `cargo xtask`")?.into(),
        })
    }
}

impl Project {
    /// `cargo` with these words, and the package versions of the lock file.
    pub(crate) fn cargo(&self, words: &str) -> Cmd<'_> {
        self.sh.cmd("cargo").arg("--locked").args(words.split(' '))
    }

    /// Builds the programs that tests start.
    pub(crate) fn build_programs(&self) -> Result<()> {
        let build = self.cargo(&format!("build {TOGETHER} --bins --examples"));
        Ok(build.run()?)
    }

    /// `cargo test` of all packages but the C library and the simulation.
    pub(crate) fn test_together(&self) -> Cmd<'_> {
        self.cargo_test().args(TOGETHER.split(' '))
    }

    /// `cargo test` for tests, which start programs and stop them by signals. This program may ignore signals, as under
    /// `nohup` or in the background of a script; the tests must not.
    pub(crate) fn cargo_test(&self) -> Cmd<'_> {
        let env = self.sh.cmd("env").arg("--default-signal=HUP,INT,QUIT");
        env.args(["cargo", "--locked", "test"])
    }
}

/// The parts of a document before, between and after `<!-- mark -->` and `<!-- /mark -->`.
pub(crate) fn marked<'t>(text: &'t str, mark: &str) -> Option<[&'t str; 3]> {
    let (before, rest) = text.split_once(&format!("<!-- {mark} -->"))?;
    let (between, after) = rest.split_once(&format!("<!-- /{mark} -->"))?;
    Some([before, between, after])
}

/// Whether a command succeeds. It prints nothing.
pub(crate) fn succeeds(command: Cmd<'_>) -> bool {
    let quiet = command.quiet().ignore_stdout().ignore_stderr();
    quiet.run().is_ok()
}
