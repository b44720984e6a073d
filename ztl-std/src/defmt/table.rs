//! The log table in a firmware's ELF file: format strings by number, and their source positions.

use std::collections::HashMap;

use gimli::{EndianSlice, RunTimeEndian, SectionId};
use object::{Object, ObjectSection, ObjectSymbol};
use serde::Deserialize;

use super::message::Level;

/// Supported versions of the wire format.
const VERSIONS: [&str; 2] = ["3", "4"];

/// Why an ELF file cannot be used to decode a log.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum ElfError {
    /// Reading failed, with the cause.
    Read(String),
    /// Not an ELF file.
    NotElf,
    /// The program has no defmt log, or was stripped.
    NoLog,
    /// The program uses an unsupported version of the format.
    Version {
        /// The version found.
        found: String,
    },
    /// A symbol is not in defmt's format.
    Symbol {
        /// The symbol.
        name: String,
    },
}

impl std::fmt::Display for ElfError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Read(cause) => write!(f, "cannot read the file: {cause}"),
            Self::NotElf => f.write_str("not an ELF file: use the one that cargo built"),
            Self::NoLog => f.write_str(
                "no defmt log in this program, or its symbols were stripped: use the flashed file as built by cargo",
            ),
            Self::Version { found } => write!(
                f,
                "unsupported version {found} of defmt's format: expected {}",
                VERSIONS.join(" or ")
            ),
            Self::Symbol { name } => write!(f, "symbol {name} is not in defmt's format"),
        }
    }
}

impl std::error::Error for ElfError {}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Encoding {
    Raw,
    Rzcobs,
}

/// What a number stands for.
#[derive(Debug)]
pub(super) struct Entry {
    /// `None` if it is only part of a message.
    pub(super) level: Option<Option<Level>>,
    pub(super) text: String,
    pub(super) place: Option<String>,
}

/// Identifies a set of flags: name, package, disambiguator, crate.
pub(super) type FlagsName = (String, String, String, Option<String>);

#[derive(Debug)]
pub(super) struct Table {
    pub(super) encoding: Encoding,
    entries: HashMap<u16, Entry>,
    timestamp: Option<String>,
    flags: HashMap<FlagsName, Vec<(u128, String, u128)>>,
}

/// The name of a symbol, in JSON.
#[derive(Deserialize)]
struct Symbol {
    package: String,
    disambiguator: String,
    tag: String,
    data: String,
    crate_name: Option<String>,
}

impl Table {
    pub(super) fn of_elf(bytes: &[u8]) -> Result<Self, ElfError> {
        let elf = object::File::parse(bytes).map_err(|_| ElfError::NotElf)?;
        let names = || elf.symbols().filter_map(|symbol| symbol.name().ok());
        let value = |key: &str| {
            names().find_map(|name| Some(name.trim_matches('"').strip_prefix(key)?.to_owned()))
        };
        let version = value("_defmt_version_ = ").ok_or(ElfError::NoLog)?;
        if !VERSIONS.contains(&version.as_str()) {
            return Err(ElfError::Version { found: version });
        }
        let encoding = match value("_defmt_encoding_ = ").as_deref() {
            Some("raw") => Encoding::Raw,
            Some("rzcobs") => Encoding::Rzcobs,
            _ => return Err(ElfError::NoLog),
        };
        let mut table = Self {
            encoding,
            entries: HashMap::new(),
            timestamp: None,
            flags: HashMap::new(),
        };
        let mut places = places(&elf).unwrap_or_default();
        for symbol in elf.symbols() {
            let section = symbol.section_index();
            let section = section.and_then(|index| elf.section_by_index(index).ok());
            let Some(section) = section.filter(|section| {
                let name = section.name().unwrap_or_default();
                name == ".defmt" || name.starts_with(".defmt.")
            }) else {
                continue;
            };
            let Some(name) = symbol.name().ok().filter(|name| name.starts_with('{')) else {
                continue;
            };
            let data = section.data_range(symbol.address(), 16).ok().flatten();
            table
                .put(name, symbol.address(), data, places.remove(name))
                .ok_or_else(|| ElfError::Symbol {
                    name: name.to_owned(),
                })?;
        }
        for flags in table.flags.values_mut() {
            flags.sort_by_key(|(number, ..)| *number);
        }
        Ok(table)
    }

    /// A table of these messages and parts, numbered from 1.
    #[cfg(test)]
    pub(super) fn of_texts(encoding: Encoding, texts: &[(bool, &str)]) -> Self {
        let entry = |(message, text): &(bool, &str)| Entry {
            level: message.then_some(Some(Level::Info)),
            text: (*text).to_owned(),
            place: None,
        };
        Self {
            encoding,
            entries: (1..).zip(texts.iter().map(entry)).collect(),
            timestamp: None,
            flags: HashMap::new(),
        }
    }

