//! `cargo xtask size`: compares the size of images with committed records: the standard image on each target,
//! and the firmware of each board.

use std::fmt::Write as _;
use std::fs;

use crate::Dirs;
use crate::cmd::Outcome;
use crate::cross::{self, Core, TARGETS};
use crate::firmware;
use crate::image::{self, Image};

/// The files that record and show sizes.
struct SizeFiles {
    /// Image, bytes of flash and of static RAM, with the compiler used.
    record: &'static str,
    /// Its first line.
    about: &'static str,
    /// The README that shows the record, between marks.
    readme: &'static str,
    /// Heading of the image column in the README.
    column: &'static str,
}

impl SizeFiles {
    fn readme(&self) -> Outcome<String> {
        let path = self.readme;
        fs::read_to_string(path).map_err(|error| format!("cannot read {path}: {error}"))
    }
}

const STANDARD: SizeFiles = SizeFiles {
    record: "proof/sizes.txt",
    about: "What proof/src/bin/standard.rs takes: target, bytes of flash, bytes of static RAM.",
    readme: "README.md",
    column: "target",
};

const FIRMWARE: SizeFiles = SizeFiles {
    record: "examples/firmware/sizes.txt",
    about: "What the images of examples/firmware take: image, bytes of flash, bytes of static RAM.",
    readme: "examples/firmware/README.md",
    column: "image",
};

const IMAGE: &str = "standard";

/// Deviation that is accepted, in percent: such changes have no particular cause.
const TOLERANCE: u64 = 2;

/// The same if the compiler version differs from that of the record.
const TOLERANCE_ELSEWHERE: u64 = 10;

/// Number of symbols listed.
const LISTED: usize = 10;

/// Marks around the record in a README.
const README_MARKS: (&str, &str) = ("<!-- sizes -->", "<!-- /sizes -->");

const ACCEPT: &str = "cargo xtask size --accept";

pub(crate) fn run(dirs: &Dirs, args: &[String]) -> Outcome {
    match args {
        [] => check(dirs),
        [word] if word == "--accept" => accept(dirs),
        _ => Err(format!(
            "unknown argument `{}`: `cargo xtask size` takes only `--accept`",
            args.join(" ")
        )),
    }
}

/// Compares with the records and the READMEs.
pub(crate) fn check(dirs: &Dirs) -> Outcome {
    measure(dirs)?.check(&STANDARD)?;
    measure_firmware(dirs)?.check(&FIRMWARE)
}

fn accept(dirs: &Dirs) -> Outcome {
    measure(dirs)?.accept(&STANDARD)?;
    measure_firmware(dirs)?.accept(&FIRMWARE)
}

/// Builds the image for every target.
fn measure(dirs: &Dirs) -> Outcome<Record> {
    image::check_lock(image::MANIFEST)?;
    cross::add_all();
    let mut record = Record::default();
    for target in TARGETS {
        let core = Core::provide(target)?;
        record.compiler = core.compiler()?;
        let (build, path) = image::build(dirs, &core, target, IMAGE, "")?;
        build.run()?;
        let image = Image::read(&path)?;
        println!("{}", breakdown(target, &image));
        refuse_formatting(&image)?;
        record.add(target, &image);
    }
    Ok(record)
}

/// Builds the image of every board in QEMU. The size of the others depends on their HAL.
fn measure_firmware(dirs: &Dirs) -> Outcome<Record> {
    let mut record = Record::default();
    let boards = firmware::boards()?.into_iter();
    for board in boards.filter(|board| board.machine.is_some()) {
        record.compiler = Core::provide(&board.target)?.compiler()?;
        for path in firmware::build(dirs, &board)? {
            let image = Image::read(&path)?;
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            let refused = match firmware::has_foreign_code(&name) {
                true => Ok(()),
                false => refuse_formatting(&image).and_then(|()| refuse_panics(&image)),
            };
            refused.map_err(|error| format!("{name}: {error}"))?;
            record.add(&name, &image);
        }
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
        "{rest:>8}  everything else, including unnamed constants"
    );
    text
}

/// The standard library's formatting costs more flash than all its uses together.
fn refuse_formatting(image: &Image) -> Outcome {
    refuse(image, &["core::fmt"]).map_err(|found| {
        format!(
            "the image formats text with `core::fmt`; numbers go through `ztl_core::sink`:\n{found}"
        )
    })
}

/// Panicking code calls one of these, so an image without them has no reachable panic.
fn refuse_panics(image: &Image) -> Outcome {
    refuse(image, &["core::panicking", "rust_begin_unwind"])
        .map_err(|found| format!("a panic is reachable; the image contains:\n{found}"))
}

/// # Errors
/// Lists the symbols whose names contain one of `parts`.
fn refuse(image: &Image, parts: &[&str]) -> Outcome {
    let found: Vec<String> = image
        .symbols
        .iter()
        .filter(|symbol| parts.iter().any(|part| symbol.name.contains(part)))
        .map(|symbol| format!("{:>8}  {}", symbol.size, symbol.name))
        .collect();
    if found.is_empty() {
        return Ok(());
    }
    Err(found.join("\n"))
}

/// Measured sizes, and the compiler used.
#[derive(Debug, Default, PartialEq, Eq)]
struct Record {
    compiler: String,
    sizes: Vec<Size>,
}

#[derive(Debug, PartialEq, Eq)]
struct Size {
    image: String,
    flash: u64,
    ram: u64,
}

impl Record {
    fn add(&mut self, name: &str, image: &Image) {
        self.sizes.push(Size {
            image: name.to_owned(),
            flash: image.flash,
            ram: image.ram,
        });
    }

