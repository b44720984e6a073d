//! The shared libraries for old Linux machines with glibc, for programs that must link with the robot's own
//! libraries.

use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result, bail, ensure};
use xshell::cmd;

use super::join::{self, HEADER};
use super::{linux, shared};
use crate::project::Project;
use crate::zig::{GLIBC, Target, Zig};
use crate::{install, paths, rerun};

/// Builds the shared library of a target.
pub(super) fn assemble(project: &Project, zig: &Zig<'_>, target: Target) -> Result<PathBuf> {
    let sh = &project.sh;
    let place = project.target.join(format!("c/{}-glibc", target.name));
    let target = target.with_glibc();
    let object = linux::joined(project, zig, target, &place)?;
    let lib = place.join("lib");
    // zig's C++ library is linked in here and not hidden yet.
    let script = lib.join("seen");
    sh.write_file(&script, "{ global: ztl_*; local: *; };\n")?;
    let hide = format!("-Wl,--version-script={}", script.display());
    shared::link(zig.compiler(target), &object, &lib, &["-lunwind", &hide])?;
    // Users of the archive would need zig's C++ library.
    for done in [object, script, lib.join("libztl.a")] {
        sh.remove_path(done)?;
    }
    let library = lib.join(shared::NAME);
    paths::check(project, &library)?;
    join::shows_only(sh, &library, &join::functions(&sh.read_file(HEADER)?))?;
    let versions = cmd!(sh, "readelf --version-info --wide {library}").read()?;
    let needed = needs_at_most(&versions, GLIBC).with_context(|| library.display().to_string())?;
    shared::name(sh, &lib)?;
    println!("{}: needs glibc {needed} or newer", library.display());
    Ok(place)
}

/// Runs C programs with it: all tests on this machine's processor; otherwise the examples in an emulator,
/// with Debian's glibc for that processor.
pub(super) fn check(project: &Project, zig: &Zig<'_>, target: Target, place: &Path) -> Result<()> {
    if target.is_here() {
        // The examples and tests in C, compiled with this machine's compiler.
        install::python(project)?;
        project.build_programs()?;
        let test = || {
            let test = project.cargo_test();
            let test = test.args(["--package", "ztl-c", "--test", "programs"]);
            Ok(test.env("ZTL_C", place))
        };
        return rerun::cargo_test(test, &["shared::"]);
    }
    // The Debian package with glibc for the processor, its root directory, and its loader.
    let (package, root, loader) = match target.name {
        "i686" => ("libc6-i386", "/", "lib/ld-linux.so.2"),
        "aarch64" => (
            "libc6-arm64-cross",
            "/usr/aarch64-linux-gnu",
            "lib/ld-linux-aarch64.so.1",
        ),
        "armv7" => (
            "libc6-armhf-cross",
            "/usr/arm-linux-gnueabihf",
            "lib/ld-linux-armhf.so.3",
        ),
        "armv5te" => (
            "libc6-armel-cross",
            "/usr/arm-linux-gnueabi",
            "lib/ld-linux.so.3",
        ),
        name => bail!("cannot run the library for {name}: Debian's glibc needs a newer processor"),
    };
    if !Path::new(root).join(loader).exists() {
        install::install(&project.sh, package)?;
    }
    let lib = place.join("lib").display().to_string();
    let (library, found) = (format!("{lib}/libztl.so"), format!("-Wl,-rpath,{lib}"));
    let emulator = format!("{} -L {root}", target.emulator);
    linux::run_examples(
        project,
        zig,
        target.with_glibc(),
        place,
        &[&library, &found],
        &emulator,
    )
}

/// The newest glibc version among those that `readelf` prints; an error if it is newer than `most`.
fn needs_at_most(versions: &str, most: &str) -> Result<String> {
    let words = versions.split_whitespace();
    let needs = words.filter_map(|word| word.strip_prefix("GLIBC_"));
    let newest = needs.max_by_key(|version| number(version));
    let newest = newest.context("does not name the glibc it needs")?;
    ensure!(
        number(newest) <= number(most),
        "needs glibc {newest}, but at most {most} is allowed"
    );
    Ok(newest.to_owned())
}

/// `2.17` in comparable form; a name such as `PRIVATE` compares above all numbers.
fn number(version: &str) -> Vec<u32> {
    let parts = version.split('.').map(str::parse);
    parts.map(|part| part.unwrap_or(u32::MAX)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_library_for_a_newer_glibc_is_an_error() {
        let versions = "Name: GLIBC_2.4  Flags: none\nName: GLIBC_2.17  Flags: none\nName: GCC_3.0";
        assert_eq!(needs_at_most(versions, "2.17").unwrap(), "2.17");
        let error = needs_at_most(versions, "2.4").unwrap_err().to_string();
        assert_eq!(error, "needs glibc 2.17, but at most 2.4 is allowed");
        assert!(needs_at_most("Name: GLIBC_PRIVATE", "2.99").is_err());
        assert!(needs_at_most("", "2.17").is_err());
    }
}
