//! `ztl report`: turns records of runs into a page and tables, and a recording into a page.

use std::fs::File;
use std::io::{BufReader, Read as _};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use ztl_script::record::{self, Damage, Record};
use ztl_script::report;

use crate::exit::Done;
use crate::terminal::{error_line, line};

#[derive(Debug, clap::Args)]
pub(crate) struct Report {
    /// Records written by `ztl run-script --record`; several are compared. Or one recording of `ztl record`
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
        if let Some(path) = self.records.iter().find(|path| is_recording(path)) {
            return self.of_recording(path);
        }
        let mut records = Vec::new();
        let mut damage = Vec::new();
        for path in &self.records {
            let (runs, found) = read(path)?;
            records.extend(runs);
            damage.extend(found);
        }
        for damage in &damage {
            error_line(format_args!("ztl: {damage}"));
        }
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
        for file in &files {
            // Never overwrite the only copy of a record.
            if self.records.iter().any(|record| same(record, file)) {
                let file = file.display();
                return Err(format!("{file} is a record; give the report another name").into());
            }
        }
        let report = report::Report::new(records, damage);
        let texts = [
            report::Report::html as fn(&report::Report) -> String,
            report::Report::tasks_csv,
            report::Report::actions_csv,
        ];
        for (file, text) in files.iter().zip(texts) {
            let written = std::fs::write(file, text(&report));
            written.map_err(|error| format!("cannot write {}: {error}", file.display()))?;
            line(format_args!("Written: {}", file.display()));
        }
        Ok(ExitCode::SUCCESS)
    }

    /// Makes the page of a recording.
    #[cfg(feature = "record")]
    fn of_recording(&self, path: &Path) -> Done {
        if self.records.len() > 1 || self.csv {
            let mistake = "a recording is reported alone, without --csv";
            return Err(crate::exit::Misuse(mistake.to_owned()).into());
        }
        let page = self.page();
        if same(path, &page) {
            let page = page.display();
            return Err(format!("{page} is the recording; give the report another name").into());
        }
        let name = path.display();
        let (html, damage) =
            ztl_record::report(path).map_err(|error| format!("cannot report {name}: {error}"))?;
        if damage.is_any() {
            error_line(format_args!("ztl: warning: {name} {damage}"));
        }
        let written = std::fs::write(&page, html);
        written.map_err(|error| format!("cannot write {}: {error}", page.display()))?;
        line(format_args!("Written: {}", page.display()));
        Ok(ExitCode::SUCCESS)
    }

    #[cfg(not(feature = "record"))]
    fn of_recording(&self, path: &Path) -> Done {
        let path = path.display();
        Err(format!("{path} is a recording, which this build cannot read (docs/dist.md)").into())
    }

    fn page(&self) -> PathBuf {
        match (&self.output, self.records.as_slice()) {
            (Some(output), _) => output.clone(),
            (None, [record]) => record.with_extension("html"),
            (None, _) => PathBuf::from("report.html"),
        }
    }
}

/// Whether a file is a recording: it begins as MCAP files do, or is called so.
fn is_recording(path: &Path) -> bool {
    let mut begin = [0; 8];
    let read = File::open(path).and_then(|mut file| file.read_exact(&mut begin));
    let is_called = path
        .extension()
        .is_some_and(|extension| extension == "mcap");
    is_called || (read.is_ok() && begin == *b"\x89MCAP0\r\n")
}

fn read(path: &Path) -> Result<(Vec<Record>, Vec<Damage>), String> {
    let name = path.display().to_string();
    let file = File::open(path).and_then(|file| record::read(&name, BufReader::new(file)));
    file.map_err(|error| format!("cannot read {name}: {error}"))
}

/// Whether two paths name the same file.
fn same(one: &Path, other: &Path) -> bool {
    let real = |path: &Path| std::fs::canonicalize(path).unwrap_or_else(|_| path.to_owned());
    real(one) == real(other)
}
