//! The shared libraries for old Linux machines with glibc, for programs that must link with the robot's own
//! libraries.

use std::fmt::Display;
use std::fs;
use std::path::{Path, PathBuf};

use object::Endianness;
use object::read::elf::{ElfFile, FileHeader};

use super::{HEADER, SYSTEM, cross, join};
use crate::cmd::Outcome;
use crate::zig::{GLIBC, Target, Zig};
use crate::{Dirs, curve, places, python, tools};

/// Builds the shared library of a target.
pub(super) fn assemble(dirs: &Dirs, zig: &Zig, target: Target) -> Outcome<PathBuf> {
    let place = dirs.target.join("c").join(format!("{}-glibc", target.name));
    let target = target.with_glibc();
    let object = cross::joined(zig, target, &place)?;
    let lib = place.join("lib");
    let failed = |error| format!("cannot write {}: {error}", lib.display());
    // zig's C++ library is linked in here and not hidden yet.
    let seen = lib.join("seen");
    fs::write(&seen, "{ global: ztl_*; local: *; };\n").map_err(failed)?;
    let shared = lib.join(super::shared());
    zig.command("-m ziglang c++ -shared -s -Wl,-z,defs -Wl,--gc-sections")
        .args(&target.zig_options())
        .arg(format!("-Wl,-soname,{}", super::shared()))
        .arg(format!("-Wl,--version-script={}", seen.display()))
        .arg("-o")
        .arg(&shared)
        .arg(&object)
        .args("-lunwind")
        .args(SYSTEM)
        .run()?;
    // Users of the archive would need zig's C++ library.
    for done in [object, seen, lib.join("libztl.a")] {
        fs::remove_file(done).map_err(failed)?;
    }
    places::check(dirs, &shared)?;
    let header = fs::read_to_string(HEADER).map_err(|error| format!("{HEADER}: {error}"))?;
    join::shows_only(&shared, &join::functions(&header))?;
    let needed = needs_at_most(&shared, GLIBC)?;
    super::name(&lib)?;
    println!("{}: needs glibc {needed} or newer", shared.display());
    Ok(place)
}

/// Runs C programs with it: all tests on this machine's processor; otherwise the examples in an emulator,
/// with Debian's glibc for that processor.
pub(super) fn check(dirs: &Dirs, zig: &Zig, target: Target, place: &Path) -> Outcome {
    if target.name == std::env::consts::ARCH {
        return check_here(dirs, place);
    }
    let Some((package, root, loader)) = debians(target) else {
        return Err(format!(
            "built the shared library for {}; it cannot run here, because Debian's glibc needs a newer processor",
            target.name
        ));
    };
    if !Path::new(root).join(loader).exists() {
        tools::install(&[package])?;
    }
    let lib = dirs.root.join(place).join("lib");
    let library = lib.join("libztl.so").display().to_string();
    let found = format!("-Wl,-rpath,{}", lib.display());
    let programs = cross::link(dirs, zig, target.with_glibc(), place, &[&library, &found])?;
    cross::run_programs(dirs, &format!("{} -L {root}", target.emulator), &programs)
}

/// The examples and tests in C, compiled with this machine's compiler.
fn check_here(dirs: &Dirs, place: &Path) -> Outcome {
    curve::cargo(dirs, "build")?
        .args("--locked --package ztl-std --bin ztl")
        .run()?;
    curve::cargo(dirs, "test")?
        .args("--locked --package ztl-c --test programs -- shared::")
        .env("ZTL_PYTHON", python::ensure(dirs)?)
        .env("ZTL_CURVE", "1")
        .env("ZTL_C", dirs.root.join(place))
        .run()
}

/// The Debian package with glibc for a processor, its root directory, and its loader.
fn debians(target: Target) -> Option<(&'static str, &'static str, &'static str)> {
    match target.name {
        "i686" => Some(("libc6-i386", "/", "lib/ld-linux.so.2")),
        "aarch64" => Some((
            "libc6-arm64-cross",
            "/usr/aarch64-linux-gnu",
            "lib/ld-linux-aarch64.so.1",
        )),
        "armv7" => Some((
            "libc6-armhf-cross",
            "/usr/arm-linux-gnueabihf",
            "lib/ld-linux-armhf.so.3",
        )),
        "armv5te" => Some((
            "libc6-armel-cross",
            "/usr/arm-linux-gnueabi",
            "lib/ld-linux.so.3",
        )),
        _ => None,
    }
}

/// The newest glibc version that a library requires; an error if it is newer than `most`.
fn needs_at_most(library: &Path, most: &str) -> Outcome<String> {
    let failed = |error: &dyn Display| format!("{}: {error}", library.display());
    let bytes = fs::read(library).map_err(|error| failed(&error))?;
    let file = object::File::parse(&*bytes).map_err(|error| failed(&error))?;
    let needs = match &file {
        object::File::Elf32(file) => glibc_needs(file),
        object::File::Elf64(file) => glibc_needs(file),
        _ => return Err(failed(&"no ELF file")),
    };
    let needs = needs.map_err(|error| failed(&error))?;
    let newest = needs.into_iter().max_by_key(|version| number(version));
    let newest = newest.ok_or_else(|| failed(&"does not name the glibc it needs"))?;
    match number(&newest) > number(most) {
        true => Err(failed(&format!(
            "needs glibc {newest}, but at most {most} is allowed"
        ))),
        false => Ok(newest),
    }
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
        let this = std::env::current_exe().unwrap();
        let newest = needs_at_most(&this, "99").unwrap();
        assert_eq!(needs_at_most(&this, &newest), Ok(newest.clone()));
        let refused = needs_at_most(&this, "2.1").unwrap_err();
        let reason = format!("needs glibc {newest}, but at most 2.1 is allowed");
        assert!(refused.ends_with(&reason), "{refused}");
        assert!(number("2.17") > number("2.4") && number("2.2.5") < number("2.4"));
        assert!(number("PRIVATE") > number("2.99"));
    }
}
