//! `cargo xtask dist`: `ztl` as one static file for each processor that old robots have.

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

/// The largest that a program may be, in bytes.
const MOST: u64 = 6 * 1024 * 1024;

/// What the test command builds and runs.
const TESTED: [&str; 2] = ["x86_64", "i686"];

/// For what it also links programs in C.
const LINKED: [&str; 1] = ["i686"];

/// Builds the targets that are named, or all; with `--check` each is also run, and the C interface linked for it.
pub(crate) fn run(dirs: &Dirs, args: &[String]) -> Outcome {
    let mut check = false;
    let mut names = Vec::new();
    for word in args {
        match word.as_str() {
            "--check" => check = true,
            option if option.starts_with('-') => {
                return Err(format!(
                    "`cargo xtask dist` does not know `{option}`; it takes names of targets, and `--check`"
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

/// What the test command does.
pub(crate) fn test(dirs: &Dirs) -> Outcome {
    let made = build(dirs, &targets(&TESTED)?)?;
    try_out(dirs, &made)?;
    // One of them is enough to see that programs in C can be linked so; `dist --check` does all.
    for target in targets(&LINKED)? {
        capi::check(dirs, target)?;
    }
    Ok(())
}

/// The kernels that are played, oldest last (`tests/dist/old_kernel.py`).
const KERNELS: [&str; 2] = ["3.2", "2.6.32"];

/// A program that was built.
struct Made {
    target: Target,
    path: PathBuf,
}

/// Builds them, one after the other, and puts them with all that belongs to them into one directory.
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

/// The commit of the sources, with `-changed` if they are not quite that.
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

/// Whether a program needs nothing of the system but its kernel, and is as small as was promised.
fn is_fit(path: &Path) -> Outcome {
    let bytes =
        fs::read(path).map_err(|error| format!("cannot read {}: {error}", path.display()))?;
    if bytes.len() as u64 > MOST {
        return Err(format!(
            "{} has {} bytes, and may have {MOST}",
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

/// `SHA256SUMS` of all files there.
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

/// Runs each on its processor, in an empty root, doing the real thing.
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
        // Only a machine of that kind has a kernel for it, which can be made to look old.
        if cfg!(target_arch = "x86_64") && ["x86_64", "i686", "i586"].contains(&target.name) {
            for kernel in KERNELS {
                test(kernel, "ZTL_DIST_KERNEL")?;
                guards(dirs, &python, kernel, path)?;
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

/// Kills servers as on a kernel, which an empty root cannot show: without `/proc` there is no guard, which stops
/// the programs of a server that was killed.
fn guards(dirs: &Dirs, python: &Path, kernel: &str, program: &Path) -> Outcome {
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
