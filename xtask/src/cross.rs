//! Requirements of a build for a bare target: its `core`, and a linker.

use std::env;
use std::fs;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};

use crate::cmd::{Cmd, Outcome};
use crate::{Dirs, tools};

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
const DEBIAN_PACKAGES: &[&str] = &["rustc-web", "rust-web-src"];

/// Where `core` comes from.
pub(crate) enum Core {
    /// Compiled, in this directory of the compiler's libraries.
    Compiled(PathBuf),
    /// Compiled by Cargo from the source that Debian ships.
    Source,
}

/// Asks rustup for all missing targets at once.
pub(crate) fn add_all() {
    let lacking: Vec<&str> = TARGETS
        .into_iter()
        .filter(|target| compiled_core(target).is_none())
        .collect();
    add(&lacking);
}

/// Asks rustup for these targets; those it does not provide stay missing.
pub(crate) fn add(targets: &[&str]) {
    if targets.is_empty() || !tools::has("rustup") {
        return;
    }
    let add = Cmd::new("rustup target add").args(&targets.join(" "));
    if let Err(error) = add.run() {
        println!("{error}; continuing without");
    }
}

impl Core {
    /// Finds `core` for this target, and installs it if necessary.
    pub(crate) fn provide(target: &str) -> Outcome<Self> {
        if let Some(libraries) = compiled_core(target) {
            return Ok(Self::Compiled(libraries));
        }
        add(&[target]);
        if let Some(libraries) = compiled_core(target) {
            return Ok(Self::Compiled(libraries));
        }
        provide_debian().map_err(|error| {
            format!("no `core` for {target}, and rustup does not provide it: {error}")
        })?;
        Ok(Self::Source)
    }

    /// `cargo build`, or another command, for the target.
    pub(crate) fn cargo(&self, command: &str, target: &str, target_dir: &Path) -> Cmd {
        let build = Cmd::new("cargo")
            .arg(command)
            .arg("--target")
            .arg(target)
            .arg("--target-dir")
            .arg(target_dir);
        match self {
            Self::Compiled(_) => build,
            // Building `core` is unstable; the second variable enables it in a stable compiler.
            Self::Source => build
                .env("RUSTC", DEBIAN_RUSTC)
                .env("RUSTC_BOOTSTRAP", "1")
                .env("CARGO_UNSTABLE_BUILD_STD", "core,compiler_builtins")
                .env("CARGO_UNSTABLE_BUILD_STD_FEATURES", "compiler-builtins-mem"),
        }
    }

    /// Adds `rust-lld` to the command's PATH. rustup's compiler contains it.
    pub(crate) fn with_linker(&self, dirs: &Dirs, build: Cmd) -> Outcome<Cmd> {
        match self {
            Self::Compiled(_) => Ok(build),
            Self::Source => {
                let mut path = vec![provide_linker(dirs)?];
                path.extend(env::split_paths(&env::var_os("PATH").unwrap_or_default()));
                let path = env::join_paths(path)
                    .map_err(|error| format!("cannot put the linker on the PATH: {error}"))?;
                Ok(build.env("PATH", path))
            }
        }
    }

    /// The version of the compiler in use.
    pub(crate) fn compiler(&self) -> Outcome<String> {
        let rustc = match self {
            Self::Compiled(_) => Cmd::new("rustc"),
            Self::Source => Cmd::new(DEBIAN_RUSTC),
        };
        rustc.arg("--version").stdout()
    }
}

/// Installs Debian's compiler and the source of its libraries if missing.
pub(crate) fn provide_debian() -> Outcome {
    if debian_source_fits() {
        return Ok(());
    }
    tools::install(DEBIAN_PACKAGES)
}

/// The directory of the compiler's libraries for the target, if it has them.
pub(crate) fn compiled_core(target: &str) -> Option<PathBuf> {
    let libraries = Cmd::new("rustc --print target-libdir --target")
        .arg(target)
        .stdout()
        .ok()?;
    let mut entries = fs::read_dir(&libraries).ok()?.flatten();
    entries
        .any(|entry| entry.file_name().to_string_lossy().starts_with("libcore-"))
        .then(|| PathBuf::from(libraries))
}

/// Whether Debian's compiler and source are installed in the same version.
fn debian_source_fits() -> bool {
    let version = |package: &&str| {
        Cmd::new("dpkg-query --show --showformat ${Version}")
            .arg(package)
            .stdout()
            .ok()
    };
    let versions: Vec<_> = DEBIAN_PACKAGES.iter().map(version).collect();
    matches!(versions.as_slice(), [Some(compiler), Some(source)] if compiler == source)
}

/// A directory that contains Debian's linker under the name the compiler expects. Debian's package name
/// depends on the LLVM version.
fn provide_linker(dirs: &Dirs) -> Outcome<PathBuf> {
    let version = Cmd::new(DEBIAN_RUSTC)
        .args("--version --verbose")
        .stdout()?;
    let llvm = llvm_major(&version)
        .ok_or_else(|| format!("{DEBIAN_RUSTC} does not report its LLVM version"))?;
    let linker = PathBuf::from(format!("/usr/lib/llvm-{llvm}/bin/lld"));
    if !linker.exists() {
        tools::install(&[&format!("lld-{llvm}")])?;
    }
    let directory = dirs.absolute("linker");
    let name = directory.join("rust-lld");
    let link = || {
        fs::create_dir_all(&directory)?;
        if fs::read_link(&name).is_ok_and(|to| to == linker) {
            return Ok(());
        }
        // Removes a link to another version, if there is one.
        let _ = fs::remove_file(&name);
        symlink(&linker, &name)
    };
    link().map_err(|error| format!("cannot write {}: {error}", name.display()))?;
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
