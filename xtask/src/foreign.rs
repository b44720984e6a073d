//! Whether the library and the command type-check for systems that are not this one.

use crate::Dirs;
use crate::cmd::{Cmd, Outcome};
use crate::cross;

/// Where a client may run, besides Linux.
const TARGETS: [&str; 2] = ["x86_64-pc-windows-gnu", "aarch64-apple-darwin"];

/// Checks for each target for which there is a standard library, and says for which there is none.
pub(crate) fn check(dirs: &Dirs) -> Outcome {
    cross::add(&lacking());
    let lacking = lacking();
    for target in TARGETS {
        if lacking.contains(&target) {
            println!(
                "LEFT OUT: {target}, since rustup does not give its standard library (rustup target add {target})"
            );
            continue;
        }
        // In place of libzmq's own compilation, for which there is no compiler: nothing is linked.
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
