//! The npm package of `examples/clients/client.mjs`, for the tests that run it.

use std::fs;
use std::path::PathBuf;

use crate::Dirs;
use crate::cmd::{Cmd, Outcome};

/// With its version, so that every machine tests the same.
const PACKAGE: &str = "zeromq@6.8.0";

/// Installs the package unless it is there already; returns the directory that has it in its
/// `node_modules`.
pub(crate) fn ensure(dirs: &Dirs) -> Outcome<PathBuf> {
    let home = dirs.target.join("clients");
    // Written last, so that a package without it is known to be half installed.
    let stamp = home.join("package.stamp");
    let package = dirs.absolute("clients/node_modules/zeromq");
    // A try as well: it breaks when another Node comes that its library was not built for.
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
        // The package brings its library ready built; its script would only build it anew.
        Cmd::new("npm install --ignore-scripts --no-save --no-audit --no-fund --prefix")
            .arg(&home)
            .arg(PACKAGE)
            .run()?;
        works().run()?;
        fs::write(&stamp, PACKAGE)
            .map_err(|error| format!("cannot write {}: {error}", stamp.display()))?;
    }
    // Absolute: Cargo runs each test in the directory of its package.
    Ok(dirs.absolute("clients"))
}
