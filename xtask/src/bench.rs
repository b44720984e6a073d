//! `cargo xtask bench`: figures side by side in one run, never a pass or a failure by time.

use crate::cmd::{Cmd, Outcome};
use crate::{Dirs, firmware, python};

/// The parts of the comparison of whole servers that can be asked for alone.
const PARTS: [&str; 7] = ["rates", "most", "cpu", "core", "goal", "end", "idle"];

/// The cycles of a microcontroller, alone.
const FIRMWARE: &str = "firmware";

/// Runs every benchmark, parts of the comparison of servers, or only the microcontroller's.
pub(crate) fn run(dirs: &Dirs, args: &[String]) -> Outcome {
    if let [word] = args
        && word == FIRMWARE
    {
        return firmware::bench(dirs);
    }
    if let Some(word) = args.iter().find(|word| !PARTS.contains(&word.as_str())) {
        return Err(format!(
            "`cargo xtask bench` does not know `{word}`; it measures everything, alone {FIRMWARE}, or of whole servers {}",
            PARTS.join(", ")
        ));
    }
    let python = python::ensure(dirs)?;
    // The programs that are measured.
    Cmd::new("cargo build --release --workspace --bins --locked").run()?;
    let mut bench = Cmd::new("cargo bench --locked --package ztl-tests").env("ZTL_PYTHON", &python);
    if !args.is_empty() {
        bench = bench.args("--bench server --").args(&args.join(" "));
        return bench.run();
    }
    bench.run()?;
    firmware::bench(dirs)
}
