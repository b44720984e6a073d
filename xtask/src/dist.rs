//! `cargo xtask dist`: `ztl` as a static program for each processor of old robots.

mod bill;
mod contents;

use std::fs;
use std::path::{Path, PathBuf};

use object::Endianness;
use object::elf::{FileHeader32, FileHeader64, PT_DYNAMIC, PT_INTERP};
use object::read::elf::{FileHeader, ProgramHeader};

use crate::cmd::{Cmd, Outcome};
use crate::zig::{Target, Zig, targets};
use crate::{Dirs, capi, places, python, tools};
use contents::Contents;

/// Maximum size of a program in bytes.
const MOST: u64 = 6 * 1024 * 1024;

/// Built and run by the test command.
const TESTED: [&str; 2] = ["x86_64", "i686"];

/// C programs are linked for this target as well.
const LINKED: [&str; 1] = ["i686"];

/// Builds the named targets, or all. `--check` also runs each one and links the C interface for it.
pub(crate) fn run(dirs: &Dirs, args: &[String]) -> Outcome {
    let mut check = false;
    let mut names = Vec::new();
    for word in args {
        match word.as_str() {
            "--check" => check = true,
            option if option.starts_with('-') => {
                return Err(format!(
                    "unknown option `{option}`: expected targets or `--check`"
                ));
            }
            name => names.push(name),
        }
    }
    let targets = targets(&names)?;
    let made = build(dirs, &targets)?;
    if check {
        try_out(dirs, &made)?;
        for target in targets {
            capi::check(dirs, target)?;
        }
    }
    Ok(())
}

/// The part that the test command runs.
pub(crate) fn test(dirs: &Dirs) -> Outcome {
    let made = build(dirs, &targets(&TESTED)?)?;
    try_out(dirs, &made)?;
    // One target shows that C programs can be linked; `dist --check` tries all.
    for target in targets(&LINKED)? {
        capi::check(dirs, target)?;
    }
    Ok(())
}

/// The emulated kernels, oldest last (`tests/dist/old_kernel.py`).
const KERNELS: [&str; 2] = ["3.2", "2.6.32"];

/// A built program.
struct Made {
    target: Target,
    path: PathBuf,
}

/// Builds the targets one by one, and collects the programs and accompanying files in one directory.
fn build(dirs: &Dirs, targets: &[Target]) -> Outcome<Vec<Made>> {
    let zig = Zig::provide(dirs)?;
    let release = zig.target_dir.join("ztl");
    fs::create_dir_all(&release)
        .map_err(|error| format!("cannot make {}: {error}", release.display()))?;
    let commit = commit();
    let mut made = Vec::new();
    for &target in targets {
        let libraries = zig.libraries(target)?;
        let contents = Contents::of(&zig, target, &libraries)?;
        zig.build_with(target, &libraries)?
            .args("--package ztl-std --bin ztl")
            .env("ZTL_BUILD_COMMIT", &commit)
            .env("ZTL_BUILD_TARGET", target.triple)
            .env("ZTL_BUILD_WITH", contents.tools())
            .run()?;
        let path = release.join(format!("ztl-{}", target.name));
        let program = zig.program(target, "ztl");
        copy(&program, &path)?;
        is_fit(&path)?;
        places::check(dirs, &path)?;
        contents.write(&path, &commit)?;
        made.push(Made { target, path });
    }
    checksums(&release)?;
    println!("{}:", release.display());
    for Made { path, .. } in &made {
        println!("  {:>8} bytes  {}", size(path)?, path.display());
    }
    Ok(made)
}

/// The commit of the sources, with `-changed` for uncommitted changes.
fn commit() -> String {
    let Ok(commit) = Cmd::new("git rev-parse --short=12 HEAD").stdout() else {
        return "unknown".to_owned();
    };
    match Cmd::new("git status --porcelain").stdout() {
        Ok(changes) if changes.is_empty() => commit,
        _ => format!("{commit}-changed"),
    }
}

fn copy(from: &Path, to: &Path) -> Outcome {
    fs::copy(from, to).map(drop).map_err(|error| {
        format!(
            "cannot copy {} to {}: {error}",
            from.display(),
            to.display()
        )
    })
}

fn size(path: &Path) -> Outcome<u64> {
    let about = fs::metadata(path);
    about
        .map(|about| about.len())
        .map_err(|error| format!("cannot read {}: {error}", path.display()))
}

