//! `cargo xtask dist`: `ztl` as a static program for each processor of old robots.

mod bill;
mod contents;

use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result, ensure};
use xshell::{Cmd, Shell, cmd};

use crate::project::{PACKAGE, Project, TOGETHER};
use crate::zig::{Target, Zig, targets};
use crate::{capi, install, paths};
pub(crate) use bill::install_validator;
use contents::Contents;

/// Maximum sizes of a program for processors of 32 and 64 bits, in bytes: 5.25 and 8.5 MiB.
const MOST_SMALL: u64 = 21 * 256 * 1024;
const MOST_FULL: u64 = 17 * 512 * 1024;

/// A program that is built statically.
pub(crate) struct Program {
    /// The package, and the program.
    package: &'static str,
    /// Its features for a processor, as options of cargo.
    features: fn(Target) -> &'static [&'static str],
}

pub(crate) const ZTL: Program = Program {
    package: PACKAGE,
    features: |target| match target.is_32_bit() {
        true => &["--no-default-features", "--features", "small"],
        false => &["--no-default-features", "--features", "full"],
    },
};

const FLEET: Program = Program {
    package: "ztl-fleet",
    features: |_| &[],
};

/// The processors of computers that carry Zenoh.
const FLEET_TARGETS: [&str; 2] = ["x86_64", "aarch64"];

/// The emulated kernels, oldest last (`tests/command/dist/old_kernel.py`).
const KERNELS: [&str; 2] = ["3.2", "2.6.32"];

/// Builds the named targets, or all. `check` also runs each one and links the C interface for it.
pub(crate) fn build(project: &Project, names: &[String], check: bool) -> Result<()> {
    let targets = targets(names)?;
    let built = build_ztl(project, &targets)?;
    if check {
        run_all(project, &built)?;
        for target in targets {
            capi::check(project, target)?;
        }
    }
    Ok(())
}

/// Builds `ztl-fleet` for the named targets, or those of larger computers. `check` also runs each one.
pub(crate) fn build_fleet(project: &Project, names: &[String], check: bool) -> Result<()> {
    let sh = &project.sh;
    let targets = match names {
        [] => targets(&FLEET_TARGETS)?,
        names => targets(names)?,
    };
    let built = build_all(project, &targets, &FLEET, "ztl-fleet")?;
    write_sums(sh, release(&built)?)?;
    if check {
        install::emulators(sh)?;
        for (target, path) in &built {
            let emulator: Vec<&str> = target.emulator.split(' ').collect();
            let file = "examples/fleet/room/router.yaml";
            let run = || cmd!(sh, "env").args(&emulator).arg(path);
            run().arg("--version").run()?;
            run().args(["router", "--check", file]).run()?;
        }
    }
    Ok(())
}

/// The targets of the test command. One shows that C programs can be linked.
const TESTED: [&str; 2] = ["x86_64", "i686"];
const LINKED: [&str; 1] = ["i686"];

/// What [`check`] runs.
pub(crate) fn build_tested(project: &Project) -> Result<()> {
    build_ztl(project, &targets(&TESTED)?)?;
    capi::build(project, &LINKED.map(str::to_owned), false, false)
}

/// The part that the test command runs.
pub(crate) fn check(project: &Project) -> Result<()> {
    run_all(project, &build_ztl(project, &targets(&TESTED)?)?)?;
    let mut linked = targets(&LINKED)?.into_iter();
    linked.try_for_each(|target| capi::check(project, target))
}

/// Builds `ztl`, checks its size, and writes the checksums.
fn build_ztl(project: &Project, targets: &[Target]) -> Result<Vec<(Target, PathBuf)>> {
    let sh = &project.sh;
    let built = build_all(project, targets, &ZTL, "ztl")?;
    for (target, path) in &built {
        let size = path.metadata()?.len();
        let path = path.display();
        let most = match target.is_32_bit() {
            true => MOST_SMALL,
            false => MOST_FULL,
        };
        ensure!(size <= most, "{path}: {size} bytes are more than {most}");
    }
    write_sums(sh, release(&built)?)?;
    Ok(built)
}

/// Writes the checksums of all files of a directory.
fn write_sums(sh: &Shell, release: &Path) -> Result<()> {
    let mut files = sh.read_dir(release)?;
    files.retain(|path| !path.ends_with("SHA256SUMS"));
    let names = files.iter().filter_map(|path| path.file_name());
    let sums = cmd!(sh, "env --chdir {release} sha256sum {names...}").read()?;
    Ok(sh.write_file(release.join("SHA256SUMS"), sums + "\n")?)
}

