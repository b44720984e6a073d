//! `cargo xtask size`: compares the size of images with committed records: the standard image on each target,
//! and the firmware of each board.

use std::fmt::Write as _;

use anyhow::{Context as _, Result, ensure};
use xshell::Shell;

use crate::cross::{self, Core, TARGETS};
use crate::image::{self, Image, Symbol};
use crate::project::{Project, marked};
use crate::{firmware, lock};

/// The files that record and show sizes.
struct SizeFiles {
    /// Image, bytes of flash and of static RAM, with the compiler used.
    record: &'static str,
    /// The README that shows the record, between marks.
    readme: &'static str,
    /// Heading of the image column in the README.
    column: &'static str,
    /// What is measured.
    about: &'static str,
}

const STANDARD: SizeFiles = SizeFiles {
    record: "proof/sizes.txt",
    readme: "README.md",
    column: "target",
    about: "What proof/src/bin/standard.rs takes: target",
};

const FIRMWARE: SizeFiles = SizeFiles {
    record: "examples/firmware/sizes.txt",
    readme: "examples/firmware/README.md",
    column: "image",
    about: "What the images of examples/firmware take: image",
};

/// Deviation that is accepted, in percent: such changes have no particular cause.
const TOLERANCE: u64 = 2;

/// The same if the compiler version differs from that of the record.
const TOLERANCE_ELSEWHERE: u64 = 10;

/// Compares with the records and the READMEs.
pub(crate) fn check(project: &Project) -> Result<()> {
    let compare = |files: &SizeFiles, measured: &Record| -> Result<()> {
        let SizeFiles { record, readme, .. } = files;
        let known = Record::parse(&project.sh.read_file(record)?).context(*record)?;
        let text = project.sh.read_file(readme)?;
        let shown = shown(&text, &known.table(files.column)).context(*readme)?;
        ensure!(shown == text, "{readme} shows other sizes than {record}");
        println!("{}", known.compare(measured).context(*record)?);
        Ok(())
    };
    let accept = "run `cargo xtask size --accept` to record the sizes";
    compare(&STANDARD, &measure(project)?).context(accept)?;
    compare(&FIRMWARE, &measure_firmware(project)?).context(accept)
}

/// Rewrites the records and the READMEs.
pub(crate) fn accept(project: &Project) -> Result<()> {
    measure(project)?.write(&project.sh, &STANDARD)?;
    measure_firmware(project)?.write(&project.sh, &FIRMWARE)
}

/// Builds the image for every target.
fn measure(project: &Project) -> Result<Record> {
    lock::check(&project.sh, image::MANIFEST)?;
    cross::add(&project.sh, &TARGETS);
    let mut record = Record::default();
    for target in TARGETS {
        let core = Core::provide(&project.sh, target)?;
        record.compiler = core.compiler(&project.sh)?;
        let (build, path) = image::build(project, &core, target, "standard", "")?;
        build.run()?;
        let image = Image::read(&path)?;
        println!("{}", breakdown(target, &image));
        refuse_formatting(&image)?;
        record.add(target, &image);
    }
    Ok(record)
}

/// Builds the images of every board.
fn measure_firmware(project: &Project) -> Result<Record> {
    let mut record = Record::default();
    for board in firmware::boards(&project.sh)? {
        record.compiler = Core::provide(&project.sh, &board.target)?.compiler(&project.sh)?;
        for path in firmware::build(project, &board)? {
            let image = Image::read(&path)?;
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            if !firmware::has_foreign_code(&name) {
                let allowed = match firmware::is_async(&name) {
                    true => RESUMED,
                    false => &[],
                };
                let refused =
                    refuse_formatting(&image).and_then(|()| refuse_panics(&image, allowed));
                refused.with_context(|| name.to_string())?;
            }
            record.add(&name, &image);
        }
    }
    Ok(record)
}

/// The largest symbols.
fn breakdown(target: &str, image: &Image) -> String {
    let (mut rest, ram) = (image.flash, image.ram);
    let mut text = format!("\n{target}: {rest} bytes of flash, {ram} of static RAM\n");
    for Symbol { name, size } in image.symbols.iter().take(10) {
        text += &format!("{size:>8}  {name}\n");
        rest = rest.saturating_sub(*size);
    }
    text + &format!("{rest:>8}  everything else, including unnamed constants\n")
}

