//! Builds and reads the firmware images of `proof/`.

use std::cmp::Reverse;
use std::collections::BTreeSet;
use std::fs;
use std::ops::Range;
use std::path::{Path, PathBuf};

use object::Endianness;
use object::elf::{SHF_ALLOC, SHF_WRITE};
use object::read::elf::ElfFile32;
use object::{Object, ObjectSection, ObjectSymbol, SectionFlags, SectionKind, SymbolKind};

use crate::Dirs;
use crate::cmd::{Cmd, Outcome};
use crate::cross::Core;

/// The package of the images, which is not in the workspace.
pub(crate) const MANIFEST: &str = "proof/Cargo.toml";

/// The command that builds an image, and the path of the result.
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

/// Checks that a separate workspace uses the same crate versions as the main one, because it has its own lock
/// file.
pub(crate) fn check_lock(manifest: &str) -> Outcome {
    let read = |path: &Path| {
        fs::read_to_string(path).map_err(|error| format!("cannot read {}: {error}", path.display()))
    };
    let ours = locked(&read(&Path::new(manifest).with_extension("lock"))?);
    let others = locked(&read(Path::new("Cargo.lock"))?);
    match differing(&ours, &others) {
        None => Ok(()),
        Some([name, ours, others]) => Err(format!(
            "the images are built with {name} {ours}, everything else with {others}; to mend it: \
             cargo update --manifest-path {manifest} {name} --precise VERSION"
        )),
    }
}

type Packages = BTreeSet<(String, String)>;

/// A package that could have the same version in both, but does not: its name and both versions.
fn differing<'a>(ours: &'a Packages, others: &'a Packages) -> Option<[&'a str; 3]> {
    ours.difference(others).find_map(|(name, version)| {
        let mut same = others.iter().filter(|(other, _)| other == name);
        let (_, other) = same.find(|(_, other)| series(other) == series(version))?;
        Some([name.as_str(), version, other])
    })
}

/// The part of a version that Cargo treats as compatible: `1` of 1.2.3, `0.2` of 0.2.3.
fn series(version: &str) -> &str {
    let mut ends = version.match_indices('.').map(|(index, _)| index);
    let end = match version.starts_with("0.") {
        true => ends.nth(1),
        false => ends.next(),
    };
    end.and_then(|end| version.get(..end)).unwrap_or(version)
}

/// Name and version of each package in a lock file.
fn locked(lock: &str) -> Packages {
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

/// Size of an image in bytes, and its contents.
pub(crate) struct Image {
    /// Everything that is not zero at start: vectors, code, constants, initial values.
    pub(crate) flash: u64,
    /// Static RAM, without the stack.
    pub(crate) ram: u64,
    /// Every named item in flash, the largest first.
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
                // Sections of a linker script for the remaining RAM are not part of the image.
                let rest = matches!(section.name(), Ok(".stack" | ".heap"));
                if sh_flags.contains(SHF_WRITE) && !rest {
                    image.ram += section.size();
                }
            }
            let mut seen = BTreeSet::new();
            for symbol in elf.symbols() {
                let named = matches!(symbol.kind(), SymbolKind::Text | SymbolKind::Data);
                let here = symbol
                    .section_index()
                    .is_some_and(|i| in_flash.contains(&i));
                // Identical functions are merged but keep their names.
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

/// An image's memory contents, and the addresses of its functions.
#[derive(Debug, Default)]
pub(crate) struct Memory {
    pub(crate) contents: Vec<(u32, Vec<u8>)>,
    pub(crate) functions: Vec<(String, Range<u32>)>,
}

impl Memory {
    /// The two bytes at this address.
    pub(crate) fn halfword(&self, address: u32) -> Option<u16> {
        self.contents.iter().find_map(|(start, bytes)| {
            let at = usize::try_from(address.checked_sub(*start)?).ok()?;
            let bytes = bytes.get(at..)?.first_chunk::<2>()?;
            Some(u16::from_le_bytes(*bytes))
        })
    }

    /// The address range of the function with this name, in any module.
    pub(crate) fn function(&self, name: &str) -> Option<Range<u32>> {
        let mut functions = self.functions.iter();
        let (_, place) = functions.find(|(known, _)| known.rsplit("::").next() == Some(name))?;
        Some(place.clone())
    }
}

/// Reads an image's memory contents.
pub(crate) fn memory(path: &Path) -> Outcome<Memory> {
    with_elf(path, |elf| {
        let address = |address: u64| u32::try_from(address).unwrap_or_default();
        let mut memory = Memory::default();
        for section in elf.sections() {
            if let (SectionKind::Text, Ok(data)) = (section.kind(), section.data()) {
                let content = (address(section.address()), data.to_owned());
                memory.contents.push(content);
            }
        }
        for symbol in elf.symbols() {
            if symbol.kind() == SymbolKind::Text {
                // The lowest bit marks Thumb code.
                let start = address(symbol.address() & !1);
                let name = demangled(symbol.name().unwrap_or_default());
                let place = start..start + address(symbol.size());
                memory.functions.push((name, place));
            }
        }
        memory
    })
}

/// The source positions at which an image can panic, as `file:line:column`. The compiler stores each as a
/// string's address and length, line, and column.
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
        .map_err(|error| format!("{} is not a 32-bit ELF file: {error}", path.display()))?;
    Ok(read(&elf))
}

/// A symbol's name as in the source, without the compiler's hash.
pub(crate) fn demangled(name: &str) -> String {
    format!("{:#}", rustc_demangle::demangle(name))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_lock_file_is_parsed() {
        let lock = "version = 4\n\n[[package]]\nname = \"crc\"\nversion = \"3.4.0\"\n\
                    dependencies = [\n \"crc-catalog\",\n]\n\n[[package]]\nname = \"a\"\nversion = \"1.0.0\"\n";
        let pair = |name: &str, version: &str| (name.to_owned(), version.to_owned());
        assert_eq!(
            locked(lock),
            BTreeSet::from([pair("a", "1.0.0"), pair("crc", "3.4.0")])
        );
    }

    #[test]
    fn compatible_versions_must_be_equal() {
        let packages = |pairs: &[(&str, &str)]| -> Packages {
            let pair = |(name, version): &(&str, &str)| (name.to_string(), version.to_string());
            pairs.iter().map(pair).collect()
        };
        let others = packages(&[("a", "1.2.3"), ("b", "0.2.7"), ("b", "1.0.0")]);
        for fine in [
            packages(&[("a", "1.2.3"), ("c", "7.0.0")]),
            packages(&[("b", "0.2.7"), ("b", "0.3.0")]),
        ] {
            assert_eq!(differing(&fine, &others), None);
        }
        for (name, version, other) in [("a", "1.3.0", "1.2.3"), ("b", "0.2.8", "0.2.7")] {
            let ours = packages(&[(name, version)]);
            assert_eq!(differing(&ours, &others), Some([name, version, other]));
        }
    }

    #[test]
    fn panic_positions_are_found_among_the_constants() {
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
    fn both_mangling_schemes_are_supported() {
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
