//! Builds the no_std crates for microcontrollers with only `core` available.
//!
//! The standard library of a bare target also contains `alloc`, so a crate or one of its dependencies could
//! use an allocator unnoticed. Here `alloc` does not exist, and two throw-away crates prove that its use
//! fails.

use std::path::{Path, PathBuf};

use anyhow::{Result, bail};
use xshell::{Cmd, cmd};

use crate::cross::{self, Core, TARGETS};
use crate::project::Project;

/// The crates that have to do without `std` and without an allocator.
pub(crate) const CRATES: [(&str, &[&[&str]]); 3] = [
    ("ztl-core", FEATURES),
    ("ztl-mcu", FEATURES),
    // All of its features need a heap.
    ("ztl-zmtp", FEATURES.split_at(3).0),
];

/// The sets of features such a crate is checked with. One package at a time: in a build of the
/// whole workspace, a feature that another crate turns on would hide what is missing here.
const FEATURES: &[&[&str]] = &[
    &[],
    &["--no-default-features"],
    &["--no-default-features", "--features", "defmt"],
    &["--all-features"],
];

/// The package of the node for firmware in C, which is not in the workspace.
pub(crate) const NODE: &str = "ztl-node-c/Cargo.toml";

pub(crate) fn build(project: &Project) -> Result<()> {
    cross::add(&project.sh, &TARGETS);
    for target in TARGETS {
        let core = Core::provide(&project.sh, target)?;
        let sysroot = match &core {
            Core::Compiled(libraries) => Some(core_alone(project, target, libraries)?),
            Core::Source => None,
        };
        let cargo = || -> Result<Cmd<'_>> {
            let build = core.cargo(project, "build", target, "bare")?;
            let Some(path) = &sysroot else {
                return Ok(build);
            };
            // With `--target`, these flags do not reach build scripts and macros, which need `std`. This
            // variable overrides all other ways to set flags, and allows spaces.
            let flags = format!("--sysroot={}", path.display());
            Ok(build.env("CARGO_ENCODED_RUSTFLAGS", flags))
        };
        for (package, sets) in CRATES {
            for features in sets {
                cargo()?
                    .args(["--package", package])
                    .args(*features)
                    .run()?;
            }
        }
        // Also checks that ZTL_NODE_RAM is what a node needs on this target.
        cargo()?.args(["--manifest-path", NODE]).run()?;
        for library in ["alloc", "std"] {
            prove_lacking(project, cargo()?, library)?;
        }
    }
    Ok(())
}

/// Proves that a crate that needs this library does not build.
fn prove_lacking(project: &Project, cargo: Cmd<'_>, library: &str) -> Result<()> {
    let sh = &project.sh;
    let path = project.target.join(format!("core-only/leak-{library}"));
    let manifest = path.join("Cargo.toml");
    let name = format!("name = \"leak-{library}\"");
    // A separate workspace: it is inside the project's directory, but not part of the project.
    let package = format!("[package]\n{name}\nedition = \"2024\"\n\n[workspace]\n");
    // `--locked` needs it.
    let lock = format!("version = 4\n\n[[package]]\n{name}\nversion = \"0.0.0\"\n");
    let source = format!("#![no_std]\nextern crate {library};\n");
    sh.write_file(&manifest, package)?;
    sh.write_file(path.join("Cargo.lock"), lock)?;
    sh.write_file(path.join("src/lib.rs"), source)?;
    let build = cargo.args(["--color", "never", "--manifest-path"]);
    let reason = format!("can't find crate for `{library}`");
    must_fail(build.arg(manifest), &reason)
}

/// Runs a build that must fail for this reason.
pub(crate) fn must_fail(build: Cmd<'_>, reason: &str) -> Result<()> {
    println!("$ {build}    (must fail)");
    let output = build.ignore_status().output()?;
    let stderr = String::from_utf8_lossy(&output.stderr);
    if output.status.success() {
        bail!("this check is broken: `{reason}` did not stop the build");
    }
    if !stderr.contains(reason) {
        bail!("the build failed for another reason than `{reason}`:\n{stderr}");
    }
    println!("failed as expected: {reason}");
    Ok(())
}

/// Creates a directory like the compiler's own, but with only `core`.
fn core_alone(project: &Project, target: &str, libraries: &Path) -> Result<PathBuf> {
    let sh = &project.sh;
    let sysroot = project.target.join("core-only/sysroot").join(target);
    let alone = sysroot.join("lib/rustlib").join(target).join("lib");
    // Rebuilt each time, because files of an older compiler would not fit.
    sh.remove_path(&sysroot)?;
    sh.create_dir(&alone)?;
    let mut files = sh.read_dir(libraries)?;
    // The compiler links every no_std program with `compiler_builtins`.
    let wanted = ["core", "compiler_builtins", "rustc_std_workspace_core"];
    files.retain(|path| {
        let path = path.to_string_lossy();
        wanted
            .iter()
            .any(|name| path.contains(&format!("/lib{name}-")))
    });
    cmd!(sh, "ln -s -t {alone} {files...}").quiet().run()?;
    Ok(sysroot)
}