    /// Compares with the committed record and README.
    fn check(&self, files: &SizeFiles) -> Outcome {
        let path = files.record;
        let text = fs::read_to_string(path)
            .map_err(|error| format!("cannot read {path} ({error}); to create it: {ACCEPT}"))?;
        let known = Self::parse(&text).map_err(|line| {
            format!("{path} has an invalid line: `{line}`; to rewrite it: {ACCEPT}")
        })?;
        let compared = known.compare(self);
        println!("{}", compared.map_err(|error| format!("{path}: {error}"))?);
        let readme = files.readme()?;
        let table = known.table(files.column);
        if shown(&readme, &table).map_err(|error| format!("{}: {error}", files.readme))? == readme {
            return Ok(());
        }
        Err(format!(
            "{} shows other sizes than the record; to update it: {ACCEPT}",
            files.readme
        ))
    }

    fn accept(&self, files: &SizeFiles) -> Outcome {
        let readme = shown(&files.readme()?, &self.table(files.column))
            .map_err(|error| format!("{}: {error}", files.readme))?;
        for (path, text) in [
            (files.record, self.file(files.about)),
            (files.readme, readme),
        ] {
            fs::write(path, text).map_err(|error| format!("cannot write {path}: {error}"))?;
        }
        println!(
            "{} and {} now hold these sizes.",
            files.record, files.readme
        );
        Ok(())
    }

    /// Parses a record's file.
    ///
    /// # Errors
    /// Returns the invalid line.
    fn parse(text: &str) -> Outcome<Self> {
        let mut record = Self::default();
        for line in text.lines().filter(|line| !line.starts_with('#')) {
            let words: Vec<&str> = line.split_whitespace().collect();
            match (line.strip_prefix("compiler "), words.as_slice()) {
                (Some(compiler), _) => record.compiler = compiler.to_owned(),
                (None, [image, flash, ram]) => record.sizes.push(Size {
                    image: (*image).to_owned(),
                    flash: flash.parse().map_err(|_| line)?,
                    ram: ram.parse().map_err(|_| line)?,
                }),
                _ => return Err(line.to_owned()),
            }
        }
        Ok(record)
    }

    /// One line per image.
    ///
    /// # Errors
    /// Names each image whose size differs from the record, and how to accept it.
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
            let image = &size.image;
            let Some(known) = self.sizes.iter().find(|known| known.image == *image) else {
                return Err(format!("{image} is missing; to add it: {ACCEPT}"));
            };
            for (what, known, now) in [
                ("flash", known.flash, size.flash),
                ("static RAM", known.ram, size.ram),
            ] {
                let beyond = known.abs_diff(now) * 100 > known * tolerance;
                deviates |= beyond;
                let verdict = if beyond { "  BEYOND" } else { "" };
                let _ = writeln!(text, "{image}: {what} {now}, record {known}{verdict}");
            }
        }
        if deviates {
            return Err(format!(
                "an image deviates from it by more than {tolerance} %:\n{text}\
                 If that is as it should be: {ACCEPT}"
            ));
        }
        Ok(text)
    }

    /// The table for a README.
    fn table(&self, column: &str) -> String {
        let mut text = format!("| {column} | flash | static RAM |\n|---|---|---|");
        for Size { image, flash, ram } in &self.sizes {
            let _ = write!(text, "\n| `{image}` | {flash} bytes | {ram} bytes |");
        }
        text
    }

    /// The content of a record's file.
    fn file(&self, about: &str) -> String {
        let mut text = format!(
            "# {about}\n# `cargo xtask size` compares; `{ACCEPT}` rewrites.\ncompiler {}\n",
            self.compiler
        );
        for Size { image, flash, ram } in &self.sizes {
            let _ = writeln!(text, "{image} {flash} {ram}");
        }
        text
    }
}

/// The README with this table between its marks.
fn shown(readme: &str, table: &str) -> Outcome<String> {
    let (begin, end) = README_MARKS;
    let marked = readme.split_once(begin);
    let marked = marked.and_then(|(before, rest)| Some((before, rest.split_once(end)?.1)));
    let (before, behind) = marked.ok_or_else(|| format!("it has no {begin} followed by {end}"))?;
    Ok(format!("{before}{begin}\n{table}\n{end}{behind}"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::Symbol;

    fn record(compiler: &str, flash: u64, ram: u64) -> Record {
        Record {
            compiler: compiler.to_owned(),
            sizes: vec![Size {
                image: "thumbv6m-none-eabi".to_owned(),
                flash,
                ram,
            }],
        }
    }

    #[test]
    fn a_record_round_trips_through_its_file() {
        let record = record("rustc 1.95.0 (59807616e 2026-04-14)", 6000, 900);
        assert_eq!(Record::parse(&record.file("x")).unwrap(), record);
        let line = Record::parse("thumbv6m-none-eabi 6000").unwrap_err();
        assert_eq!(line, "thumbv6m-none-eabi 6000");
    }

    #[test]
    fn deviations_above_two_percent_fail_in_either_direction() {
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
    fn formatting_and_panics_are_detected_by_their_symbols() {
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
        let panics = image("_RNvNtCseold96UKqg_4core9panicking5panic");
        assert!(refuse_panics(&panics).is_err());
        assert!(refuse_formatting(&panics).is_ok());
    }

    #[test]
    fn the_readme_shows_the_record() {
        let table = record("a", 5000, 1000).table("target");
        let marked = |inner: &str| format!("# T\n<!-- sizes -->\n{inner}\n<!-- /sizes -->\nmore");
        let readme = marked(&table);
        assert_eq!(shown(&readme, &table).as_ref(), Ok(&readme));
        assert_eq!(shown(&marked("| old |"), &table).as_ref(), Ok(&readme));
        for without in ["# T\n", "<!-- sizes -->", "<!-- /sizes --><!-- sizes -->"] {
            assert!(shown(without, &table).is_err(), "{without}");
        }
    }
}
