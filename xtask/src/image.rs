//! The firmware images of `proof/`: how they are built, and what is read from them.

use std::cmp::Reverse;
use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

use object::Endianness;
use object::elf::{SHF_ALLOC, SHF_WRITE};
use object::read::elf::ElfFile32;
use object::{Object, ObjectSection, ObjectSymbol, SectionFlags, SectionKind, SymbolKind};

use crate::Dirs;
use crate::cmd::{Cmd, Outcome};
use crate::cross::Core;

/// The package of the images, which is no member of the workspace.
pub(crate) const MANIFEST: &str = "proof/Cargo.toml";

/// The command that builds an image, and where it then lies.
pub(crate) fn build(
    dirs: &Dirs,
    core: &Core,
    target: &str,
    name: &str,
    features: &str,
) -> Outcome<(Cmd, PathBuf)> {
    let target_dir = dirs.target.join("image");
    let build = core
        .cargo("build", target, &target_dir)
        .args("--locked --release --manifest-path")
        .arg(MANIFEST)
        .args("--bin")
        .arg(name);
    let build = match features {
        "" => build,
        features => build.arg("--features").arg(features),
    };
    let path = target_dir.join(target).join("release").join(name);
    Ok((core.with_linker(dirs, build)?, path))
}

/// Checks that the images are built with the same crates as everything else: they have a lock
/// file of their own.
pub(crate) fn check_lock() -> Outcome {
    let read = |path: &Path| {
        fs::read_to_string(path).map_err(|error| format!("cannot read {}: {error}", path.display()))
    };
    let ours = read(&Path::new(MANIFEST).with_extension("lock"))?;
    let others = locked(&read(Path::new("Cargo.lock"))?);
    for (name, version) in locked(&ours) {
        let same_name = || others.iter().filter(|(other, _)| *other == name);
        if same_name().next().is_some() && !same_name().any(|(_, other)| *other == version) {
            let versions: Vec<&str> = same_name().map(|(_, version)| version.as_str()).collect();
            return Err(format!(
                "the images are built with {name} {version}, everything else with {}; to mend it: \
                 cargo update --manifest-path {MANIFEST} {name} --precise VERSION",
                versions.join(" and ")
            ));
        }
    }
    Ok(())
}

/// Name and version of each package in a lock file.
fn locked(lock: &str) -> BTreeSet<(String, String)> {
    let value = |package: &str, key: &str| {
        let mut lines = package.lines();
        let value = lines.find_map(|line| line.strip_prefix(key)?.strip_prefix(" = \""))?;
        Some(value.strip_suffix('"')?.to_owned())
    };
    lock.split("[[package]]")
        .skip(1)
        .filter_map(|package| Some((value(package, "name")?, value(package, "version")?)))
        .collect()
}

/// What an image takes, in bytes, and what it consists of.
pub(crate) struct Image {
    /// Everything that is not zero at the start: vectors, code, constants, initial values.
    pub(crate) flash: u64,
    /// What has its place in RAM, but for the stack.
    pub(crate) ram: u64,
    /// Everything in flash that has a name, the largest first.
    pub(crate) symbols: Vec<Symbol>,
}

/// A function or a constant.
pub(crate) struct Symbol {
    pub(crate) name: String,
    pub(crate) size: u64,
}

impl Image {
    pub(crate) fn read(path: &Path) -> Outcome<Self> {
        with_elf(path, |elf| {
            let mut image = Self {
                flash: 0,
                ram: 0,
                symbols: Vec::new(),
            };
            let mut in_flash = Vec::new();
            for section in elf.sections() {
                let SectionFlags::Elf { sh_flags, .. } = section.flags() else {
                    continue;
                };
                if !sh_flags.contains(SHF_ALLOC) {
                    continue;
                }
                if section.kind() != SectionKind::UninitializedData {
                    image.flash += section.size();
                    in_flash.push(section.index());
                }
                if sh_flags.contains(SHF_WRITE) {
                    image.ram += section.size();
                }
            }
            let mut seen = BTreeSet::new();
            for symbol in elf.symbols() {
                let named = matches!(symbol.kind(), SymbolKind::Text | SymbolKind::Data);
                let here = symbol
                    .section_index()
                    .is_some_and(|i| in_flash.contains(&i));
                // Equal functions are merged and keep their names.
                if named && here && symbol.size() > 0 && seen.insert(symbol.address()) {
                    image.symbols.push(Symbol {
                        name: demangled(symbol.name().unwrap_or_default()),
                        size: symbol.size(),
                    });
                }
            }
            image.symbols.sort_by_key(|symbol| Reverse(symbol.size));
            image
        })
    }
}

