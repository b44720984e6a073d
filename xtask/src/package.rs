//! Checks that the crates could be published: `cargo package` reports no problems, and the packages compile
//! on their own. Type-checks for other operating systems.

use anyhow::{Result, bail};
use xshell::cmd;

use crate::cross;
use crate::project::{PACKAGE, Project};

/// In an order in which they can be published. Without `ztl-fleet`, a beginning that is not published.
#[rustfmt::skip]
const CRATES: [&str; 15] = [
    "ztl-core", "ztl-zmtp", "ztl-mcu", "ztl-link", "ztl-yaml", "ztl-pickle", "ztl-naoqi", "ztl-std", "ztl-script", "ztl-record", "ztl-ros1", "ztl-serve", "ztl-sim", "ztl-web", "ztl",
];

/// The systems besides Linux on which a client may run.
pub(crate) const FOREIGN: [&str; 2] = ["x86_64-pc-windows-gnu", "aarch64-apple-darwin"];

/// Packages each crate, and compiles the last one from the packages alone, which replace the registry.
pub(crate) fn check(project: &Project) -> Result<()> {
    let sh = &project.sh;
    let packages = CRATES.iter().flat_map(|name| ["--package", name]);
    let package = project
        .cargo("package --no-verify --allow-dirty")
        .args(packages);
    println!("$ {package}");
    let stderr = package.read_stderr()?;
    if stderr.lines().any(|line| line.starts_with("warning")) {
        bail!("`{package}` reports a problem:\n{stderr}");
    }
    let place = project.target.join("package/unpacked");
    // Leftovers of an earlier version must not help.
    sh.remove_path(&place)?;
    sh.create_dir(&place)?;
    let target = &project.target;
    let mut check = cmd!(sh, "cargo check --target-dir {target}");
    for name in CRATES {
        let versioned = format!("{name}-{}", env!("CARGO_PKG_VERSION"));
        let packed = place.with_file_name(format!("{versioned}.crate"));
        // With the time of now: the packages have the same old one always, so that Cargo would see no change.
        cmd!(sh, "tar --touch -xzf {packed} -C {place}").run()?;
        let unpacked = place.join(versioned);
        let unpacked = unpacked.display();
        check = match name == PACKAGE {
            true => check
                .arg("--manifest-path")
                .arg(format!("{unpacked}/Cargo.toml")),
            false => check
                .arg("--config")
                .arg(format!("patch.crates-io.{name}.path='{unpacked}'")),
        };
    }
    Ok(check.run()?)
}

/// Type-checks the library and the command for [`FOREIGN`].
pub(crate) fn check_foreign(project: &Project) -> Result<()> {
    let sh = &project.sh;
    cross::add(sh, &FOREIGN);
    for target in FOREIGN {
        if cross::compiled_core(sh, target).is_none() {
            println!("SKIPPED: {target}: rustup has not installed its standard library");
            continue;
        }
        let mut check = project
            .cargo("check --package")
            .args([PACKAGE, "--target", target]);
        // Replaces the compilation of code in C, which needs a foreign compiler; nothing is linked.
        for links in ["zmq", "ring_core_0_17_14_"] {
            let library = format!("target.{target}.{links}.rustc-link-lib=['{links}']");
            check = check.args(["--config", &library]);
        }
        let check = check
            .arg("--target-dir")
            .arg(project.target.join("foreign"));
        check.env("RUSTFLAGS", "-D warnings").run()?;
    }
    Ok(())
}
