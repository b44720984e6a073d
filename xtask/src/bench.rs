//! `cargo xtask bench`: compares figures within one run; never passes or fails by time.

use crate::cmd::{Cmd, Outcome};
use crate::{Dirs, firmware, python};

/// Parts of the server comparison that can be run alone.
const PARTS: [&str; 7] = ["rates", "most", "cpu", "core", "goal", "end", "idle"];

/// Only the cycles of a microcontroller.
const FIRMWARE: &str = "firmware";

/// Runs every benchmark, parts of the server comparison, or only the microcontroller's.
pub(crate) fn run(dirs: &Dirs, args: &[String]) -> Outcome {
    if let [word] = args
        && word == FIRMWARE
    {
        return firmware::bench(dirs);
    }
    if let Some(word) = args.iter().find(|word| !PARTS.contains(&word.as_str())) {
        return Err(format!(
            "unknown benchmark `{word}`: expected nothing for all, {FIRMWARE}, or parts of the server comparison: {}",
            PARTS.join(", ")
        ));
    }
    let python = python::ensure(dirs)?;
    // The programs to measure.
    Cmd::new("cargo build --release --workspace --bins --locked").run()?;
    let mut bench = Cmd::new("cargo bench --locked --package ztl-tests").env("ZTL_PYTHON", &python);
    if !args.is_empty() {
        bench = bench.args("--bench server --").args(&args.join(" "));
        return bench.run();
    }
    bench.run()?;
    firmware::bench(dirs)
}