    fn put(
        &mut self,
        name: &str,
        address: u64,
        data: Option<&[u8]>,
        place: Option<String>,
    ) -> Option<()> {
        let symbol: Symbol = serde_json::from_str(name).ok()?;
        let level = match symbol.tag.as_str() {
            "defmt_timestamp" => {
                self.timestamp = Some(symbol.data);
                return Some(());
            }
            "defmt_bitflags_value" => {
                let [flags, number, name] = symbol.data.split("::").collect::<Vec<_>>()[..] else {
                    return None;
                };
                let value = u128::from_le_bytes(data?.try_into().ok()?);
                let whose = (
                    flags.to_owned(),
                    symbol.package,
                    symbol.disambiguator,
                    symbol.crate_name,
                );
                let flag = (number.parse().ok()?, name.to_owned(), value);
                self.flags.entry(whose).or_default().push(flag);
                return Some(());
            }
            "defmt_println" => Some(None),
            "defmt_trace" => Some(Some(Level::Trace)),
            "defmt_debug" => Some(Some(Level::Debug)),
            "defmt_info" => Some(Some(Level::Info)),
            "defmt_warn" => Some(Some(Level::Warn)),
            "defmt_error" => Some(Some(Level::Error)),
            tag if tag.starts_with("defmt_") => None,
            // From another tool.
            _ => return Some(()),
        };
        let entry = Entry {
            level,
            text: symbol.data,
            place,
        };
        self.entries.insert(u16::try_from(address).ok()?, entry);
        Some(())
    }

    pub(super) fn entry(&self, number: u16) -> Option<&Entry> {
        self.entries.get(&number)
    }

    /// The format string of timestamps, if the log has any.
    pub(super) fn timestamp(&self) -> Option<&str> {
        self.timestamp.as_deref()
    }

    /// A format string that is part of a message.
    pub(super) fn part(&self, number: u16) -> Option<&str> {
        let entry = self.entries.get(&number)?;
        entry.level.is_none().then_some(entry.text.as_str())
    }

    /// The names and values of a set of flags.
    pub(super) fn flags(&self, name: &FlagsName) -> Option<impl Iterator<Item = (&str, u128)>> {
        let flags = self.flags.get(name)?;
        Some(flags.iter().map(|(_, name, value)| (name.as_str(), *value)))
    }
}

/// The source position of each log statement, by symbol name, from the debug information.
fn places(elf: &object::File<'_>) -> Option<HashMap<String, String>> {
    let endian = match elf.is_little_endian() {
        true => RunTimeEndian::Little,
        false => RunTimeEndian::Big,
    };
    let load = |id: SectionId| {
        let section = elf.section_by_name(id.name());
        let data = section.and_then(|section| section.data().ok());
        Ok::<_, gimli::Error>(EndianSlice::new(data.unwrap_or_default(), endian))
    };
    let dwarf = gimli::Dwarf::load(load).ok()?;
    let mut places = HashMap::new();
    let mut units = dwarf.units();
    while let Some(header) = units.next().ok()? {
        let unit = dwarf.unit(header).ok()?;
        let mut entries = unit.entries();
        while let Some(entry) = entries.next_dfs().ok()? {
            if entry.tag() != gimli::DW_TAG_variable {
                continue;
            }
            let text = |name| {
                let value = entry.attr_value(name)?;
                let text = dwarf.attr_string(&unit, value).ok()?;
                Some(text.to_string_lossy().into_owned())
            };
            if text(gimli::DW_AT_name).as_deref() != Some("DEFMT_LOG_STATEMENT") {
                continue;
            }
            let file = match entry.attr_value(gimli::DW_AT_decl_file) {
                Some(gimli::AttributeValue::FileIndex(index)) => Some(index),
                Some(value) => value.udata_value(),
                None => None,
            };
            let file = file.and_then(|index| path(&dwarf, &unit, index));
            let line = entry.attr_value(gimli::DW_AT_decl_line);
            let line = line.and_then(|line| line.udata_value());
            if let (Some(symbol), Some(file), Some(line)) =
                (text(gimli::DW_AT_linkage_name), file, line)
            {
                places.insert(symbol, format!("{file}:{line}"));
            }
        }
    }
    Some(places)
}

type Slice<'a> = EndianSlice<'a, RunTimeEndian>;

/// The path of a source file as passed to the compiler.
fn path(
    dwarf: &gimli::Dwarf<Slice<'_>>,
    unit: &gimli::Unit<Slice<'_>>,
    index: u64,
) -> Option<String> {
    let header = unit.line_program.as_ref()?.header();
    let file = header.file(index)?;
    let text = |value| {
        let text = dwarf.attr_string(unit, value).ok()?;
        Some(text.to_string_lossy().into_owned())
    };
    let name = text(file.path_name())?;
    // The directory of the unit would reveal where it was built.
    let directory = file
        .directory(header)
        .filter(|_| file.directory_index() != 0);
    Some(match directory.and_then(text) {
        Some(directory) => format!("{directory}/{name}"),
        None => name,
    })
}
