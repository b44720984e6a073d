//! `cargo xtask build --curve`: the `ztl` command with a libzmq that encrypts.
//!
//! The libzmq that `zmq-sys` compiles has no CURVE. Cargo lets a configuration put another library in
//! place of what a build script would make, since `zmq-sys` names what it links to: the package
//! `libzmq/` compiles that one, against libsodium.

use std::path::PathBuf;

use crate::Dirs;
use crate::cmd::{Cmd, Outcome};
use crate::python;

/// The package that compiles libzmq with CURVE; no member of the workspace.
const MANIFEST: &str = "libzmq/Cargo.toml";

/// Builds `ztl`, optimised, and says where it is.
pub(crate) fn run(dirs: &Dirs, args: &[String]) -> Outcome {
    let words: Vec<&str> = args.iter().map(String::as_str).collect();
    let (build, target) = match words.as_slice() {
        [] => (Cmd::new("cargo build"), dirs.target.clone()),
        ["--curve"] => (cargo(dirs, "build")?, target(dirs)),
        _ => return Err("`cargo xtask build` takes `--curve`, or nothing".to_owned()),
    };
    build
        .args("--release --locked --package ztl-std --bin ztl")
        .run()?;
    println!("{}", target.join("release/ztl").display());
    Ok(())
}

/// Runs the tests about who may use a server, with encryption.
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

/// `cargo WORD`, linking to a libzmq with CURVE.
pub(crate) fn cargo(dirs: &Dirs, word: &str) -> Outcome<Cmd> {
    let build = Cmd::new("cargo run --release --quiet --locked --manifest-path")
        .arg(MANIFEST)
        .arg("--target-dir")
        .arg(dirs.target.join("libzmq"));
    println!("$ {build}");
    let places = build.stdout()?;
    let Some((zmq, sodium)) = places.split_once('\n') else {
        return Err(format!(
            "`{build}` has not said where libzmq and libsodium are"
        ));
    };
    let version = Cmd::new("rustc -vV").stdout()?;
    let host = version.lines().find_map(|line| line.strip_prefix("host: "));
    let host = host.ok_or("`rustc -vV` does not tell its host")?;
    let cpp = if host.contains("apple") {
        "c++"
    } else {
        "stdc++"
    };
    // As TOML: paths in single quotes are taken as they are.
    let search = format!("target.{host}.zmq.rustc-link-search=['{zmq}', '{sodium}']");
    let link = format!("target.{host}.zmq.rustc-link-lib=['static=zmq', 'static=sodium', '{cpp}']");
    Ok(Cmd::new("cargo")
        .arg(word)
        .arg("--config")
        .arg(search)
        .arg("--config")
        .arg(link)
        .arg("--target-dir")
        .arg(target(dirs)))
}
