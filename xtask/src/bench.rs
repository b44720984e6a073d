//! `cargo xtask bench`: figures side by side in one run, never a pass or a failure by time.

use crate::cmd::{Cmd, Outcome};
use crate::{Dirs, firmware, python};

/// Runs every benchmark.
pub(crate) fn run(dirs: &Dirs, args: &[String]) -> Outcome {
    if let Some(word) = args.first() {
        return Err(format!(
            "`cargo xtask bench` takes no arguments, not `{word}`"
        ));
    }
    let python = python::ensure(dirs)?;
    // The programs that the link's figures are measured with.
    Cmd::new("cargo build --release --workspace --bins --locked").run()?;
    Cmd::new("cargo bench --locked --package ztl-tests")
        .env("ZTL_PYTHON", &python)
        .run()?;
    firmware::bench(dirs)
}
