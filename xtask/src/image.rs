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

use anyhow::{Context as _, Result};
use xshell::Cmd;

use crate::cross::Core;
use crate::project::Project;

/// The package of the images, which is not in the workspace.
pub(crate) const MANIFEST: &str = "proof/Cargo.toml";

/// The command that builds an image, and the path of the result.
pub(crate) fn build<'a>(
    project: &'a Project,
    core: &Core,
    target: &str,
    name: &str,
    features: &str,
) -> Result<(Cmd<'a>, PathBuf)> {
    let build = core.cargo(project, "build", target, "image")?;
    let build = build.args(["--release", "--manifest-path", MANIFEST, "--bin", name]);
    let path = project.target.join("image").join(target);
    let build = build.args(["--features", features]);
    Ok((build, path.join("release").join(name)))
}

/// Size of an image in bytes, and its contents.
#[derive(Default)]
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
    pub(crate) fn read(path: &Path) -> Result<Self> {
        with_elf(path, |elf| {
            let mut image = Self::default();
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
                let section = symbol.section_index();
                let here = section.is_some_and(|section| in_flash.contains(&section));
                // Identical functions are merged but keep their names.
                if named && here && symbol.size() > 0 && seen.insert(symbol.address()) {
                    let (name, size) =
                        (demangled(symbol.name().unwrap_or_default()), symbol.size());
                    image.symbols.push(Symbol { name, size });
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
pub(crate) fn memory(path: &Path) -> Result<Memory> {
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
pub(crate) fn panic_places(path: &Path) -> Result<BTreeSet<String>> {
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

fn with_elf<T>(path: &Path, read: impl FnOnce(&ElfFile32<'_, Endianness>) -> T) -> Result<T> {
    let context = || path.display().to_string();
    let bytes = fs::read(path).with_context(context)?;
    let elf = ElfFile32::<Endianness>::parse(&*bytes).with_context(context)?;
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
}