/// The directory of the built programs.
fn release(built: &[(Target, PathBuf)]) -> Result<&Path> {
    let first = built.first().and_then(|(_, path)| path.parent());
    first.context("no program was built")
}

/// Builds the targets one by one, and collects the programs and accompanying files in this directory.
pub(crate) fn build_all(
    project: &Project,
    targets: &[Target],
    program: &Program,
    directory: &str,
) -> Result<Vec<(Target, PathBuf)>> {
    let sh = &project.sh;
    let zig = Zig::provide(project)?;
    let release = sh.create_dir(zig.target_dir.join(directory))?;
    // With `-changed` for uncommitted changes.
    let describe = "describe --always --abbrev=12 --exclude * --dirty=-changed".split(' ');
    let commit = cmd!(sh, "git {describe...}").read();
    let commit = commit.unwrap_or_else(|_| "unknown".to_owned());
    let mut built = Vec::new();
    for &target in targets {
        let contents = Contents::of(project, &zig, program, target)?;
        let package = program.package;
        zig.build(target)?
            .args(["--package", package, "--bin", package])
            .args((program.features)(target))
            .env("ZTL_BUILD_COMMIT", &commit)
            .env("ZTL_BUILD_TARGET", target.triple())
            .env("ZTL_BUILD_WITH", contents.tools())
            .run()?;
        let path = release.join(format!("{package}-{}", target.name));
        sh.copy_file(zig.built(target, package), &path)?;
        check_static(sh, &path)?;
        paths::check(project, &path)?;
        contents.write(sh, &path, &commit)?;
        println!("{:>8} bytes  {}", path.metadata()?.len(), path.display());
        built.push((target, path));
    }
    Ok(built)
}

/// Checks that a program depends only on the kernel.
fn check_static(sh: &Shell, program: &Path) -> Result<()> {
    let headers = cmd!(sh, "readelf --program-headers --wide {program}").read()?;
    let segments = headers.split_whitespace();
    let is_static = !segments
        .into_iter()
        .any(|word| ["INTERP", "DYNAMIC"].contains(&word));
    ensure!(
        headers.contains("LOAD") && is_static,
        "{} is not fully static",
        program.display()
    );
    Ok(())
}

/// Runs each program on its processor in an empty root, with real tasks.
fn run_all(project: &Project, built: &[(Target, PathBuf)]) -> Result<()> {
    let sh = &project.sh;
    install::emulators(sh)?;
    install::python(project)?;
    install::naoqi(project)?;
    project.build_programs()?;
    let release = release(built)?;
    let check = "--check --strict --quiet SHA256SUMS".split(' ');
    cmd!(sh, "env --chdir {release} sha256sum {check...}").run()?;
    bill::check(project, release)?;
    for (target, path) in built {
        let run = |variable: &str, how: &str| {
            let test = test(project, "command").args(["--", "--ignored", "dist::"]);
            let test = test.env("ZTL_DIST", path).env(variable, how);
            test.env("ZTL_DIST_TARGET", target.triple()).run()
        };
        run("ZTL_DIST_EMULATOR", target.emulator)?;
        // Only the same machine type has a kernel that can be made to look old.
        if cfg!(target_arch = "x86_64") && target.emulator.contains("86") {
            for kernel in KERNELS {
                run("ZTL_DIST_KERNEL", kernel)?;
                watchdogs(project, kernel, path)?;
            }
        }
        if target.is_here() {
            let test = test(project, "serve").args(["--", "--nocapture", "memory::"]);
            test.env("ZTL_RELEASED", path).run()?;
        }
    }
    Ok(())
}

/// Kills servers on an emulated kernel. An empty root cannot show this: without `/proc` no watchdog stops the
/// programs of a killed server.
fn watchdogs(project: &Project, kernel: &str, program: &Path) -> Result<()> {
    let script = project.root.join("tests/command/dist/old_kernel.py");
    let python = install::python(project)?;
    let words = [&python, &script, Path::new(kernel), program];
    let command = words.map(|word| word.display().to_string()).join("\n");
    let test = test(project, "serve").args(["--", "killed::"]);
    Ok(test.env("ZTL_COMMAND", command).run()?)
}

/// A test binary.
fn test<'a>(project: &'a Project, name: &str) -> Cmd<'a> {
    project.cargo(&format!("test --quiet {TOGETHER} --test {name}"))
}
