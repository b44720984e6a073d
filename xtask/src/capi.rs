//! `cargo xtask c`: builds the C libraries and their headers.
//!
//! The static library that cargo builds from `ztl-c` exports the names of Rust's library, which would clash with those
//! of another one in a robot's program. So everything is linked into one object that exports only the functions of
//! `ztl.h`. The static and the shared library are made from it.

mod glibc;
mod join;
mod linux;
mod node;
mod shared;

use std::path::Path;

use anyhow::{Context as _, Result};
use xshell::cmd;

use crate::project::Project;
use crate::zig::{self, Target, Zig};
use crate::{install, rerun};
use join::{HEADER, Tools};

/// Builds the libraries for this machine, for a microcontroller, or for old Linux machines.
pub(crate) fn build(project: &Project, names: &[String], check: bool, glibc: bool) -> Result<()> {
    let place = project.target.join("c");
    if names.is_empty() {
        if check {
            return test(project);
        }
        let profile = zig::PROFILE;
        project
            .cargo("build --package ztl-c --profile")
            .arg(profile)
            .run()?;
        assemble(project, &project.target.join(profile), &place)?;
        return show(project, &place);
    }
    for name in names {
        if name.contains("-none-") {
            let place = place.join(name);
            node::assemble(project, Some(name), &place)?;
            show(project, &place)?;
        } else {
            let expected = "expected a processor, or a target such as thumbv7m-none-eabi";
            for target in zig::targets(&[name]).context(expected)? {
                for_linux(project, target, check, glibc)?;
            }
        }
    }
    Ok(())
}

/// Builds the libraries for a machine of `cargo xtask dist`, links the examples with them and runs those; with the
/// shared library only if this machine has that processor.
pub(crate) fn check(project: &Project, target: Target) -> Result<()> {
    for_linux(project, target, true, false)?;
    match target.is_here() {
        true => for_linux(project, target, true, true),
        false => Ok(()),
    }
}

fn for_linux(project: &Project, target: Target, check: bool, glibc: bool) -> Result<()> {
    let zig = Zig::provide(project)?;
    let place = match glibc {
        true => glibc::assemble(project, &zig, target)?,
        false => linux::assemble(project, &zig, target)?,
    };
    show(project, &place)?;
    match (check, glibc) {
        (true, true) => glibc::check(project, &zig, target, &place),
        (true, false) => linux::check(project, &zig, target, &place),
        (false, _) => Ok(()),
    }
}

/// Runs the examples and tests in C, with encryption and under checkers.
pub(crate) fn test(project: &Project) -> Result<()> {
    install::python(project)?;
    project.build_programs()?;
    // Alone, without the features that other packages use.
    project.cargo("build --package ztl-c --lib").run()?;
    let built = &project.target;
    let place = project.target.join("c-test");
    assemble(project, &built.join("debug"), &place)?;
    node::build_firmware(project, &place, built)?;
    let test = || {
        let test = project.cargo_test().args(["--package", "ztl-c"]);
        Ok(test.env("ZTL_C", &place))
    };
    rerun::cargo_test(test, &[])
}

/// Creates `include/` and `lib/` for this machine from cargo's output.
fn assemble(project: &Project, built: &Path, place: &Path) -> Result<()> {
    let sh = &project.sh;
    let lib = place.join("lib");
    // Includes the compiler's library, so that the robot needs nothing else.
    let mut archives = vec![built.join("libztl_c.a")];
    for name in ["libgcc_eh.a", "libgcc.a"] {
        let path = cmd!(sh, "cc -print-file-name={name}").read()?;
        archives.push(path.into());
    }
    let object = join::join(sh, &Tools::HOST, HEADER, &archives, &lib.join("libztl.a"))?;
    shared::link(cmd!(sh, "cc"), &object, &lib, &[])?;
    sh.remove_path(&object)?;
    shared::name(sh, &lib)?;
    node::assemble(project, None, place)
}

/// Prints the files and their sizes.
fn show(project: &Project, place: &Path) -> Result<()> {
    for directory in ["include", "lib"] {
        for path in project.sh.read_dir(place.join(directory))? {
            let about = path.symlink_metadata()?;
            if about.is_file() {
                println!("{}: {} bytes", path.display(), about.len());
            }
        }
    }
    Ok(())
}
