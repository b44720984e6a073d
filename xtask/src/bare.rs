//! Builds the no_std crates for a microcontroller with nothing but `core` at hand.
//!
//! The usual library of a bare target also has `alloc` in it, so that a crate, or something it
//! depends on, could use an allocator unnoticed. Here `alloc` does not exist, and two throw-away
//! crates show that the lack is noticed.

use std::ffi::OsString;
use std::fs;
use std::io::ErrorKind;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};

use crate::cmd::{Cmd, Outcome};
use crate::test::{BARE_CRATES, FEATURES};
use crate::{Dirs, tools};

/// A Cortex-M0: the smallest target, without atomic read-modify-write.
const TARGET: &str = "thumbv6m-none-eabi";

/// Debian's compiler and, for where rustup has no such target to give, the source of `core`.
const DEBIAN_RUSTC: &str = "/usr/bin/rustc";
const DEBIAN_PACKAGES: &[&str] = &["rustc-web", "rust-web-src"];

/// Where `core` comes from.
enum Core {
    /// Compiled, alone in this directory.
    Sysroot(PathBuf),
    /// Compiled by Cargo from the source that Debian ships.
    Source,
}

pub(crate) fn build(dirs: &Dirs) -> Outcome {
    let core = provide_core(dirs)?;
    for package in BARE_CRATES {
        for features in FEATURES {
            core.cargo_build(dirs)
                .arg("--locked")
                .arg("--package")
                .arg(package)
                .args(features)
                .run()?;
        }
    }
    for library in ["alloc", "std"] {
        prove_lacking(dirs, &core, library)?;
    }
    Ok(())
}

impl Core {
    fn cargo_build(&self, dirs: &Dirs) -> Cmd {
        let build = Cmd::new("cargo build --target")
            .arg(TARGET)
            .arg("--target-dir")
            .arg(dirs.target.join("bare"));
        match self {
            // With `--target`, these flags do not reach build scripts and macros, which need
            // `std`. This variable wins over every other way to set flags, and takes blanks.
            Self::Sysroot(path) => {
                let mut flag = OsString::from("--sysroot=");
                flag.push(path);
                build.env("CARGO_ENCODED_RUSTFLAGS", flag)
            }
            // Building `core` is not stable yet; the first variable lets a stable compiler do it.
            Self::Source => build
                .env("RUSTC", DEBIAN_RUSTC)
                .env("RUSTC_BOOTSTRAP", "1")
                .env("CARGO_UNSTABLE_BUILD_STD", "core,compiler_builtins")
                .env("CARGO_UNSTABLE_BUILD_STD_FEATURES", "compiler-builtins-mem"),
        }
    }
}

fn provide_core(dirs: &Dirs) -> Outcome<Core> {
    if compiled_core().is_none() && tools::has("rustup") {
        let add = Cmd::new("rustup target add").arg(TARGET);
        if let Err(error) = add.run() {
            println!("{error}; trying Debian's packages instead");
        }
    }
    if let Some(libraries) = compiled_core() {
        return core_alone(dirs, &libraries)
            .map(Core::Sysroot)
            .map_err(|error| {
                format!(
                    "cannot set `core` apart in {}: {error}",
                    dirs.target.display()
                )
            });
    }
    if !debian_source_fits() {
        tools::install(DEBIAN_PACKAGES).map_err(|error| {
            format!("there is no `core` for {TARGET}, and rustup does not provide it; {error}")
        })?;
    }
    Ok(Core::Source)
}

/// The directory with the compiler's libraries for the target, if it has them.
fn compiled_core() -> Option<PathBuf> {
    let libraries = Cmd::new("rustc --print target-libdir --target")
        .arg(TARGET)
        .stdout()
        .ok()?;
    let mut entries = fs::read_dir(&libraries).ok()?.flatten();
    entries
        .any(|entry| entry.file_name().to_string_lossy().starts_with("libcore-"))
        .then(|| PathBuf::from(libraries))
}

/// Whether Debian's compiler and source are there and of the same version.
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

/// Makes a directory like the compiler's own, but with only `core` in it.
fn core_alone(dirs: &Dirs, libraries: &Path) -> std::io::Result<PathBuf> {
    let sysroot = dirs.absolute("core-only/sysroot");
    let alone = sysroot.join("lib/rustlib").join(TARGET).join("lib");
    // Anew each time: what an older compiler left would not fit.
    make_anew(&sysroot)?;
    fs::create_dir_all(&alone)?;
    for entry in fs::read_dir(libraries)? {
        let entry = entry?;
        let name = entry.file_name();
        // The compiler links every no_std program with `compiler_builtins`, asked for or not.
        let wanted = [
            "libcore-",
            "libcompiler_builtins-",
            "librustc_std_workspace_core-",
        ];
        if wanted
            .iter()
            .any(|prefix| name.to_string_lossy().starts_with(prefix))
        {
            symlink(entry.path(), alone.join(name))?;
        }
    }
    Ok(sysroot)
}

/// Shows that a crate that needs the library does not build.
fn prove_lacking(dirs: &Dirs, core: &Core, library: &str) -> Outcome {
    let name = format!("leak-{library}");
    let path = dirs.target.join("core-only").join(&name);
    make_leak(&path, &name, library)
        .map_err(|error| format!("cannot write {}: {error}", path.display()))?;

    let build = core
        .cargo_build(dirs)
        .args("--color never --manifest-path")
        .arg(path.join("Cargo.toml"));
    println!("$ {build}    (has to fail)");
    let (success, _, stderr) = build.capture()?;
    let reason = format!("can't find crate for `{library}`");
    if success {
        Err(format!(
            "a crate that needs `{library}` builds here, so this step would not notice one; \
             mend the way it hides `{library}` (xtask/src/bare.rs)"
        ))
    } else if !stderr.contains(&reason) {
        Err(format!(
            "the crate that needs `{library}` was refused for another reason than \
             \"{reason}\":\n{stderr}"
        ))
    } else {
        println!("refused, as it has to be: {reason}");
        Ok(())
    }
}

fn make_leak(path: &Path, name: &str, library: &str) -> std::io::Result<()> {
    make_anew(path)?;
    fs::create_dir_all(path.join("src"))?;
    // A workspace of its own: it lies within the project's directory, but is no part of it.
    fs::write(
        path.join("Cargo.toml"),
        format!("[package]\nname = \"{name}\"\nedition = \"2024\"\n\n[workspace]\n"),
    )?;
    fs::write(
        path.join("src/lib.rs"),
        format!("#![no_std]\nextern crate {library};\n"),
    )
}

fn make_anew(path: &Path) -> std::io::Result<()> {
    match fs::remove_dir_all(path) {
        Err(error) if error.kind() != ErrorKind::NotFound => return Err(error),
        _ => {}
    }
    fs::create_dir_all(path)
}
