//! The virtual environment with the original ZTL package, for the integration tests.

use std::fs;
use std::io::ErrorKind;
use std::path::PathBuf;

use crate::Dirs;
use crate::cmd::{Cmd, Outcome};

const REQUIREMENTS: &str = "tests/requirements.txt";

/// The source archive with the original's own tests, which the installed package lacks.
const SUITE: &str = "tests/original_suite/requirements.txt";

/// Creates the environment if it is missing; returns the path of its Python.
pub(crate) fn ensure(dirs: &Dirs) -> Outcome<PathBuf> {
    let mut wanted = String::new();
    for file in [REQUIREMENTS, SUITE] {
        wanted +=
            &fs::read_to_string(file).map_err(|error| format!("cannot read {file}: {error}"))?;
    }
    let venv = dirs.target.join("venv");
    let python = venv.join("bin/python");
    // Written last: without it, the environment is incomplete.
    let stamp = venv.join("requirements.stamp");

    // Also runs it: an environment breaks when its base Python is removed.
    let works = || {
        Cmd::program(&python)
            .args("-c")
            .arg("import ztl, zmq, oyaml, pytest")
    };
    if fs::read_to_string(&stamp).is_ok_and(|installed| installed == wanted)
        && works().stdout().is_ok()
    {
        println!("{} is up to date with {REQUIREMENTS}", venv.display());
    } else {
        match fs::remove_dir_all(&venv) {
            Err(error) if error.kind() != ErrorKind::NotFound => {
                return Err(format!("cannot remove {}: {error}", venv.display()));
            }
            _ => {}
        }
        Cmd::new("python3 -m venv").arg(&venv).run()?;
        // Every package is listed with its version; nothing else is installed.
        Cmd::program(&python)
            .args("-m pip install --disable-pip-version-check --no-deps --requirement")
            .arg(REQUIREMENTS)
            .run()?;
        let suite = venv.join("original");
        Cmd::program(&python)
            .args("-m pip download --disable-pip-version-check --no-deps --no-binary ztl --requirement")
            .arg(SUITE)
            .arg("--dest")
            .arg(&suite)
            .run()?;
        Cmd::program(&python)
            .args("-m tarfile --extract")
            .arg(suite.join("ztl-0.3.3.tar.gz"))
            .arg(&suite)
            .run()?;
        works().run()?;
        fs::write(&stamp, wanted)
            .map_err(|error| format!("cannot write {}: {error}", stamp.display()))?;
    }
    // Absolute, because Cargo runs each test in its package's directory.
    Ok(dirs.absolute("venv/bin/python"))
}
