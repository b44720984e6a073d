//! Type-checks the library and the command for other operating systems.

use crate::Dirs;
use crate::cmd::{Cmd, Outcome};
use crate::cross;

/// Systems besides Linux on which a client may run.
const TARGETS: [&str; 2] = ["x86_64-pc-windows-gnu", "aarch64-apple-darwin"];

/// Checks each target that has a standard library, and reports the others.
pub(crate) fn check(dirs: &Dirs) -> Outcome {
    cross::add(&lacking());
    let lacking = lacking();
    for target in TARGETS {
        if lacking.contains(&target) {
            println!(
                "SKIPPED: {target}: rustup has not installed its standard library (rustup target add {target})"
            );
            continue;
        }
        // Replaces the compilation of libzmq, which needs a foreign compiler; nothing is linked.
        let zmq = format!("target.{target}.zmq.rustc-link-lib=['zmq']");
        Cmd::new("cargo check --locked --package ztl-std --target")
            .arg(target)
            .arg("--config")
            .arg(zmq)
            .arg("--target-dir")
            .arg(dirs.target.join("foreign"))
            .env("RUSTFLAGS", "-D warnings")
            .run()?;
    }
    Ok(())
}

fn lacking() -> Vec<&'static str> {
    let lacks = |target: &&str| cross::compiled_core(target).is_none();
    TARGETS.into_iter().filter(lacks).collect()
}
