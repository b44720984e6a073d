//! `cargo xtask size`: what the standard image takes on each target, against the committed record.

use std::fmt::Write as _;
use std::fs;

use crate::Dirs;
use crate::cmd::Outcome;
use crate::cross::{self, Core, TARGETS};
use crate::image::{self, Image};

/// The record: for each target, bytes of flash and of static RAM, as the named compiler made them.
const RECORD: &str = "proof/sizes.txt";

const IMAGE: &str = "standard";

/// Deviation that goes unmentioned, in percent: a change of this size is no one's doing.
const TOLERANCE: u64 = 2;

/// The same when another version of the compiler is in use than the record was made with.
const TOLERANCE_ELSEWHERE: u64 = 10;

/// How many symbols are listed.
const LISTED: usize = 10;

/// Within these, README.md shows the record.
const README_MARKS: (&str, &str) = ("<!-- sizes -->", "<!-- /sizes -->");

const ACCEPT: &str = "cargo xtask size --accept";

pub(crate) fn run(dirs: &Dirs, args: &[String]) -> Outcome {
    match args {
        [] => check(dirs),
        [word] if word == "--accept" => accept(dirs),
        _ => Err(format!(
            "`cargo xtask size` takes nothing, or `--accept`; not `{}`",
            args.join(" ")
        )),
    }
}

/// Compares with the record and with README.md.
pub(crate) fn check(dirs: &Dirs) -> Outcome {
    let measured = measure(dirs)?;
    let text = fs::read_to_string(RECORD)
        .map_err(|error| format!("cannot read {RECORD} ({error}); to make it: {ACCEPT}"))?;
    let record = Record::parse(&text)?;
    println!("{}", record.compare(&measured)?);
    let readme = fs::read_to_string("README.md")
        .map_err(|error| format!("cannot read README.md: {error}"))?;
    check_readme(&readme, &record.table())
}

fn accept(dirs: &Dirs) -> Outcome {
    let measured = measure(dirs)?;
    fs::write(RECORD, measured.to_string())
        .map_err(|error| format!("cannot write {RECORD}: {error}"))?;
    println!(
        "{RECORD} now holds these sizes. Between {} and {}, README.md has to hold:\n\n{}",
        README_MARKS.0,
        README_MARKS.1,
        measured.table()
    );
    Ok(())
}

/// Builds the image for every target.
fn measure(dirs: &Dirs) -> Outcome<Record> {
    image::check_lock(image::MANIFEST)?;
    cross::add_all();
    let mut record = Record {
        compiler: String::new(),
        sizes: Vec::new(),
    };
    for target in TARGETS {
        let core = Core::provide(target)?;
        record.compiler = core.compiler()?;
        let (build, path) = image::build(dirs, &core, target, IMAGE, "")?;
        build.run()?;
        let image = Image::read(&path)?;
        println!("{}", breakdown(target, &image));
        refuse_formatting(&image)?;
        record.sizes.push(Size {
            target: target.to_owned(),
            flash: image.flash,
            ram: image.ram,
        });
    }
    Ok(record)
}

/// The largest symbols.
fn breakdown(target: &str, image: &Image) -> String {
    let Image { flash, ram, .. } = image;
    let mut text = format!("\n{target}: {flash} bytes of flash, {ram} of static RAM\n");
    let mut rest = *flash;
    for symbol in image.symbols.iter().take(LISTED) {
        let _ = writeln!(text, "{:>8}  {}", symbol.size, symbol.name);
        rest = rest.saturating_sub(symbol.size);
    }
    let _ = writeln!(
        text,
        "{rest:>8}  all else, constants without a name included"
    );
    text
}

/// The formatting of the standard library costs more than everything it would be used for.
fn refuse_formatting(image: &Image) -> Outcome {
    let found: Vec<String> = image
        .symbols
        .iter()
        .filter(|symbol| symbol.name.contains("core::fmt"))
        .map(|symbol| format!("{:>8}  {}", symbol.size, symbol.name))
        .collect();
    if found.is_empty() {
        return Ok(());
    }
    Err(format!(
        "the image formats text with `core::fmt`; numbers go through `ztl_core::sink`:\n{}",
        found.join("\n")
    ))
}

/// What was measured, with which compiler.
#[derive(Debug, PartialEq, Eq)]
struct Record {
    compiler: String,
    sizes: Vec<Size>,
}

#[derive(Debug, PartialEq, Eq)]
struct Size {
    target: String,
    flash: u64,
    ram: u64,
}

impl Record {
    fn parse(text: &str) -> Outcome<Self> {
        let mut record = Self {
            compiler: String::new(),
            sizes: Vec::new(),
        };
        for line in text.lines().filter(|line| !line.starts_with('#')) {
            let words: Vec<&str> = line.split_whitespace().collect();
            match (line.strip_prefix("compiler "), words.as_slice()) {
                (Some(compiler), _) => record.compiler = compiler.to_owned(),
                (None, [target, flash, ram]) => record.sizes.push(Size {
                    target: (*target).to_owned(),
                    flash: flash.parse().map_err(|_| bad_line(line))?,
                    ram: ram.parse().map_err(|_| bad_line(line))?,
                }),
                _ => return Err(bad_line(line)),
            }
        }
        Ok(record)
    }