/// The standard library's formatting costs more flash than all its uses together.
fn refuse_formatting(image: &Image) -> Result<()> {
    let help = "the image formats text with `core::fmt`; numbers go through `ztl_core::sink`";
    refuse(image, &["core::fmt"], &[]).context(help)
}

/// The only panic of an image with async functions: each has one in case that it is polled after its end, which no
/// executor does.
const RESUMED: &[&str] = &[
    "panic_const_async_fn_resumed",
    "core::panicking::panic_fmt",
    "rust_begin_unwind",
];

/// Panicking code calls one of these, so an image without them has no reachable panic but the allowed ones.
fn refuse_panics(image: &Image, allowed: &[&str]) -> Result<()> {
    let parts = ["core::panicking", "rust_begin_unwind"];
    refuse(image, &parts, allowed).context("a panic is reachable")
}

/// # Errors
/// Lists the symbols whose names contain one of `parts` and none of `allowed`.
fn refuse(image: &Image, parts: &[&str], allowed: &[&str]) -> Result<()> {
    let names = image.symbols.iter().map(|symbol| symbol.name.as_str());
    let is_one = |name: &str, parts: &[&str]| parts.iter().any(|part| name.contains(part));
    let refused = names.filter(|name| is_one(name, parts) && !is_one(name, allowed));
    let found: Vec<&str> = refused.collect();
    ensure!(found.is_empty(), "the image contains {}", found.join(", "));
    Ok(())
}

/// Measured sizes, and the compiler used.
#[derive(Debug, Default, PartialEq, Eq)]
struct Record {
    compiler: String,
    /// Name, flash and RAM of each image.
    sizes: Vec<(String, [u64; 2])>,
}

impl Record {
    fn add(&mut self, name: &str, image: &Image) {
        self.sizes.push((name.to_owned(), [image.flash, image.ram]));
    }

    fn write(&self, sh: &Shell, files: &SizeFiles) -> Result<()> {
        let readme = shown(&sh.read_file(files.readme)?, &self.table(files.column));
        sh.write_file(files.readme, readme.context(files.readme)?)?;
        sh.write_file(files.record, self.file(files.about))?;
        println!("{} and {} are rewritten", files.record, files.readme);
        Ok(())
    }

    /// Parses a record's file.
    fn parse(text: &str) -> Result<Self> {
        let mut record = Self::default();
        for line in text.lines().filter(|line| !line.starts_with('#')) {
            let size = || {
                let (image, sizes) = line.split_once(' ')?;
                let (flash, ram) = sizes.split_once(' ')?;
                Some((image.to_owned(), [flash.parse().ok()?, ram.parse().ok()?]))
            };
            let size = || size().with_context(|| format!("invalid line `{line}`"));
            match line.strip_prefix("compiler ") {
                Some(compiler) => record.compiler = compiler.to_owned(),
                None => record.sizes.push(size()?),
            }
        }
        Ok(record)
    }

    /// One line per image.
    ///
    /// # Errors
    /// If the size of an image differs from the record.
    fn compare(&self, measured: &Self) -> Result<String> {
        let mut text = String::new();
        let tolerance = match self.compiler == measured.compiler {
            true => TOLERANCE,
            false => {
                let (record, this) = (&self.compiler, &measured.compiler);
                let _ = writeln!(text, "The record is of {record}, this is {this}.");
                TOLERANCE_ELSEWHERE
            }
        };
        let mut deviates = false;
        for (image, sizes) in &measured.sizes {
            let known = self.sizes.iter().find(|(known, _)| known == image);
            let (_, known) = known.with_context(|| format!("{image} is missing"))?;
            let whats = ["flash", "static RAM"].iter();
            for (what, (known, now)) in whats.zip(known.iter().zip(sizes)) {
                let beyond = known.abs_diff(*now) * 100 > known * tolerance;
                deviates |= beyond;
                let verdict = if beyond { "  BEYOND" } else { "" };
                let _ = writeln!(text, "{image}: {what} {now}, record {known}{verdict}");
            }
        }
        ensure!(
            !deviates,
            "an image deviates by more than {tolerance} %:\n{text}"
        );
        Ok(text)
    }

