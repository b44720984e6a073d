//! Builds with a libzmq that supports encryption.
//!
//! The libzmq that `zmq-sys` compiles has no CURVE. Because `zmq-sys` declares which library it links to, a
//! Cargo configuration can replace its build script with another library. The package `libzmq/` compiles that
//! one, with libsodium.

use std::path::PathBuf;

use anyhow::{Context as _, Result};
use xshell::{Cmd, cmd};

use crate::project::{COMMAND, Project};
use crate::{install, rerun};

/// `cargo xtask build`: builds an optimised `ztl` and prints its path.
pub(crate) fn build(project: &Project, curve: bool) -> Result<()> {
    let (build, target) = match curve {
        true => (cargo(project, "build")?, target(project)),
        false => (project.cargo("build"), project.target.clone()),
    };
    build.arg("--release").args(COMMAND).run()?;
    println!("{}", target.join("release/ztl").display());
    Ok(())
}

/// Runs the access tests with encryption.
pub(crate) fn test(project: &Project) -> Result<()> {
    install::python(project)?;
    cargo(project, "build")?.args(COMMAND).run()?;
    let test = |words: &str, names: &[&str]| {
        let test = || {
            Ok(cargo(project, "test")?
                .env("ZTL_CURVE", "1")
                .args(words.split(' ')))
        };
        rerun::cargo_test(test, names)
    };
    test("--package ztl-std --lib", &["keys"])?;
    test(
        "--package ztl-tests --test serve",
        &["access::", "forward::with_keys"],
    )
}

pub(crate) fn target(project: &Project) -> PathBuf {
    project.target.join("curve")
}

/// `cargo WORD`, linked with a libzmq that has CURVE.
pub(crate) fn cargo<'a>(project: &'a Project, word: &str) -> Result<Cmd<'a>> {
    let sh = &project.sh;
    let libzmq = project.target.join("libzmq");
    let build = project.cargo("build --release --target-dir");
    let libraries = libraries(build.arg(libzmq))?;
    let host = cmd!(sh, "rustc --print host-tuple").read()?;
    let is_apple = host.contains("apple");
    let cargo = project.cargo(word).arg("--target-dir").arg(target(project));
    Ok(libraries.link(cargo, &host, if is_apple { "c++" } else { "stdc++" }))
}

/// The directories of the compiled libraries.
pub(crate) struct Libraries {
    zmq: String,
    pub(crate) sodium: String,
}

/// Compiles libzmq and libsodium with this `cargo build`, and returns their directories.
pub(crate) fn libraries(build: Cmd<'_>) -> Result<Libraries> {
    // The build script of `libzmq/` reports them; unlike a program, it runs for every target.
    let words = "--manifest-path libzmq/Cargo.toml --quiet --message-format json";
    let build = build.args(words.split(' '));
    println!("$ {build}");
    let messages = build.read()?;
    let directory = |name: &str| {
        let (_, rest) = messages.split_once(&format!("[\"{name}\",\""))?;
        Some(rest.split_once('"')?.0.to_owned())
    };
    let zmq = directory("ZTL_ZMQ").context("libzmq/build.rs did not report ZTL_ZMQ")?;
    let sodium = directory("ZTL_SODIUM").context("libzmq/build.rs did not report ZTL_SODIUM")?;
    Ok(Libraries { zmq, sodium })
}

impl Libraries {
    /// Makes `zmq-sys` use them in a build for `target`, with the C++ library `cpp`.
    pub(crate) fn link<'a>(&self, cargo: Cmd<'a>, target: &str, cpp: &str) -> Cmd<'a> {
        let Self { zmq, sodium } = self;
        // As TOML: single quotes keep paths unchanged.
        let search = format!("target.{target}.zmq.rustc-link-search=['{zmq}', '{sodium}']");
        let names = format!("['static=zmq', 'static=sodium', '{cpp}']");
        let link = format!("target.{target}.zmq.rustc-link-lib={names}");
        cargo.args(["--config", &search, "--config", &link])
    }
}
