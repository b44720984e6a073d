//! The shared libraries for old Linux machines with glibc, for programs that must link with the robot's own
//! libraries.

use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result, bail, ensure};
use object::Endianness;
use object::read::elf::{ElfFile, FileHeader};

use super::join::{self, HEADER};
use super::{linux, shared};
use crate::project::{COMMAND, Project};
use crate::zig::{GLIBC, Target, Zig};
use crate::{curve, install, paths};

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
    let bytes = sh.read_binary_file(&library)?;
    let needed = join::shows_only(&bytes, &join::functions(&sh.read_file(HEADER)?))
        .and_then(|()| needs_at_most(&bytes, GLIBC))
        .with_context(|| library.display().to_string())?;
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
        curve::cargo(project, "build")?.args(COMMAND).run()?;
        let test = "--package ztl-c --test programs -- shared::".split(' ');
        let test = curve::cargo(project, "test")?.args(test);
        return Ok(test.env("ZTL_CURVE", "1").env("ZTL_C", place).run()?);
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

/// The newest glibc version that a library requires; an error if it is newer than `most`.
fn needs_at_most(library: &[u8], most: &str) -> Result<String> {
    let needs = match object::File::parse(library)? {
        object::File::Elf32(file) => glibc_needs(&file)?,
        object::File::Elf64(file) => glibc_needs(&file)?,
        _ => bail!("not an ELF file"),
    };
    let newest = needs.into_iter().max_by_key(|version| number(version));
    let newest = newest.context("does not name the glibc it needs")?;
    ensure!(
        number(&newest) <= number(most),
        "needs glibc {newest}, but at most {most} is allowed"
    );
    Ok(newest)
}

/// `2.17` in comparable form; a name such as `PRIVATE` compares above all numbers.
fn number(version: &str) -> Vec<u32> {
    let parts = version.split('.').map(str::parse);
    parts.map(|part| part.unwrap_or(u32::MAX)).collect()
}

/// The glibc versions that a file requires.
fn glibc_needs<H: FileHeader<Endian = Endianness>>(
    file: &ElfFile<'_, H>,
) -> object::Result<Vec<String>> {
    let (endian, data) = (file.endian(), file.data());
    let sections = file.elf_section_table();
    let mut found = Vec::new();
    let Some((mut needs, strings)) = sections.gnu_verneed(endian, data)? else {
        return Ok(found);
    };
    let strings = sections.strings(endian, data, strings)?;
    while let Some((_, mut versions)) = needs.next()? {
        while let Some(version) = versions.next()? {
            let name = String::from_utf8_lossy(version.name(endian, strings)?).into_owned();
            found.extend(name.strip_prefix("GLIBC_").map(str::to_owned));
        }
    }
    Ok(found)
}

#[cfg(all(test, target_os = "linux", target_env = "gnu"))]
mod tests {
    use super::*;

    #[test]
    fn a_library_for_a_newer_glibc_is_an_error() {
        let this = std::fs::read(std::env::current_exe().unwrap()).unwrap();
        let newest = needs_at_most(&this, "99").unwrap();
        assert_eq!(needs_at_most(&this, &newest).unwrap(), newest);
        let refused = needs_at_most(&this, "2.1").unwrap_err().to_string();
        assert_eq!(
            refused,
            format!("needs glibc {newest}, but at most 2.1 is allowed")
        );
        assert!(number("2.17") > number("2.4") && number("2.2.5") < number("2.4"));
        assert!(number("PRIVATE") > number("2.99"));
    }
}
