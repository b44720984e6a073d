//! `ztl report`: turns records of runs into a page and tables, and a recording into a page.

use std::fs::File;
use std::io::{BufReader, Read as _};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use ztl_script::record::{self, Damage, Record};
use ztl_script::report;

use crate::exit::Done;
use crate::terminal::{error_line, line};

/// Longest record of a run that goes on, in bytes: it is held as a whole. And longest recording, which only takes time.
#[cfg(feature = "web")]
const LONGEST_LINES: u64 = 64 << 20;
#[cfg(feature = "web")]
const LONGEST_RECORDING: u64 = 1 << 30;

#[derive(Debug, clap::Args)]
pub(crate) struct Report {
    /// Records and recordings written by `ztl run-script --record`; several are compared. Or one recording of `ztl record`
    #[arg(required = true, value_name = "RUN.jsonl|FILE.mcap")]
    records: Vec<PathBuf>,

    /// The page to write [default: RUN.html beside the record, or report.html for several]
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,

    /// Also write tables beside the page: FILE.tasks.csv (one line per task) and FILE.operator.csv (one line per
    /// action of the operator)
    #[arg(long)]
    csv: bool,
}

impl Report {
    pub(crate) fn run(self) -> Done {
        let mut records = Vec::new();
        let mut damage = Vec::new();
        let mut drawings = Drawings::default();
        for path in &self.records {
            let (runs, found) = match is_recording(path) {
                false => read(path, false)?,
                true => match drawings.read(path, records.len(), false)? {
                    Recorded::Run(runs, damage) => (runs, damage),
                    Recorded::Streams(html, damage) => {
                        return self.of_streams(path, &html, &damage);
                    }
                },
            };
            records.extend(runs);
            damage.extend(found);
        }
        tell(&damage);
        if records.is_empty() {
            return Err("no run in these records, so there is nothing to report".into());
        }
        let page = self.page();
        let mut files = vec![page.clone()];
        if self.csv {
            files.extend([
                page.with_extension("tasks.csv"),
                page.with_extension("operator.csv"),
            ]);
        }
        let report = of(records, damage, drawings);
        let texts = [
            report::Report::html as fn(&report::Report) -> String,
            report::Report::tasks_csv,
            report::Report::actions_csv,
        ];
        for file in &files {
            self.check_name(file)?;
        }
        for (file, text) in files.iter().zip(texts) {
            write(file, &text(&report))?;
        }
        Ok(ExitCode::SUCCESS)
    }

    /// Writes the page of a recording without a run.
    fn of_streams(&self, path: &Path, html: &str, damage: &[Damage]) -> Done {
        if self.records.len() > 1 || self.csv {
            let path = path.display();
            let mistake = format!("{path} has no run, so it is reported alone, without --csv");
            return Err(crate::exit::Misuse(mistake).into());
        }
        let page = self.page();
        self.check_name(&page)?;
        tell(damage);
        write(&page, html)?;
        Ok(ExitCode::SUCCESS)
    }

    /// Never overwrites the only copy of a record.
    fn check_name(&self, file: &Path) -> Result<(), String> {
        match self.records.iter().any(|record| same(record, file)) {
            true => {
                let file = file.display();
                Err(format!("{file} is a record; give the report another name"))
            }
            false => Ok(()),
        }
    }

    fn page(&self) -> PathBuf {
        match (&self.output, self.records.as_slice()) {
            (Some(output), _) => output.clone(),
            (None, [record]) => record.with_extension("html"),
            (None, _) => PathBuf::from("report.html"),
        }
    }
}

/// The report of a run that still goes on, as an HTML page.
///
/// # Errors
/// Why the report cannot be made.
#[cfg(feature = "web")]
pub(crate) fn of_running(path: &Path) -> Result<String, String> {
    let is_recording = is_recording(path);
    let longest = match is_recording {
        false => LONGEST_LINES,
        true => LONGEST_RECORDING,
    };
    let length = std::fs::metadata(path).map_err(|error| error.to_string())?;
    if length.len() > longest {
        let most = longest >> 20;
        return Err(format!(
            "the record has more than {most} MiB: download it, and use `ztl report`"
        ));
    }
    let mut drawings = Drawings::default();
    let (records, damage) = match is_recording {
        false => read(path, true)?,
        true => match drawings.read(path, 0, true)? {
            Recorded::Run(runs, damage) => (runs, damage),
            Recorded::Streams(html, _) => return Ok(html),
        },
    };
    Ok(of(records, damage, drawings).html())
}

/// The report of these records.
fn of(records: Vec<Record>, damage: Vec<Damage>, drawings: Drawings) -> report::Report {
    let drawings = drawings.below_overviews(&records);
    let mut report = report::Report::new(records, damage);
    for (run, html) in drawings {
        report.add_drawing(run, &html);
    }
    report
}

