//! `cargo xtask dist`: `ztl` as a static program for each processor of old robots.

mod bill;
mod contents;

use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result, ensure};
use object::elf::{FileHeader32, FileHeader64, PT_DYNAMIC, PT_INTERP};
use object::read::elf::{FileHeader, ProgramHeader};
use object::{Endianness, FileKind};
use xshell::cmd;

use crate::project::{COMMAND, Project};
use crate::zig::{Target, Zig, targets};
use crate::{capi, install, paths};
use contents::Contents;

/// Maximum size of a program in bytes.
const MOST: usize = 6 * 1024 * 1024;

/// The emulated kernels, oldest last (`tests/command/dist/old_kernel.py`).
const KERNELS: [&str; 2] = ["3.2", "2.6.32"];

/// Builds the named targets, or all. `check` also runs each one and links the C interface for it.
pub(crate) fn build(project: &Project, names: &[String], check: bool) -> Result<()> {
    let targets = targets(names)?;
    let built = build_all(project, &targets)?;
    if check {
        run_all(project, &built)?;
        for target in targets {
            capi::check(project, target)?;
        }
    }
    Ok(())
}

/// The part that the test command runs. One target shows that C programs can be linked.
pub(crate) fn test(project: &Project) -> Result<()> {
    let targets = targets(&["x86_64", "i686"])?;
    run_all(project, &build_all(project, &targets)?)?;
    let i686 = targets.last().context("a target")?;
    capi::check(project, *i686)
}

/// Builds the targets one by one, and collects the programs and accompanying files in one directory.
fn build_all(project: &Project, targets: &[Target]) -> Result<Vec<(Target, PathBuf)>> {
    let sh = &project.sh;
    let zig = Zig::provide(project)?;
    let release = sh.create_dir(zig.target_dir.join("ztl"))?;
    // With `-changed` for uncommitted changes.
    let commit = cmd!(
        sh,
        "git describe --always --abbrev=12 --exclude * --dirty=-changed"
    )
    .read();
    let commit = commit.unwrap_or_else(|_| "unknown".to_owned());
    let mut built = Vec::new();
    for &target in targets {
        let libraries = zig.libraries(target)?;
        let contents = Contents::of(project, &zig, target, &libraries)?;
        zig.build_with(target, &libraries)?
            .args(COMMAND)
            .env("ZTL_BUILD_COMMIT", &commit)
            .env("ZTL_BUILD_TARGET", target.triple())
            .env("ZTL_BUILD_WITH", contents.tools())
            .run()?;
        let path = release.join(format!("ztl-{}", target.name));
        sh.copy_file(zig.built(target, "ztl"), &path)?;
        let bytes = sh.read_binary_file(&path)?;
        is_fit(&bytes).with_context(|| path.display().to_string())?;
        paths::check(project, &path)?;
        contents.write(sh, &path, &commit)?;
        println!("{:>8} bytes  {}", bytes.len(), path.display());
        built.push((target, path));
    }
    let mut files = sh.read_dir(&release)?;
    files.retain(|path| !path.ends_with("SHA256SUMS"));
    let names = files.iter().filter_map(|path| path.file_name());
    let sums = cmd!(sh, "env --chdir {release} sha256sum {names...}").read()?;
    sh.write_file(release.join("SHA256SUMS"), sums + "\n")?;
    Ok(built)
}

/// Checks that a program depends only on the kernel, and respects the size limit.
fn is_fit(program: &[u8]) -> Result<()> {
    let size = program.len();
    ensure!(size <= MOST, "{size} bytes are more than {MOST}");
    let needs_loader = match FileKind::parse(program)? {
        FileKind::Elf32 => needs_loader::<FileHeader32<Endianness>>(program)?,
        _ => needs_loader::<FileHeader64<Endianness>>(program)?,
    };
    ensure!(!needs_loader, "not fully static");
    Ok(())
}

fn needs_loader<H: FileHeader<Endian = Endianness>>(bytes: &[u8]) -> object::Result<bool> {
    let file = H::parse(bytes)?;
    let endian = file.endian()?;
    let mut parts = file.program_headers(endian, bytes)?.iter();
    Ok(parts.any(|part| matches!(part.p_type(endian), PT_INTERP | PT_DYNAMIC)))
}

/// Runs each program on its processor in an empty root, with real tasks.
fn run_all(project: &Project, built: &[(Target, PathBuf)]) -> Result<()> {
    let sh = &project.sh;
    install::emulators(sh)?;
    install::python(project)?;
    cmd!(sh, "cargo build --locked {COMMAND...}").run()?;
    let release = built.first().and_then(|(_, path)| path.parent());
    let release = release.context("no program was built")?;
    cmd!(
        sh,
        "env --chdir {release} sha256sum --check --strict --quiet SHA256SUMS"
    )
    .run()?;
    bill::check(project, release)?;
    let test = [
        "test",
        "--quiet",
        "--locked",
        "--package",
        "ztl-tests",
        "--test",
    ];
    for (target, path) in built {
        let triple = target.triple();
        let run = |variable: &str, how: &str| {
            cmd!(sh, "env ZTL_DIST={path} ZTL_DIST_TARGET={triple} {variable}={how} cargo {test...} command -- --ignored dist::").run()
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
            cmd!(
                sh,
                "env ZTL_RELEASED={path} cargo {test...} serve -- --nocapture memory::"
            )
            .run()?;
        }
    }
    Ok(())
}

/// Kills servers on an emulated kernel. An empty root cannot show this: without `/proc` no watchdog stops the
/// programs of a killed server.
fn watchdogs(project: &Project, kernel: &str, program: &Path) -> Result<()> {
    let sh = &project.sh;
    let script = project.root.join("tests/command/dist/old_kernel.py");
    let python = install::python(project)?;
    let words = [&python, &script, Path::new(kernel), program];
    let command = words.map(|word| word.display().to_string()).join("\n");
    let test = cmd!(
        sh,
        "cargo test --quiet --locked --package ztl-tests --test serve -- killed::"
    );
    Ok(test.env("ZTL_COMMAND", command).run()?)
}
