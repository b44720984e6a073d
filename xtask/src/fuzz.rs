//! `cargo xtask fuzz`: runs each fuzz target for some seconds, starting with its corpus.
//!
//! Does not use cargo-fuzz, which must be installed and needs a nightly compiler. Coverage counters are an
//! ordinary LLVM pass, which a stable compiler accepts through `-C`. Nightly is only needed for sanitizers,
//! which find nothing in code without `unsafe`. The crate `libfuzzer-sys` contains libFuzzer and compiles it.

use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result, ensure};
use xshell::{Cmd, Shell, cmd};

use crate::project::{Project, succeeds};

/// The package of the targets, which is not in the workspace.
pub(crate) const MANIFEST: &str = "fuzz/Cargo.toml";

/// Without comparison tracing, which records addresses that differ in every run; up to half a minute per target.
const SAME_INPUTS: [&str; 4] = ["-seed=1", "-use_cmp=0", "-reload=0", "-runs=30000"];

/// The flags of cargo-fuzz, without the sanitizer.
const FLAGS: &str = "-Cpasses=sancov-module -Cllvm-args=-sanitizer-coverage-level=4 \
    -Cllvm-args=-sanitizer-coverage-inline-8bit-counters -Cllvm-args=-sanitizer-coverage-pc-table \
    -Cllvm-args=-sanitizer-coverage-trace-compares --cfg=fuzzing";

/// Runs the named target, or all, with new inputs. Continues from what earlier runs found.
pub(crate) fn search(project: &Project, target: Option<&str>, seconds: u32) -> Result<()> {
    let limit = format!("-max_total_time={seconds}");
    let all = targets(&project.sh)?;
    let names = all.join(", ");
    let wanted = |name: &&String| target.is_none_or(|target| target == *name);
    let found: Vec<String> = all.iter().filter(wanted).cloned().collect();
    let name = target.unwrap_or_default();
    ensure!(
        !found.is_empty(),
        "unknown target `{name}`: expected one of {names}"
    );
    fuzz(project, &found, "corpus", &[&limit])
}

/// Lints the targets, and runs each on the same inputs every time: the result depends only on the code.
pub(crate) fn smoke(project: &Project) -> Result<()> {
    lint(project)?;
    project.sh.remove_path(project.target.join("fuzz/same"))?;
    fuzz(project, &targets(&project.sh)?, "same", &SAME_INPUTS)
}

/// Lints the targets, which are not in the workspace.
pub(crate) fn lint(project: &Project) -> Result<()> {
    let clippy = cargo(project, "clippy")?;
    Ok(clippy
        .args(["--all-targets", "--", "-D", "warnings"])
        .run()?)
}

/// Runs targets with these options. Keeps inputs that reach new code in the directory `kept`.
fn fuzz(project: &Project, targets: &[String], kept: &str, options: &[&str]) -> Result<()> {
    let sh = &project.sh;
    cargo(project, "build")?.arg("--bins").run()?;
    let directory = project.target.join("fuzz");
    for target in targets {
        let program = directory.join(host(sh)?).join("release").join(target);
        let kept = sh.create_dir(directory.join(kept).join(target))?;
        let findings = sh.create_dir(directory.join("findings").join(target))?;
        // An input takes less than a millisecond. After 25 s it hangs, or the machine does.
        let common = "-timeout=25 -verbosity=0 -print_final_stats=1".split(' ');
        let options: Vec<&str> = options.iter().copied().chain(common).collect();
        let run = || {
            let options = &options;
            cmd!(
                sh,
                "{program} {options...} -artifact_prefix={findings}/ {kept} fuzz/corpus/{target}"
            )
            .run()
        };
        let before = sh.read_dir(&findings)?;
        let mut ran = run();
        if ran.is_err() && machine_has_stalled(sh, &program, &findings, &before)? {
            println!(
                "The machine stalled: the input that took too long takes no time alone. Again:"
            );
            ran = run();
        }
        ran.with_context(|| {
            let program = program.display();
            format!(
                "fuzz target `{target}` failed; the input is in {}. To run it again:\n    {program} INPUT\n\
                 To look for a shorter one:\n    {program} -minimize_crash=1 -runs=100000 INPUT\n",
                findings.display()
            )
        })?;
    }
    Ok(())
}

/// Whether a target failed because the machine stood still, and not because of its input: libFuzzer measures by the wall
/// clock. Then the input takes no time when it runs alone.
fn machine_has_stalled(
    sh: &Shell,
    program: &Path,
    findings: &Path,
    before: &[PathBuf],
) -> Result<bool> {
    let mut inputs = sh.read_dir(findings)?;
    inputs.retain(|path| !before.contains(path));
    let is_timeout = |path: &PathBuf| {
        let name = path.file_name().and_then(|name| name.to_str());
        name.is_some_and(|name| name.starts_with("timeout-"))
    };
    if inputs.is_empty() || !inputs.iter().all(is_timeout) {
        return Ok(false);
    }
    Ok(succeeds(cmd!(sh, "{program} -timeout=1 {inputs...}")))
}

/// Cargo for the targets. With `--target`, the flags do not reach build scripts and macros.
fn cargo<'a>(project: &'a Project, command: &str) -> Result<Cmd<'a>> {
    let cargo = project.cargo(command);
    let cargo = cargo.args(["--release", "--manifest-path", MANIFEST, "--target"]);
    let cargo = cargo.arg(host(&project.sh)?).arg("--target-dir");
    Ok(cargo
        .arg(project.target.join("fuzz"))
        .env("RUSTFLAGS", FLAGS))
}

fn host(sh: &Shell) -> xshell::Result<String> {
    cmd!(sh, "rustc --print host-tuple").read()
}

/// The names of the targets, sorted.
fn targets(sh: &Shell) -> Result<Vec<String>> {
    let files = sh.read_dir("fuzz/fuzz_targets")?;
    let names = files.iter().filter_map(|path| path.file_stem()?.to_str());
    Ok(names.map(str::to_owned).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_target_is_built_has_a_corpus_and_is_documented() {
        let sh = &Shell::new().unwrap();
        sh.change_dir(concat!(env!("CARGO_MANIFEST_DIR"), "/.."));
        let manifest = sh.read_file(MANIFEST).unwrap();
        let readme = sh.read_file("fuzz/README.md").unwrap();
        let targets = targets(sh).unwrap();
        assert!(targets.len() > 5, "{targets:?}");
        for target in targets {
            assert!(manifest.contains(&format!("name = \"{target}\"\npath = \"fuzz_targets/")));
            assert!(readme.contains(&format!("\n| `{target}` |")), "{target}");
            assert!(sh.path_exists(format!("fuzz/corpus/{target}")), "{target}");
        }
    }
}
