//! `ztl report`: records of runs as a page for people and as tables for statistics.

use std::fs::File;
use std::io::BufReader;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use ztl_script::record::{self, Damage, Record};
use ztl_script::report;

use crate::exit::Done;
use crate::terminal::{error_line, line};

#[derive(Debug, clap::Args)]
pub(crate) struct Report {
    /// Records, as `ztl run-script --record` writes them; several are compared
    #[arg(required = true, value_name = "RUN.jsonl")]
    records: Vec<PathBuf>,

    /// The page to write [default: beside the record, RUN.html; of several report.html]
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,

    /// Write tables too, beside the page: FILE.tasks.csv (a line for each task) and FILE.operator.csv
    /// (a line for each thing that the operator did)
    #[arg(long)]
    csv: bool,
}

impl Report {
    pub(crate) fn run(self) -> Done {
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
            // The one copy of what happened.
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

    fn page(&self) -> PathBuf {
        match (&self.output, self.records.as_slice()) {
            (Some(output), _) => output.clone(),
            (None, [record]) => record.with_extension("html"),
            (None, _) => PathBuf::from("report.html"),
        }
    }
}

fn read(path: &Path) -> Result<(Vec<Record>, Vec<Damage>), String> {
    let name = path.display().to_string();
    let file = File::open(path).and_then(|file| record::read(&name, BufReader::new(file)));
    file.map_err(|error| format!("cannot read {name}: {error}"))
}

/// Whether two names lead to one file.
fn same(one: &Path, other: &Path) -> bool {
    let real = |path: &Path| std::fs::canonicalize(path).unwrap_or_else(|_| path.to_owned());
    real(one) == real(other)
}
