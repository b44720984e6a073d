//! Builds the no_std crates for microcontrollers with only `core` available.
//!
//! The standard library of a bare target also contains `alloc`, so a crate or one of its dependencies could
//! use an allocator unnoticed. Here `alloc` does not exist, and two throw-away crates prove that its use
//! fails.

use std::ffi::OsString;
use std::fs;
use std::io::ErrorKind;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};

use crate::cmd::{Cmd, Outcome};
use crate::cross::{self, Core, TARGETS};
use crate::test::{BARE_CRATES, FEATURES};
use crate::{Dirs, capi};

pub(crate) fn build(dirs: &Dirs) -> Outcome {
    cross::add_all();
    for target in TARGETS {
        let bare = Bare::new(dirs, target)?;
        for package in BARE_CRATES {
            for features in FEATURES {
                bare.cargo_build(dirs)
                    .arg("--locked")
                    .arg("--package")
                    .arg(package)
                    .args(features)
                    .run()?;
            }
        }
        // Also checks that ZTL_NODE_RAM is what a node needs on this target.
        bare.cargo_build(dirs)
            .args("--locked --manifest-path")
            .arg(capi::NODE)
            .run()?;
        for library in ["alloc", "std"] {
            bare.prove_lacking(dirs, library)?;
        }
    }
    Ok(())
}

/// A target with `core` and nothing else.
struct Bare {
    target: &'static str,
    core: Core,
    /// The directory of the compiled `core`, unless Cargo compiles it.
    sysroot: Option<PathBuf>,
}

impl Bare {
    fn new(dirs: &Dirs, target: &'static str) -> Outcome<Self> {
        let core = Core::provide(target)?;
        let sysroot = match &core {
            Core::Compiled(libraries) => {
                Some(core_alone(dirs, target, libraries).map_err(|error| {
                    format!(
                        "cannot set up a library with only `core` in {}: {error}",
                        dirs.target.display()
                    )
                })?)
            }
            Core::Source => None,
        };
        Ok(Self {
            target,
            core,
            sysroot,
        })
    }

    fn cargo_build(&self, dirs: &Dirs) -> Cmd {
        let build = self
            .core
            .cargo("build", self.target, &dirs.target.join("bare"));
        match &self.sysroot {
            // With `--target`, these flags do not reach build scripts and macros, which need `std`. This
            // variable overrides all other ways to set flags, and allows spaces.
            Some(path) => {
                let mut flag = OsString::from("--sysroot=");
                flag.push(path);
                build.env("CARGO_ENCODED_RUSTFLAGS", flag)
            }
            None => build,
        }
    }

    /// Proves that a crate that needs this library does not build.
    fn prove_lacking(&self, dirs: &Dirs, library: &str) -> Outcome {
        let name = format!("leak-{library}");
        let path = dirs.target.join("core-only").join(&name);
        make_leak(&path, &name, library)
            .map_err(|error| format!("cannot write {}: {error}", path.display()))?;

        let build = self
            .cargo_build(dirs)
            .args("--color never --manifest-path")
            .arg(path.join("Cargo.toml"));
        println!("$ {build}    (must fail)");
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
            println!("failed as expected: {reason}");
            Ok(())
        }
    }
}

/// Creates a directory like the compiler's own, but with only `core`.
fn core_alone(dirs: &Dirs, target: &str, libraries: &Path) -> std::io::Result<PathBuf> {
    let sysroot = dirs.absolute("core-only/sysroot").join(target);
    let alone = sysroot.join("lib/rustlib").join(target).join("lib");
    // Rebuilt each time, because files of an older compiler would not fit.
    recreate(&sysroot)?;
    fs::create_dir_all(&alone)?;
    for entry in fs::read_dir(libraries)? {
        let entry = entry?;
        let name = entry.file_name();
        // The compiler links every no_std program with `compiler_builtins`.
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

fn make_leak(path: &Path, name: &str, library: &str) -> std::io::Result<()> {
    recreate(path)?;
    fs::create_dir_all(path.join("src"))?;
    // A separate workspace: it lies inside the project's directory, but is not part of it.
    fs::write(
        path.join("Cargo.toml"),
        format!("[package]\nname = \"{name}\"\nedition = \"2024\"\n\n[workspace]\n"),
    )?;
    fs::write(
        path.join("src/lib.rs"),
        format!("#![no_std]\nextern crate {library};\n"),
    )
}

fn recreate(path: &Path) -> std::io::Result<()> {
    match fs::remove_dir_all(path) {
        Err(error) if error.kind() != ErrorKind::NotFound => return Err(error),
        _ => {}
    }
    fs::create_dir_all(path)
}