    /// The table for a README.
    fn table(&self, column: &str) -> String {
        let row = |(image, [flash, ram]): &(String, [u64; 2])| {
            format!("\n| `{image}` | {flash} bytes | {ram} bytes |")
        };
        let rows: String = self.sizes.iter().map(row).collect();
        format!("| {column} | flash | static RAM |\n|---|---|---|{rows}")
    }

    /// The content of a record's file.
    fn file(&self, about: &str) -> String {
        let row = |(image, [flash, ram]): &(String, [u64; 2])| format!("{image} {flash} {ram}\n");
        let rows: String = self.sizes.iter().map(row).collect();
        format!(
            "# {about}, bytes of flash, bytes of static RAM.\n\
             # `cargo xtask size` compares; `cargo xtask size --accept` rewrites.\n\
             compiler {}\n{rows}",
            self.compiler
        )
    }
}

/// The README with this table between its marks.
fn shown(readme: &str, table: &str) -> Result<String> {
    let marked = marked(readme, "sizes").context("no <!-- sizes --> followed by <!-- /sizes -->");
    let [before, _, after] = marked?;
    Ok(format!(
        "{before}<!-- sizes -->\n{table}\n<!-- /sizes -->{after}"
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[rustfmt::skip]
    fn record(compiler: &str, flash: u64, ram: u64) -> Record {
        let sizes = vec![("thumbv6m-none-eabi".to_owned(), [flash, ram])];
        Record { compiler: compiler.to_owned(), sizes }
    }

    #[test]
    fn a_record_round_trips_through_its_file() {
        let record = record("rustc 1.95.0 (59807616e 2026-04-14)", 6000, 900);
        assert_eq!(Record::parse(&record.file("x")).unwrap(), record);
        let error = Record::parse("thumbv6m-none-eabi 6000").unwrap_err();
        assert_eq!(error.to_string(), "invalid line `thumbv6m-none-eabi 6000`");
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
        let error = known.compare(&record("a", 6000, 1000)).unwrap_err();
        let beyond = "flash 6000, record 5000  BEYOND";
        assert!(error.to_string().contains(beyond), "{error}");
    }

    #[test]
    fn another_compiler_may_deviate_more() {
        let known = record("a", 5000, 1000);
        let text = known.compare(&record("b", 5400, 1000)).unwrap();
        assert!(text.contains("record is of a, this is b"), "{text}");
        assert!(known.compare(&record("b", 5501, 1000)).is_err());
    }

    #[test]
    fn formatting_and_panics_are_detected_by_their_symbols() {
        let image = |name: &str| {
            let (name, size) = (image::demangled(name), 10);
            Image {
                symbols: vec![Symbol { name, size }],
                ..Image::default()
            }
        };
        let fine = image("_ZN8ztl_core4sink9put_fixed17he42edfd832160e44E");
        assert!(refuse_formatting(&fine).is_ok());
        for name in [
            "_ZN4core3fmt9Formatter3pad17h0123456789abcdefE",
            "_RNvNtCseold96UKqg_4core3fmt5write",
        ] {
            assert!(refuse_formatting(&image(name)).is_err(), "{name}");
        }
        let panics = image("_RNvNtCseold96UKqg_4core9panicking5panic");
        for allowed in [&[], RESUMED] {
            assert!(refuse_panics(&panics, allowed).is_err());
        }
        assert!(refuse_formatting(&panics).is_ok());
        let resumed = image(
            "_ZN4core9panicking11panic_const28panic_const_async_fn_resumed17he42edfd832160e44E",
        );
        assert!(refuse_panics(&resumed, RESUMED).is_ok());
        assert!(refuse_panics(&resumed, &[]).is_err());
    }

    #[test]
    fn the_readme_shows_the_record() {
        let table = record("a", 5000, 1000).table("target");
        let marked = |inner: &str| format!("# T\n<!-- sizes -->\n{inner}\n<!-- /sizes -->\nmore");
        let readme = marked(&table);
        assert_eq!(shown(&readme, &table).unwrap(), readme);
        assert_eq!(shown(&marked("| old |"), &table).unwrap(), readme);
        for without in ["# T\n", "<!-- sizes -->", "<!-- /sizes --><!-- sizes -->"] {
            assert!(shown(without, &table).is_err(), "{without}");
        }
    }
}
