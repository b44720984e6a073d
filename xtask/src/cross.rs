//! Requirements of a build for a bare target: its `core`, and a linker.

use std::env;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result};
use xshell::{Cmd, Shell, cmd};

use crate::install;
use crate::project::Project;

/// The smallest ARM core, without atomic read-modify-write or division; one with a floating-point unit; a
/// RISC-V core without atomics.
pub(crate) const TARGETS: [&str; 3] = [
    SMALLEST,
    "thumbv7em-none-eabihf",
    "riscv32imc-unknown-none-elf",
];

/// A Cortex-M0, for checks that need only one target.
pub(crate) const SMALLEST: &str = "thumbv6m-none-eabi";

/// Debian's compiler, and the source of `core` for targets that rustup does not provide.
pub(crate) const DEBIAN_RUSTC: &str = "/usr/bin/rustc";

/// Where `core` comes from.
pub(crate) enum Core {
    /// Compiled, in this directory of the compiler's libraries.
    Compiled(PathBuf),
    /// Compiled by Cargo from the source that Debian ships.
    Source,
}

/// Asks rustup for the missing ones of these targets; those it does not provide stay missing.
pub(crate) fn add(sh: &Shell, targets: &[&str]) {
    let lacks = |target: &&&str| compiled_core(sh, target).is_none();
    let lacking: Vec<&&str> = targets.iter().filter(lacks).collect();
    if lacking.is_empty() || !install::has(sh, "rustup") {
        return;
    }
    if let Err(error) = cmd!(sh, "rustup target add {lacking...}").run() {
        println!("{error}; continuing without");
    }
}

impl Core {
    /// Finds `core` for this target, and installs it if necessary.
    pub(crate) fn provide(sh: &Shell, target: &str) -> Result<Self> {
        add(sh, &[target]);
        if let Some(libraries) = compiled_core(sh, target) {
            return Ok(Self::Compiled(libraries));
        }
        let lacking = || format!("no `core` for {target}, and rustup does not provide it");
        provide_debian(sh).with_context(lacking)?;
        Ok(Self::Source)
    }

    /// `cargo build`, or another command, for the target, below this directory in the target directory.
    pub(crate) fn cargo<'a>(
        &self,
        project: &'a Project,
        command: &str,
        target: &str,
        below: &str,
    ) -> Result<Cmd<'a>> {
        let build = project.cargo(command).args(["--target", target]);
        let build = build.arg("--target-dir").arg(project.target.join(below));
        Ok(match self {
            Self::Compiled(_) => build,
            // Building `core` is unstable; the second variable enables it in a stable compiler.
            Self::Source => build
                .env("RUSTC", DEBIAN_RUSTC)
                .env("RUSTC_BOOTSTRAP", "1")
                .env("CARGO_UNSTABLE_BUILD_STD", "core,compiler_builtins")
                .env("CARGO_UNSTABLE_BUILD_STD_FEATURES", "compiler-builtins-mem")
                .env("PATH", path_with(&debian_linker(project)?)?),
        })
    }

    /// The version of the compiler in use.
    pub(crate) fn compiler(&self, sh: &Shell) -> Result<String> {
        let rustc = match self {
            Self::Compiled(_) => "rustc",
            Self::Source => DEBIAN_RUSTC,
        };
        Ok(cmd!(sh, "{rustc} --version").read()?)
    }
}

/// The PATH, with another directory first.
pub(crate) fn path_with(directory: &Path) -> Result<std::ffi::OsString> {
    let path = env::var_os("PATH").unwrap_or_default();
    let first = std::iter::once(directory.to_owned());
    Ok(env::join_paths(first.chain(env::split_paths(&path)))?)
}

/// Installs Debian's compiler and the source of its libraries, unless both are there in the same version.
pub(crate) fn provide_debian(sh: &Shell) -> Result<()> {
    const PACKAGES: [&str; 2] = ["rustc-web", "rust-web-src"];
    let format = "${Version}\n";
    let query = cmd!(sh, "dpkg-query --show --showformat {format} {PACKAGES...}");
    let versions = query.ignore_stderr().read().unwrap_or_default();
    match versions.split_once('\n') {
        Some((compiler, source)) if compiler == source => Ok(()),
        _ => install::install(sh, &PACKAGES.join(" ")),
    }
}

/// The directory of the compiler's libraries for the target, if it has them.
pub(crate) fn compiled_core(sh: &Shell, target: &str) -> Option<PathBuf> {
    let libraries = cmd!(sh, "rustc --print target-libdir --target {target}");
    let libraries = PathBuf::from(libraries.ignore_stderr().read().ok()?);
    let mut files = sh.read_dir(&libraries).ok()?.into_iter();
    let is_core = |path: PathBuf| path.to_string_lossy().contains("/libcore-");
    files.any(is_core).then_some(libraries)
}

/// A directory that contains Debian's linker as `rust-lld`, which rustup's compiler contains. Debian's package name
/// depends on the LLVM version.
fn debian_linker(project: &Project) -> Result<PathBuf> {
    let sh = &project.sh;
    let version = cmd!(sh, "{DEBIAN_RUSTC} --version --verbose").read()?;
    let llvm = llvm_major(&version).context("Debian's rustc does not report its LLVM version")?;
    let linker = format!("/usr/lib/llvm-{llvm}/bin/lld");
    if !Path::new(&linker).exists() {
        install::install(sh, &format!("lld-{llvm}"))?;
    }
    let directory = sh.create_dir(project.target.join("linker"))?;
    let link = directory.join("rust-lld");
    cmd!(sh, "ln -sfn {linker} {link}").quiet().run()?;
    Ok(directory)
}

/// The number in `LLVM version: 22.1.0`.
fn llvm_major(rustc_version: &str) -> Option<&str> {
    let mut lines = rustc_version.lines();
    let version = lines.find_map(|line| line.strip_prefix("LLVM version: "))?;
    version.split('.').next()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_linker_matches_the_compilers_llvm() {
        let text = "rustc 1.96.0 (built from a source tarball)\nLLVM version: 22.1.8\n";
        assert_eq!(llvm_major(text), Some("22"));
        assert_eq!(llvm_major("rustc 1.96.0"), None);
    }
}
