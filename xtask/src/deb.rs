//! `cargo xtask deb`: Debian packages of the static `ztl`.

use std::env;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result, ensure};
use xshell::cmd;

use crate::project::Project;
use crate::{dist, install, zig};

/// What differs between the units in `examples/systemd` and those of the package.
const UNITS: [(&str, &[[&str; 2]]); 2] = [
    (
        "ztl-gateway.service",
        &[
            ["/usr/local/bin/ztl", "/usr/bin/ztl"],
            ["\nDynamicUser=yes\n", "\nUser=ztl\n"],
        ],
    ),
    (
        "ztl-serve.service",
        &[
            ["/usr/local/bin/ztl", "/usr/bin/ztl"],
            ["\nUser=robot\n", "\nUser=ztl\n"],
        ],
    ),
];

/// Installs the package in a Debian root, runs the command, purges the package, and compares all files.
const CHECK: &str = "packaging/check.sh";

/// Builds the packages for the named processors, or for this machine's.
pub(crate) fn build(project: &Project, names: &[String]) -> Result<Vec<PathBuf>> {
    let sh = &project.sh;
    let here = [env::consts::ARCH.to_owned()];
    let targets = zig::targets(if names.is_empty() { &here } else { names })?;
    let cargo_deb = install::cargo_deb(project)?;
    project.build_programs()?;
    let mut packages = Vec::new();
    for (target, program) in dist::build_all(project, &targets, &dist::ZTL, "debian")? {
        let target_dir = program.ancestors().nth(2).context("a target directory")?;
        let triple = target.triple();
        let built = target_dir.join(&triple).join(zig::PROFILE);
        stage(project, &program, &built.join("deb"))?;
        let package = program.with_extension("deb");
        let options = "--manifest-path ztl/Cargo.toml --locked --no-build --no-strip".split(' ');
        cmd!(
            sh,
            "{cargo_deb} {options...} --target {triple} --output {package}"
        )
        .args(["--profile", zig::PROFILE])
        .env("CARGO_TARGET_DIR", target_dir)
        .run()?;
        println!("{}", package.display());
        packages.push(package);
    }
    Ok(packages)
}

/// Collects the files that `ztl/Cargo.toml` lists below `target/release/deb`.
fn stage(project: &Project, program: &Path, stage: &Path) -> Result<()> {
    let sh = &project.sh;
    sh.remove_path(stage)?;
    let ztl = project.target.join("debug/ztl");
    cmd!(sh, "{ztl} man {stage}/man").run()?;
    let pages = sh.read_dir(stage.join("man"))?;
    cmd!(sh, "gzip --best --no-name {pages...}").run()?;
    for shell in ["bash", "zsh", "fish"] {
        let script = cmd!(sh, "{ztl} completions {shell}").read()?;
        sh.write_file(stage.join("completions").join(shell), script + "\n")?;
    }
    for (unit, changes) in UNITS {
        let path = Path::new("examples/systemd").join(unit);
        let text = sh.read_file(&path)?;
        // The comment at the beginning says how to install the unit by hand.
        let begin = text.find("[Unit]").context("no [Unit]")?;
        let mut text = text.get(begin..).unwrap_or_default().to_owned();
        for [from, to] in changes {
            ensure!(text.contains(from), "{} lacks `{from}`", path.display());
            text = text.replace(from, to);
        }
        sh.write_file(stage.join("systemd").join(unit), text)?;
    }
    sh.copy_file(
        program.with_extension("cdx.json"),
        stage.join("ztl.cdx.json"),
    )?;
    sh.copy_file(
        program.with_extension("licenses.txt"),
        stage.join("copyright"),
    )?;
    Ok(())
}

/// Installs the package of this machine's processor in an empty Debian root, runs the demo there, and purges it.
pub(crate) fn test(project: &Project) -> Result<()> {
    let sh = &project.sh;
    let packages = build(project, &[])?;
    let empty = install::debian_root(project)?;
    let root = project.target.join("debian/root");
    // A root of an earlier, interrupted run may be there.
    cmd!(sh, "rm -rf {root}").run()?;
    cmd!(sh, "cp --archive --reflink=auto {empty} {root}").run()?;
    cmd!(sh, "cp {packages...} {root}/tmp/ztl.deb").run()?;
    cmd!(sh, "cp {CHECK} {root}/tmp/check.sh").run()?;
    let clean = ["-i", "PATH=/usr/sbin:/usr/bin:/sbin:/bin", "LC_ALL=C.UTF-8"];
    cmd!(sh, "env {clean...} chroot {root} sh /tmp/check.sh").run()?;
    Ok(cmd!(sh, "rm -rf {root}").run()?)
}
