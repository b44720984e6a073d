//! The npm package of `examples/clients/client.mjs`, for the tests that run it.

use std::fs;
use std::path::PathBuf;

use crate::Dirs;
use crate::cmd::{Cmd, Outcome};

/// With its version, so that every machine tests the same.
const PACKAGE: &str = "zeromq@6.8.0";

/// Installs the package if it is missing; returns the directory whose `node_modules` contains it.
pub(crate) fn ensure(dirs: &Dirs) -> Outcome<PathBuf> {
    let home = dirs.target.join("clients");
    // Written last: without it, the installation is incomplete.
    let stamp = home.join("package.stamp");
    let package = dirs.absolute("clients/node_modules/zeromq");
    // Also loads the package: it breaks after an update of Node.
    let works = || {
        Cmd::new("node --eval")
            .arg("require(process.argv[1])")
            .arg(&package)
    };
    if fs::read_to_string(&stamp).is_ok_and(|installed| installed == PACKAGE)
        && works().stdout().is_ok()
    {
        println!("{} has {PACKAGE}", home.display());
    } else {
        // The package contains a compiled library; its script would only rebuild it.
        Cmd::new("npm install --ignore-scripts --no-save --no-audit --no-fund --prefix")
            .arg(&home)
            .arg(PACKAGE)
            .run()?;
        works().run()?;
        fs::write(&stamp, PACKAGE)
            .map_err(|error| format!("cannot write {}: {error}", stamp.display()))?;
    }
    // Absolute, because Cargo runs each test in its package's directory.
    Ok(dirs.absolute("clients"))
}
