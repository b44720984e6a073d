//! `cargo xtask c`: builds the C libraries and their headers.
//!
//! The static library that cargo builds from `ztl-c` exports the names of libzmq, libsodium, C++ and Rust,
//! which would clash with those of a robot's program. So everything is linked into one object that exports
//! only the functions of `ztl.h`. The static and the shared library are made from it.

mod cross;
mod glibc;
mod join;
mod node;

use std::fs;
use std::os::unix::fs::symlink;
use std::path::Path;

use crate::cmd::{Cmd, Outcome};
use crate::zig::{self, Target, Zig};
use crate::{Dirs, curve, python};
use join::Tools;
pub(crate) use node::MANIFEST as NODE;

const HEADER: &str = "ztl-c/include/ztl.h";

/// Version of the shared library's interface, as `ZTL_ABI`.
const ABI: &str = "1";

/// Libraries that a program must link as well.
const SYSTEM: &str = "-lpthread -ldl -lm -lrt";

/// Builds the libraries for this machine, for a microcontroller, or for old Linux machines.
pub(crate) fn run(dirs: &Dirs, args: &[String]) -> Outcome {
    let (mut check, mut glibc) = (false, false);
    let mut names = Vec::new();
    for word in args {
        match word.as_str() {
            "--check" => check = true,
            "--glibc" => glibc = true,
            option if option.starts_with('-') => {
                return Err(format!(
                    "unknown option `{option}`: expected targets, `--check` or `--glibc`"
                ));
            }
            name => names.push(name),
        }
    }
    if names.is_empty() && glibc {
        let known = zig::TARGETS.map(|target| target.name).join(", ");
        return Err(format!(
            "`--glibc` needs a target, to build its shared library for glibc {} and newer: {known}",
            zig::GLIBC
        ));
    }
    if names.is_empty() && check {
        return test(dirs);
    }
    let place = dirs.target.join("c");
    if names.is_empty() {
        curve::cargo(dirs, "build")?
            .args("--locked --package ztl-c --profile")
            .arg(zig::PROFILE)
            .run()?;
        let built = curve::target(dirs).join(zig::PROFILE);
        assemble(&built.join("libztl_c.a"), &place)?;
        node::assemble(dirs, None, &place)?;
        return show(&place);
    }
    for name in names {
        if name.contains("-none-") {
            let place = place.join(name);
            node::assemble(dirs, Some(name), &place)?;
            show(&place)?;
        } else {
            linux(dirs, name, glibc, check)?;
        }
    }
    Ok(())
}

/// Builds the libraries for a machine, links the examples with them and runs those; with the shared library
/// only if this machine has that processor.
pub(crate) fn check(dirs: &Dirs, target: Target) -> Outcome {
    linux(dirs, target.name, false, true)?;
    match target.name == std::env::consts::ARCH {
        true => linux(dirs, target.name, true, true),
        false => Ok(()),
    }
}

/// Builds the library for a machine of `cargo xtask dist`, and optionally runs it.
fn linux(dirs: &Dirs, name: &str, glibc: bool, check: bool) -> Outcome {
    let targets = zig::targets(&[name]).map_err(|error| {
        format!("{error}, or a microcontroller's target such as thumbv7m-none-eabi")
    })?;
    let zig = Zig::provide(dirs)?;
    for target in targets {
        let place = match glibc {
            true => glibc::assemble(dirs, &zig, target)?,
            false => cross::assemble(dirs, &zig, target)?,
        };
        show(&place)?;
        match (check, glibc) {
            (true, true) => glibc::check(dirs, &zig, target, &place)?,
            (true, false) => cross::check(dirs, &zig, target, &place)?,
            (false, _) => {}
        }
    }
    Ok(())
}

/// Runs the examples and tests in C, with encryption and under checkers.
pub(crate) fn test(dirs: &Dirs) -> Outcome {
    let python = python::ensure(dirs)?;
    curve::cargo(dirs, "build")?
        .args("--locked --package ztl-c --package ztl-std --bin ztl --lib")
        .run()?;
    let place = dirs.target.join("c-test");
    assemble(&curve::target(dirs).join("debug/libztl_c.a"), &place)?;
    node::assemble(dirs, None, &place)?;
    node::build_firmware(dirs, &curve::target(dirs))?;
    curve::cargo(dirs, "test")?
        .args("--locked --package ztl-c")
        .env("ZTL_PYTHON", python)
        .env("ZTL_CURVE", "1")
        .env("ZTL_C", dirs.absolute("c-test"))
        .run()
}

/// Prints the files and their sizes.
fn show(place: &Path) -> Outcome {
    for directory in ["include", "lib"] {
        let directory = place.join(directory);
        let entries = fs::read_dir(&directory);
        let entries = entries.map_err(|error| format!("{}: {error}", directory.display()))?;
        let mut files: Vec<_> = entries.flatten().map(|entry| entry.path()).collect();
        files.retain(|path| path.is_file() && !path.is_symlink());
        files.sort();
        for path in files {
            let size = fs::metadata(&path).map_or(0, |metadata| metadata.len());
            println!("{}: {size} bytes", path.display());
        }
    }
    Ok(())
}

fn shared() -> String {
    format!("libztl.so.{ABI}")
}

/// Creates `include/` and `lib/` from cargo's output.
fn assemble(archive: &Path, place: &Path) -> Outcome {
    let failed = |error| format!("cannot write {}: {error}", place.display());
    let lib = place.join("lib");
    fs::create_dir_all(&lib).map_err(failed)?;
    // Includes the C++ library, so that the robot needs nothing else.
    let mut archives = vec![archive.to_owned()];
    for (compiler, name) in [
        ("c++", "libstdc++.a"),
        ("cc", "libgcc_eh.a"),
        ("cc", "libgcc.a"),
    ] {
        let path = Cmd::new(compiler).arg(format!("-print-file-name={name}"));
        archives.push(path.stdout()?.into());
    }
    let object = join::join(&Tools::HOST, HEADER, &archives, &lib.join("libztl.a"))?;
    let shared = shared();
    Cmd::new("cc -shared -Wl,-z,defs -Wl,--gc-sections -s")
        .arg(format!("-Wl,-soname,{shared}"))
        .arg("-o")
        .arg(lib.join(&shared))
        .arg(&object)
        .args(SYSTEM)
        .run()?;
    fs::remove_file(&object).map_err(failed)?;
    name(&lib)
}

/// Creates the symlinks by which the shared library in `lib/` is found.
fn name(lib: &Path) -> Outcome {
    let failed = |error| format!("cannot write {}: {error}", lib.display());
    fs::create_dir_all(lib.join("pkgconfig")).map_err(failed)?;
    let link = lib.join("libztl.so");
    let _ = fs::remove_file(&link);
    symlink(shared(), &link).map_err(failed)?;
    fs::write(lib.join("pkgconfig/ztl.pc"), pkg_config()).map_err(failed)
}

/// Relative paths: works wherever the directory is put.
fn pkg_config() -> String {
    format!(
        "prefix=${{pcfiledir}}/../..\n\n\
         Name: ztl\n\
         Description: serve tasks to ZTL's clients, and have tasks done\n\
         Version: {version}\n\
         Cflags: -I${{prefix}}/include\n\
         Libs: -L${{prefix}}/lib -lztl\n\
         Libs.private: {SYSTEM}\n",
        version = env!("CARGO_PKG_VERSION"),
    )
}
