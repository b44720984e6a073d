//! `cargo xtask build --curve`: the `ztl` command with a libzmq that supports encryption.
//!
//! The libzmq that `zmq-sys` compiles has no CURVE. Because `zmq-sys` declares which library it links to, a
//! Cargo configuration can replace its build script with another library. The package `libzmq/` compiles that
//! one, with libsodium.

use std::path::PathBuf;

use crate::cmd::{Cmd, Outcome};
use crate::{Dirs, python};

/// The package that compiles libzmq with CURVE; not in the workspace.
const MANIFEST: &str = "libzmq/Cargo.toml";

/// Builds an optimised `ztl` and prints its path.
pub(crate) fn run(dirs: &Dirs, args: &[String]) -> Outcome {
    let words: Vec<&str> = args.iter().map(String::as_str).collect();
    let (build, target) = match words.as_slice() {
        [] => (Cmd::new("cargo build"), dirs.target.clone()),
        ["--curve"] => (cargo(dirs, "build")?, target(dirs)),
        _ => return Err("unknown argument: `cargo xtask build` takes only `--curve`".to_owned()),
    };
    build
        .args("--release --locked --package ztl-std --bin ztl")
        .run()?;
    println!("{}", target.join("release/ztl").display());
    Ok(())
}

/// Runs the access tests with encryption.
pub(crate) fn test(dirs: &Dirs) -> Outcome {
    let python = python::ensure(dirs)?;
    cargo(dirs, "build")?
        .args("--locked --package ztl-std --bin ztl")
        .run()?;
    cargo(dirs, "test")?
        .args("--locked --package ztl-std --lib keys")
        .env("ZTL_CURVE", "1")
        .run()?;
    cargo(dirs, "test")?
        .args("--locked --package ztl-tests --test access")
        .env("ZTL_PYTHON", python)
        .env("ZTL_CURVE", "1")
        .run()?;
    cargo(dirs, "test")?
        .args("--locked --package ztl-tests --test serve -- forward::with_keys")
        .env("ZTL_CURVE", "1")
        .run()
}

pub(crate) fn target(dirs: &Dirs) -> PathBuf {
    dirs.target.join("curve")
}

/// `cargo WORD`, linked with a libzmq that has CURVE.
pub(crate) fn cargo(dirs: &Dirs, word: &str) -> Outcome<Cmd> {
    let build = Cmd::new("cargo build --release --locked");
    let libraries = libraries(build.arg("--target-dir").arg(dirs.target.join("libzmq")))?;
    let version = Cmd::new("rustc -vV").stdout()?;
    let host = version.lines().find_map(|line| line.strip_prefix("host: "));
    let host = host.ok_or("`rustc -vV` does not report its host")?;
    let cpp = if host.contains("apple") {
        "c++"
    } else {
        "stdc++"
    };
    let cargo = libraries.link(Cmd::new("cargo").arg(word), host, cpp);
    Ok(cargo.arg("--target-dir").arg(target(dirs)))
}

/// The directories of the compiled libraries.
pub(crate) struct Libraries {
    /// Directory of libzmq.
    pub(crate) zmq: String,
    /// Directory of libsodium.
    pub(crate) sodium: String,
}

/// Compiles libzmq and libsodium with this `cargo build`, and returns their directories.
pub(crate) fn libraries(build: Cmd) -> Outcome<Libraries> {
    // The build script of `libzmq/` reports them; unlike a program, it runs for every target.
    let build = build
        .arg("--manifest-path")
        .arg(MANIFEST)
        .args("--quiet --message-format json");
    println!("$ {build}");
    let messages = build.stdout()?;
    let said = |name: &str| {
        let (_, rest) = messages.split_once(&format!("[\"{name}\",\""))?;
        Some(rest.split_once('"')?.0.to_owned())
    };
    match (said("ZTL_ZMQ"), said("ZTL_SODIUM")) {
        (Some(zmq), Some(sodium)) => Ok(Libraries { zmq, sodium }),
        _ => Err(format!(
            "`{build}` did not report where libzmq and libsodium are"
        )),
    }
}

impl Libraries {
    /// Makes `zmq-sys` use them in a build for `target`, with the C++ library `cpp`.
    pub(crate) fn link(&self, cargo: Cmd, target: &str, cpp: &str) -> Cmd {
        let Self { zmq, sodium } = self;
        // As TOML: single quotes keep paths unchanged.
        let search = format!("target.{target}.zmq.rustc-link-search=['{zmq}', '{sodium}']");
        let link =
            format!("target.{target}.zmq.rustc-link-lib=['static=zmq', 'static=sodium', '{cpp}']");
        cargo.arg("--config").arg(search).arg("--config").arg(link)
    }
}