/// Checks that a program depends only on the kernel, and respects the size limit.
fn is_fit(path: &Path) -> Outcome {
    let bytes =
        fs::read(path).map_err(|error| format!("cannot read {}: {error}", path.display()))?;
    if bytes.len() as u64 > MOST {
        return Err(format!(
            "{} has {} bytes; the limit is {MOST}",
            path.display(),
            bytes.len()
        ));
    }
    let needs_loader = match bytes.get(4) {
        Some(1) => needs_loader::<FileHeader32<Endianness>>(&bytes),
        _ => needs_loader::<FileHeader64<Endianness>>(&bytes),
    };
    match needs_loader {
        Ok(false) => Ok(()),
        Ok(true) => Err(format!("{} is not fully static", path.display())),
        Err(error) => Err(format!("{}: {error}", path.display())),
    }
}

fn needs_loader<H: FileHeader<Endian = Endianness>>(bytes: &[u8]) -> object::Result<bool> {
    let file = H::parse(bytes)?;
    let endian = file.endian()?;
    let mut parts = file.program_headers(endian, bytes)?.iter();
    Ok(parts.any(|part| matches!(part.p_type(endian), PT_INTERP | PT_DYNAMIC)))
}

/// Writes `SHA256SUMS` for all files in the directory.
fn checksums(release: &Path) -> Outcome {
    const NAME: &str = "SHA256SUMS";
    let entries = fs::read_dir(release)
        .map_err(|error| format!("cannot read {}: {error}", release.display()))?;
    let mut names: Vec<String> = entries
        .flatten()
        .map(|entry| entry.file_name().to_string_lossy().into_owned())
        .filter(|name| name != NAME)
        .collect();
    names.sort();
    let mut sum = Cmd::new("env --chdir").arg(release).arg("sha256sum");
    for name in &names {
        sum = sum.arg(name);
    }
    let path = release.join(NAME);
    fs::write(&path, sum.stdout()? + "\n")
        .map_err(|error| format!("cannot write {}: {error}", path.display()))
}

/// Runs each program on its processor in an empty root, with real tasks.
fn try_out(dirs: &Dirs, made: &[Made]) -> Outcome {
    tools::provide_emulators()?;
    Cmd::new("cargo build --locked --package ztl-std --bin ztl").run()?;
    let python = python::ensure(dirs)?;
    if let Some(Made { path, .. }) = made.first() {
        let release = path.parent().ok_or("a program lies in a directory")?;
        Cmd::new("env --chdir")
            .arg(release)
            .args("sha256sum --check --strict --quiet SHA256SUMS")
            .run()?;
        bill::check(dirs, release)?;
    }
    for Made { target, path } in made {
        let test = |how: &str, variable: &'static str| {
            println!("{}, {variable}={how}:", target.name);
            Cmd::new("cargo test --quiet --locked --package ztl-tests --test dist -- --ignored")
                .env("ZTL_DIST", path)
                .env("ZTL_DIST_TARGET", target.triple)
                .env(variable, how)
                .env("ZTL_PYTHON", &python)
                .run()
        };
        test(target.emulator, "ZTL_DIST_EMULATOR")?;
        // Only the same machine type has a kernel that can be made to look old.
        if cfg!(target_arch = "x86_64") && ["x86_64", "i686", "i586"].contains(&target.name) {
            for kernel in KERNELS {
                test(kernel, "ZTL_DIST_KERNEL")?;
                watchdogs(dirs, &python, kernel, path)?;
            }
        }
        if cfg!(target_arch = "x86_64") && target.name == "x86_64" {
            println!("{}, memory:", target.name);
            Cmd::new("cargo test --quiet --locked --package ztl-tests --test serve -- --nocapture memory::")
                .env("ZTL_RELEASED", path)
                .run()?;
        }
    }
    Ok(())
}

/// Kills servers on an emulated kernel. An empty root cannot show this: without `/proc` no watchdog stops the
/// programs of a killed server.
fn watchdogs(dirs: &Dirs, python: &Path, kernel: &str, program: &Path) -> Outcome {
    let script = dirs.root.join("tests/dist/old_kernel.py");
    let program = dirs.root.join(program);
    let words = [python, &script, Path::new(kernel), &program];
    let lines = words.map(|word| word.display().to_string()).join("\n");
    println!(
        "{} on {kernel}, servers that are killed:",
        program.display()
    );
    Cmd::new("cargo test --quiet --locked --package ztl-tests --test serve -- killed::")
        .env("ZTL_COMMAND", lines)
        .run()
}
