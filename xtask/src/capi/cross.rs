//! The static libraries for old Linux machines, with musl, built like `ztl` in `cargo xtask dist`. Links the
//! examples with them and runs those.

use std::fs;
use std::path::{Path, PathBuf};

use super::join::{self, Tools};
use super::{HEADER, SYSTEM};
use crate::cmd::{Cmd, Outcome};
use crate::zig::{Target, Zig};
use crate::{Dirs, places, python, tools};

/// How the examples are compiled: language options and sources.
const PROGRAMS: [(&str, &str); 3] = [
    ("-x c -std=c89", "worker"),
    ("-x c -std=c89", "client"),
    ("-x c++ -std=c++98", "handler"),
];

/// ARMv5 has no atomic instructions. Rust's runtime library has functions instead, which call the kernel. zig
/// has none, but its C++ library needs these.
const ATOMICS: &[&str] = &[
    "__sync_fetch_and_add_4",
    "__sync_lock_test_and_set_1",
    "__sync_lock_test_and_set_4",
    "__sync_val_compare_and_swap_1",
    "__sync_val_compare_and_swap_4",
];

/// GNU's tools for a target, and the Debian package that contains them.
fn gnu_tools(target: Target) -> (Tools, &'static str) {
    let (prefix, emulation, package) = match target.triple.split('-').next() {
        Some("i686" | "i586") => ("", "-m elf_i386", "binutils"),
        Some("aarch64") => ("aarch64-linux-gnu-", "", "binutils-aarch64-linux-gnu"),
        Some(arm) if arm.starts_with("arm") => {
            ("arm-linux-gnueabi-", "", "binutils-arm-linux-gnueabi")
        }
        _ => ("", "", "binutils"),
    };
    let tools = Tools {
        prefix,
        emulation,
        unmark: "",
        runtime: if target.name == "armv5te" {
            ATOMICS
        } else {
            &[]
        },
    };
    (tools, package)
}

/// Builds the static library of a target.
pub(super) fn assemble(dirs: &Dirs, zig: &Zig, target: Target) -> Outcome<PathBuf> {
    let place = dirs.target.join("c").join(target.name);
    let object = joined(zig, target, &place)?;
    fs::remove_file(&object).map_err(|error| format!("{}: {error}", object.display()))?;
    places::check(dirs, &place.join("lib/libztl.a"))?;
    Ok(place)
}

/// Creates `include/` and `lib/libztl.a` of a target, without zig's C++ library. Returns the single object in
/// it.
pub(super) fn joined(zig: &Zig, target: Target, place: &Path) -> Outcome<PathBuf> {
    let (gnu, package) = gnu_tools(target);
    if !tools::has(&format!("{}ld", gnu.prefix)) {
        tools::install(&[package])?;
    }
    let libraries = zig.libraries(target)?;
    zig.build_with(target, &libraries)?
        .args("--package ztl-c")
        .run()?;
    let archives = [zig.program(target, "libztl_c.a")];
    join::join(&gnu, HEADER, &archives, &place.join("lib/libztl.a"))
}

/// Links the examples with it, and runs them on their processor.
pub(super) fn check(dirs: &Dirs, zig: &Zig, target: Target, place: &Path) -> Outcome {
    let library = place.join("lib/libztl.a").display().to_string();
    let programs = link(dirs, zig, target, place, &["-static", &library, "-lunwind"])?;
    run_programs(dirs, target.emulator, &programs)
}

/// Compiles the examples with the headers of `place`, links them with these options, and returns their
/// directory.
pub(super) fn link(
    dirs: &Dirs,
    zig: &Zig,
    target: Target,
    place: &Path,
    options: &[&str],
) -> Outcome<PathBuf> {
    let programs = dirs.root.join(place).join("examples");
    fs::create_dir_all(&programs).map_err(|error| format!("{}: {error}", programs.display()))?;
    for (language, name) in PROGRAMS {
        let mut compile = zig
            .command("-m ziglang c++")
            .args(&target.zig_options())
            .args("-Os -s -pedantic -Wall -Wextra -Werror")
            .args(language)
            .arg("-I")
            .arg(place.join("include"))
            .arg(format!("examples/c/{name}.c"))
            .args("-x none");
        for option in options {
            compile = compile.arg(option);
        }
        compile
            .args(SYSTEM)
            .arg("-o")
            .arg(programs.join(name))
            .run()?;
    }
    Ok(programs)
}

/// Runs examples that were linked for another processor.
pub(super) fn run_programs(dirs: &Dirs, emulator: &str, programs: &Path) -> Outcome {
    tools::provide_emulators()?;
    let python = python::ensure(dirs)?;
    Cmd::new("cargo test --quiet --locked --package ztl-c --test programs -- --ignored")
        .env("ZTL_C_PROGRAMS", programs)
        .env("ZTL_C_EMULATOR", emulator)
        .env("ZTL_PYTHON", python)
        .run()
}
