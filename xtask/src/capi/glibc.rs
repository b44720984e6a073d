//! The shared libraries for old Linux machines with glibc: for programs that have to be linked with the robot's own
//! libraries.

use std::fmt::Display;
use std::fs;
use std::path::{Path, PathBuf};

use object::Endianness;
use object::read::elf::{ElfFile, FileHeader};

use super::{HEADER, SYSTEM, cross, join};
use crate::cmd::Outcome;
use crate::zig::{GLIBC, Target, Zig};
use crate::{Dirs, curve, places, python};

/// Makes the shared library of a target.
pub(super) fn assemble(dirs: &Dirs, zig: &Zig, target: Target) -> Outcome<PathBuf> {
    let place = dirs.target.join("c").join(format!("{}-glibc", target.name));
    let target = target.with_glibc();
    let object = cross::joined(zig, target, &place)?;
    let lib = place.join("lib");
    let failed = |error| format!("cannot write {}: {error}", lib.display());
    // zig's C++ library, which is linked in here, is not hidden yet.
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
    // The archive would need zig's C++ library of whoever links it.
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

/// Runs the examples and the tests in C with it, where this machine can.
pub(super) fn check(dirs: &Dirs, target: Target, place: &Path) -> Outcome {
    if target.name != std::env::consts::ARCH {
        return Err(format!(
            "only a machine of that kind can run the shared library for {}; it is made",
            target.name
        ));
    }
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

/// The newest version of glibc whose names a library asks for, which may be this one.
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
    let newest = newest.ok_or_else(|| failed(&"does not tell which glibc it needs"))?;
    match number(&newest) > number(most) {
        true => Err(failed(&format!(
            "needs glibc {newest}, and may need {most}"
        ))),
        false => Ok(newest),
    }
}

/// `2.17` as what can be compared; what is no number, as `PRIVATE`, is beyond all.
fn number(version: &str) -> Vec<u32> {
    let parts = version.split('.').map(str::parse);
    parts.map(|part| part.unwrap_or(u32::MAX)).collect()
}

/// The versions of glibc that a file names.
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
    fn a_library_for_a_newer_glibc_is_refused() {
        let this = std::env::current_exe().unwrap();
        let newest = needs_at_most(&this, "99").unwrap();
        assert_eq!(needs_at_most(&this, &newest), Ok(newest.clone()));
        let refused = needs_at_most(&this, "2.1").unwrap_err();
        let reason = format!("needs glibc {newest}, and may need 2.1");
        assert!(refused.ends_with(&reason), "{refused}");
        assert!(number("2.17") > number("2.4") && number("2.2.5") < number("2.4"));
        assert!(number("PRIVATE") > number("2.99"));
    }
}
