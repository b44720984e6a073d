//! The static libraries for old Linux machines, with musl, built like `ztl` in `cargo xtask dist`. Links the
//! examples with them and runs those.

use std::path::{Path, PathBuf};

use anyhow::Result;

use super::join::{self, HEADER, Tools};
use super::shared::SYSTEM;
use crate::project::Project;
use crate::zig::{Target, Zig};
use crate::{install, paths};

/// How the examples are compiled: language, standard and source.
const PROGRAMS: [[&str; 3]; 3] = [
    ["c", "-std=c89", "worker"],
    ["c", "-std=c89", "client"],
    ["c++", "-std=c++98", "handler"],
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

/// GNU's tools for a target.
fn gnu_tools(target: Target) -> Tools {
    let (prefix, linker) = match target.name {
        "i686" | "i586" => ("", &["-m", "elf_i386"][..]),
        "aarch64" => ("aarch64-linux-gnu-", &[][..]),
        arm if arm.starts_with("arm") => ("arm-linux-gnueabi-", &[][..]),
        _ => ("", &[][..]),
    };
    let needs_atomics = target.name == "armv5te";
    Tools {
        prefix,
        linker,
        runtime: if needs_atomics { ATOMICS } else { &[] },
        ..Tools::BARE
    }
}

/// Builds the static library of a target.
pub(super) fn assemble(project: &Project, zig: &Zig<'_>, target: Target) -> Result<PathBuf> {
    let place = project.target.join("c").join(target.name);
    let object = joined(project, zig, target, &place)?;
    project.sh.remove_path(object)?;
    paths::check(project, &place.join("lib/libztl.a"))?;
    Ok(place)
}

/// Creates `include/` and `lib/libztl.a` of a target, without zig's C++ library. Returns the single object in
/// it.
pub(super) fn joined(
    project: &Project,
    zig: &Zig<'_>,
    target: Target,
    place: &Path,
) -> Result<PathBuf> {
    zig.build(target)?.args(["--package", "ztl-c"]).run()?;
    let archives = [zig.built(target, "libztl_c.a")];
    let library = place.join("lib/libztl.a");
    join::join(&project.sh, &gnu_tools(target), HEADER, &archives, &library)
}

/// Links the examples with it, and runs them on their processor.
pub(super) fn check(project: &Project, zig: &Zig<'_>, target: Target, place: &Path) -> Result<()> {
    let library = place.join("lib/libztl.a").display().to_string();
    let options = ["-static", &library, "-lunwind"];
    run_examples(project, zig, target, place, &options, target.emulator)
}

/// Compiles the examples with the headers of `place`, links them with these options, and runs them with this
/// emulator.
pub(super) fn run_examples(
    project: &Project,
    zig: &Zig<'_>,
    target: Target,
    place: &Path,
    options: &[&str],
    emulator: &str,
) -> Result<()> {
    let sh = &project.sh;
    let programs = sh.create_dir(place.join("examples"))?;
    for [language, standard, name] in PROGRAMS {
        let flags = "-Os -s -pedantic -Wall -Wextra -Werror -x".split(' ');
        zig.compiler(target)
            .args(flags)
            .args([language, standard, "-I"])
            .arg(place.join("include"))
            .arg(format!("examples/c/{name}.c"))
            .args(["-x", "none"])
            .args(options)
            .args(SYSTEM)
            .arg("-o")
            .arg(programs.join(name))
            .run()?;
    }
    install::emulators(sh)?;
    install::python(project)?;
    let test = project.cargo("test --quiet --package ztl-c --test programs -- --ignored");
    let test = test.env("ZTL_C_PROGRAMS", programs);
    Ok(test.env("ZTL_C_EMULATOR", emulator).run()?)
}