    /// A line for each target.
    ///
    /// # Errors
    /// Names each target whose size is not that of the record, and says how to accept it.
    fn compare(&self, measured: &Self) -> Outcome<String> {
        let same_compiler = self.compiler == measured.compiler;
        let tolerance = if same_compiler {
            TOLERANCE
        } else {
            TOLERANCE_ELSEWHERE
        };
        let mut text = String::new();
        if !same_compiler {
            let _ = writeln!(
                text,
                "The record was made with {}, this is {}: {tolerance} % are tolerated.",
                self.compiler, measured.compiler
            );
        }
        let mut deviates = false;
        for size in &measured.sizes {
            let target = &size.target;
            let Some(known) = self.sizes.iter().find(|known| known.target == *target) else {
                return Err(format!("{RECORD} lacks {target}; to add it: {ACCEPT}"));
            };
            for (what, known, now) in [
                ("flash", known.flash, size.flash),
                ("static RAM", known.ram, size.ram),
            ] {
                let beyond = known.abs_diff(now) * 100 > known * tolerance;
                deviates |= beyond;
                let verdict = if beyond { "  BEYOND" } else { "" };
                let _ = writeln!(text, "{target}: {what} {now}, record {known}{verdict}");
            }
        }
        if deviates {
            return Err(format!(
                "the standard image deviates from {RECORD} by more than {tolerance} %:\n{text}\
                 If that is as it should be: {ACCEPT}"
            ));
        }
        Ok(text)
    }

    /// The table for README.md.
    fn table(&self) -> String {
        let mut text = "| target | flash | static RAM |\n|---|---|---|".to_owned();
        for Size { target, flash, ram } in &self.sizes {
            let _ = write!(text, "\n| `{target}` | {flash} bytes | {ram} bytes |");
        }
        text
    }
}

/// The record's file.
impl std::fmt::Display for Record {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        writeln!(
            f,
            "# What proof/src/bin/standard.rs takes: target, bytes of flash, bytes of static RAM."
        )?;
        writeln!(f, "# `cargo xtask size` compares; `{ACCEPT}` rewrites.")?;
        writeln!(f, "compiler {}", self.compiler)?;
        for Size { target, flash, ram } in &self.sizes {
            writeln!(f, "{target} {flash} {ram}")?;
        }
        Ok(())
    }
}

fn bad_line(line: &str) -> String {
    format!("{RECORD} has a line that is no size: `{line}`; to write it anew: {ACCEPT}")
}

/// Whether the marked part of the README, if it has one, is the record's table.
fn check_readme(readme: &str, table: &str) -> Outcome {
    let (begin, end) = README_MARKS;
    let Some((_, rest)) = readme.split_once(begin) else {
        return Ok(());
    };
    let (shown, _) = rest
        .split_once(end)
        .ok_or_else(|| format!("README.md has {begin} and no {end} after it"))?;
    if shown.trim() == table {
        return Ok(());
    }
    Err(format!(
        "README.md shows other sizes than {RECORD}; between {begin} and {end} there has to be:\n\n\
         {table}\n"
    ))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::Symbol;

    fn record(compiler: &str, flash: u64, ram: u64) -> Record {
        Record {
            compiler: compiler.to_owned(),
            sizes: vec![Size {
                target: "thumbv6m-none-eabi".to_owned(),
                flash,
                ram,
            }],
        }
    }

    #[test]
    fn a_record_comes_back_from_its_file() {
        let record = record("rustc 1.95.0 (59807616e 2026-04-14)", 6000, 900);
        assert_eq!(Record::parse(&record.to_string()).unwrap(), record);
        let message = Record::parse("thumbv6m-none-eabi 6000").unwrap_err();
        assert!(message.contains("--accept"), "{message}");
    }

    #[test]
    fn two_percent_pass_and_more_does_not_either_way() {
        let known = record("a", 5000, 1000);
        for (flash, ram, passes) in [
            (5000, 1000, true),
            (5100, 980, true),
            (5101, 1000, false),
            (4899, 1000, false),
            (5000, 1021, false),
        ] {
            let result = known.compare(&record("a", flash, ram));
            assert_eq!(result.is_ok(), passes, "{flash} {ram}");
        }
        let message = known.compare(&record("a", 6000, 1000)).unwrap_err();
        assert!(
            message.contains("flash 6000, record 5000  BEYOND"),
            "{message}"
        );
        assert!(message.contains(ACCEPT), "{message}");
    }

    #[test]
    fn another_compiler_may_deviate_more() {
        let known = record("a", 5000, 1000);
        let text = known.compare(&record("b", 5400, 1000)).unwrap();
        assert!(text.contains("made with a, this is b"), "{text}");
        assert!(known.compare(&record("b", 5501, 1000)).is_err());
    }

    #[test]
    fn formatting_is_refused_by_the_symbols_it_leaves() {
        let image = |name: &str| Image {
            flash: 100,
            ram: 0,
            symbols: vec![Symbol {
                name: image::demangled(name),
                size: 10,
            }],
        };
        assert!(
            refuse_formatting(&image("_ZN8ztl_core4sink9put_fixed17he42edfd832160e44E")).is_ok()
        );
        for name in [
            "_ZN4core3fmt9Formatter3pad17h0123456789abcdefE",
            "_RNvNtCseold96UKqg_4core3fmt5write",
        ] {
            assert!(refuse_formatting(&image(name)).is_err(), "{name}");
        }
    }

    #[test]
    fn the_readme_shows_the_record_or_nothing() {
        let table = record("a", 5000, 1000).table();
        let marked = |inner: &str| format!("# T\n<!-- sizes -->\n{inner}\n<!-- /sizes -->\nmore");
        assert!(check_readme("# T\n", &table).is_ok());
        assert!(check_readme(&marked(&table), &table).is_ok());
        assert!(check_readme(&marked("| old |"), &table).is_err());
        assert!(check_readme("<!-- sizes -->", &table).is_err());
    }
}