/// The places in the sources where an image can panic, as `file:line:column`, where the compiler
/// told them: it lays each down as a string's address and length, line, and column.
pub(crate) fn panic_places(path: &Path) -> Outcome<BTreeSet<String>> {
    with_elf(path, |elf| {
        let contents: Vec<(u64, &[u8])> = elf
            .sections()
            .filter(|section| section.kind() != SectionKind::UninitializedData)
            .filter_map(|section| Some((section.address(), section.data().ok()?)))
            .collect();
        contents
            .iter()
            .flat_map(|(_, data)| data.windows(16).step_by(4))
            .filter_map(|place| panic_place(place, &contents))
            .collect()
    })
}

fn panic_place(place: &[u8], contents: &[(u64, &[u8])]) -> Option<String> {
    let (words, _) = place.as_chunks::<4>();
    let words: Vec<u32> = words.iter().map(|word| u32::from_le_bytes(*word)).collect();
    let &[address, len, line, column] = words.as_slice() else {
        return None;
    };
    let file = contents.iter().find_map(|(start, data)| {
        let at = usize::try_from(u64::from(address).checked_sub(*start)?).ok()?;
        data.get(at..)?.get(..usize::try_from(len).ok()?)
    })?;
    let file = str::from_utf8(file)
        .ok()
        .filter(|file| file.ends_with(".rs"))?;
    Some(format!("{file}:{line}:{column}"))
}

fn with_elf<T>(path: &Path, read: impl FnOnce(&ElfFile32<'_, Endianness>) -> T) -> Outcome<T> {
    let bytes =
        fs::read(path).map_err(|error| format!("cannot read {}: {error}", path.display()))?;
    let elf = ElfFile32::<Endianness>::parse(&*bytes)
        .map_err(|error| format!("{} is no 32-bit ELF file: {error}", path.display()))?;
    Ok(read(&elf))
}

/// A symbol's name as a person would write it, without the compiler's hash.
pub(crate) fn demangled(name: &str) -> String {
    format!("{:#}", rustc_demangle::demangle(name))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_lock_file_is_read() {
        let lock = "version = 4\n\n[[package]]\nname = \"crc\"\nversion = \"3.4.0\"\n\
                    dependencies = [\n \"crc-catalog\",\n]\n\n[[package]]\nname = \"a\"\nversion = \"1.0.0\"\n";
        let pair = |name: &str, version: &str| (name.to_owned(), version.to_owned());
        assert_eq!(
            locked(lock),
            BTreeSet::from([pair("a", "1.0.0"), pair("crc", "3.4.0")])
        );
    }

    #[test]
    fn a_panics_place_is_found_among_the_constants() {
        let mut data = b"xxxxsrc/a.rs".to_vec();
        for word in [0x1004u32, 8, 17, 5] {
            data.extend(word.to_le_bytes());
        }
        let constants = [(0x1000, data.as_slice())];
        let places: Vec<String> = data
            .windows(16)
            .step_by(4)
            .filter_map(|place| panic_place(place, &constants))
            .collect();
        assert_eq!(places, ["src/a.rs:17:5"]);
    }

    #[test]
    fn both_manglings_are_understood() {
        assert_eq!(
            demangled("_ZN4core3fmt9Formatter3pad17h0123456789abcdefE"),
            "core::fmt::Formatter::pad"
        );
        assert_eq!(
            demangled("_RNvNtCseold96UKqg_4core9panicking5panic"),
            "core::panicking::panic"
        );
    }
}
