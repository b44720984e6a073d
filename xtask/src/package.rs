//! Checks that the crates could be published: `cargo package` reports no problems, and the packages compile
//! on their own.

use std::fs;

use crate::Dirs;
use crate::cmd::{Cmd, Outcome};

/// In an order in which they can be published.
const CRATES: &[&str] = &["ztl-core", "ztl-mcu", "ztl-std"];

/// Packages each crate, and compiles the last one from the packages alone, which replace the registry.
pub(crate) fn check(dirs: &Dirs) -> Outcome {
    let mut package = Cmd::new("cargo package --no-verify --locked --allow-dirty");
    for name in CRATES {
        package = package.arg("--package").arg(name);
    }
    println!("$ {package}");
    let (done, _, said) = package.capture()?;
    if !done || complains(&said) {
        return Err(format!("`{package}` reports a problem:\n{said}"));
    }
    let place = dirs.absolute("package/unpacked");
    // Leftovers of an earlier version must not help.
    let _ = fs::remove_dir_all(&place);
    fs::create_dir_all(&place).map_err(|error| format!("{}: {error}", place.display()))?;
    let mut check = Cmd::new("cargo check --target-dir").arg(dirs.absolute(""));
    for name in CRATES {
        let version = env!("CARGO_PKG_VERSION");
        let packed = dirs.absolute(&format!("package/{name}-{version}.crate"));
        let unpack = Cmd::new("tar -xzf").arg(packed).arg("-C").arg(&place);
        unpack.run()?;
        let unpacked = place.join(format!("{name}-{version}"));
        check = if Some(name) == CRATES.last() {
            check
                .arg("--manifest-path")
                .arg(unpacked.join("Cargo.toml"))
        } else {
            let patch = format!("patch.crates-io.{name}.path='{}'", unpacked.display());
            check.arg("--config").arg(patch)
        };
    }
    check.run()
}

fn complains(said: &str) -> bool {
    said.lines().any(|line| line.starts_with("warning"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_warning_is_a_complaint() {
        let content = "   Packaging ztl-core v0.1.0\n    Packaged 57 files\n";
        assert!(!complains(content));
        let without = "warning: manifest has no description\n   Packaging ztl-core v0.1.0\n";
        assert!(complains(without));
    }
}