/// What a recording has.
#[cfg_attr(
    not(feature = "record"),
    expect(dead_code, reason = "this build has no recordings")
)]
enum Recorded {
    Run(Vec<Record>, Vec<Damage>),
    /// The page of one without a run.
    Streams(String, Vec<Damage>),
}

/// What is drawn of recordings, each with the index of its first run among all.
#[cfg(feature = "record")]
#[derive(Default)]
struct Drawings(Vec<(usize, ztl_record::Drawn)>);

#[cfg(feature = "record")]
impl Drawings {
    fn read(&mut self, path: &Path, index: usize, goes_on: bool) -> Result<Recorded, String> {
        let name = path.display().to_string();
        let drawn = ztl_record::Drawn::read(path);
        let mut drawn = drawn.map_err(|error| format!("cannot report {name}: {error}"))?;
        if goes_on {
            drawn.damage.end = None;
        }
        let mut damage = Vec::new();
        if drawn.damage.is_any() {
            damage.push(Damage {
                file: name.clone(),
                line: None,
                text: format!("the recording {}", drawn.damage),
            });
        }
        if drawn.run().is_empty() {
            return Ok(Recorded::Streams(drawn.page(), damage));
        }
        let read = match goes_on {
            true => record::read_so_far(&name, drawn.run()),
            false => record::read(&name, drawn.run()),
        };
        let (runs, found) = read.map_err(|error| format!("cannot read {name}: {error}"))?;
        damage.extend(found);
        if !runs.is_empty() {
            self.0.push((index, drawn));
        }
        Ok(Recorded::Run(runs, damage))
    }

    /// Streams above the tasks, by the index of the run.
    fn below_overviews(self, records: &[Record]) -> Vec<(usize, String)> {
        let drawings = self.0.into_iter().filter_map(|(index, mut drawn)| {
            let html = drawn.below_overview(records.get(index)?, index);
            Some((index, html))
        });
        drawings.collect()
    }
}

#[cfg(not(feature = "record"))]
#[derive(Default)]
struct Drawings {}

#[cfg(not(feature = "record"))]
impl Drawings {
    fn read(&mut self, path: &Path, _: usize, _: bool) -> Result<Recorded, String> {
        let path = path.display();
        Err(format!(
            "{path} is a recording, which this build cannot read (docs/dist.md)"
        ))
    }

    fn below_overviews(self, _: &[Record]) -> Vec<(usize, String)> {
        Vec::new()
    }
}

fn tell(damage: &[Damage]) {
    for damage in damage {
        error_line(format_args!("ztl: {damage}"));
    }
}

fn write(file: &Path, text: &str) -> Result<(), String> {
    let written = std::fs::write(file, text);
    written.map_err(|error| format!("cannot write {}: {error}", file.display()))?;
    line(format_args!("Written: {}", file.display()));
    Ok(())
}

/// Whether a file is a recording: it begins as MCAP files do, or is called so.
fn is_recording(path: &Path) -> bool {
    let mut begin = [0; 8];
    let read = File::open(path).and_then(|mut file| file.read_exact(&mut begin));
    is_called_recording(path) || (read.is_ok() && begin == *b"\x89MCAP0\r\n")
}

/// Whether a file is called as a recording.
pub(crate) fn is_called_recording(path: &Path) -> bool {
    let extension = path.extension();
    extension.is_some_and(|extension| extension == "mcap")
}

fn read(path: &Path, goes_on: bool) -> Result<(Vec<Record>, Vec<Damage>), String> {
    let name = path.display().to_string();
    let file = File::open(path).map(BufReader::new);
    let file = file.and_then(|file| match goes_on {
        true => record::read_so_far(&name, file),
        false => record::read(&name, file),
    });
    file.map_err(|error| format!("cannot read {name}: {error}"))
}

/// Whether two paths name the same file.
fn same(one: &Path, other: &Path) -> bool {
    let real = |path: &Path| std::fs::canonicalize(path).unwrap_or_else(|_| path.to_owned());
    real(one) == real(other)
}

#[cfg(all(test, feature = "web"))]
mod tests {
    use super::*;

    #[test]
    fn a_record_that_takes_too_much_memory_is_not_read_while_the_run_goes_on() {
        let path = std::env::temp_dir().join(format!("ztl-report-{}.jsonl", std::process::id()));
        let file = File::create(&path).expect("a file");
        // It has a length, and takes no room.
        file.set_len(LONGEST_LINES + 1).expect("a length");
        let made = of_running(&path);
        std::fs::remove_file(&path).expect("it is there");
        let why = made.expect_err("it is too long");
        assert!(
            why.starts_with("the record has more than 64 MiB: download it"),
            "{why}"
        );
        assert!(of_running(&path).is_err(), "it is gone");
    }
}
