//! `cargo xtask fuzz`: each fuzz target for some seconds, its corpus first.
//!
//! Without cargo-fuzz, which would have to be installed and asks for a nightly compiler. Coverage
//! counters are an ordinary pass of LLVM, which a stable compiler takes through `-C`; nightly is for
//! the sanitizers, which find nothing in code without `unsafe`. libFuzzer itself is C++, brought and
//! compiled by the crate `libfuzzer-sys`.

use std::fs;
use std::path::{Path, PathBuf};

use crate::Dirs;
use crate::cmd::{Cmd, Outcome};

/// The package of the targets, which is no member of the workspace.
pub(crate) const MANIFEST: &str = "fuzz/Cargo.toml";

const TARGETS: &str = "fuzz/fuzz_targets";

/// Seconds for each target, unless told otherwise.
const SECONDS: u32 = 5;

/// Inputs for each target in the test command: some seconds.
const INPUTS: u32 = 30_000;

/// How far a target goes.
#[derive(Clone, Copy)]
enum Length {
    /// On from what was found before, to find more.
    Seconds(u32),
    /// The same inputs each time, from the committed corpus on: what it says is said of the code, not of the day.
    Inputs(u32),
}

/// One input takes less than a millisecond; this long, it hangs, on however busy a machine.
const HANGS_AFTER: &str = "-timeout=25";

/// What cargo-fuzz passes too, but for the sanitizer.
const FLAGS: &str = "-Cpasses=sancov-module -Cllvm-args=-sanitizer-coverage-level=4 \
    -Cllvm-args=-sanitizer-coverage-inline-8bit-counters -Cllvm-args=-sanitizer-coverage-pc-table \
    -Cllvm-args=-sanitizer-coverage-trace-compares --cfg=fuzzing";

/// Runs the target that the arguments name, or all of them.
pub(crate) fn run(dirs: &Dirs, args: &[String]) -> Outcome {
    let (target, seconds) = chosen(args)?;
    let all = targets()?;
    let wanted = match target {
        None => all,
        Some(target) if all.iter().any(|known| known == target) => vec![target.to_owned()],
        Some(target) => {
            return Err(format!(
                "there is no fuzz target `{target}`, but {}",
                all.join(", ")
            ));
        }
    };
    fuzz(dirs, &wanted, Length::Seconds(seconds))
}

/// Lints the targets, and runs each on inputs that are the same each time.
pub(crate) fn smoke(dirs: &Dirs) -> Outcome {
    // They belong to no workspace, so that no other step lints them.
    cargo(dirs, "clippy")?
        .args("--all-targets -- -D warnings")
        .run()?;
    fuzz(dirs, &targets()?, Length::Inputs(INPUTS))
}

fn fuzz(dirs: &Dirs, targets: &[String], length: Length) -> Outcome {
    cargo(dirs, "build")?.args("--bins").run()?;
    for target in targets {
        fuzz_one(dirs, target, length)?;
    }
    Ok(())
}

/// Cargo for the targets. With `--target`, the flags do not reach build scripts and macros.
fn cargo(dirs: &Dirs, command: &str) -> Outcome<Cmd> {
    Ok(Cmd::new("cargo")
        .arg(command)
        .args("--release --locked --manifest-path")
        .arg(MANIFEST)
        .arg("--target")
        .arg(host()?)
        .arg("--target-dir")
        .arg(dirs.target.join("fuzz"))
        .env("RUSTFLAGS", FLAGS))
}

fn host() -> Outcome<String> {
    Cmd::new("rustc --print host-tuple").stdout()
}

fn targets() -> Outcome<Vec<String>> {
    names(Path::new(TARGETS)).map_err(|error| format!("cannot read {TARGETS}: {error}"))
}

/// What the files in a directory are called without `.rs`, in the order of the alphabet.
fn names(directory: &Path) -> std::io::Result<Vec<String>> {
    let mut names: Vec<String> = fs::read_dir(directory)?
        .flatten()
        .filter_map(|entry| Some(entry.path().file_stem()?.to_str()?.to_owned()))
        .collect();
    names.sort_unstable();
    Ok(names)
}

fn fuzz_one(dirs: &Dirs, target: &str, length: Length) -> Outcome {
    let directory = dirs.target.join("fuzz");
    let program = directory.join(host()?).join("release").join(target);
    // libFuzzer keeps what reaches something new in the first directory that it is given.
    let (kept, how_long) = match length {
        Length::Seconds(seconds) => ("corpus", format!("-max_total_time={seconds}")),
        // What is compared would not be the same each time: addresses are among it.
        Length::Inputs(inputs) => (
            "same",
            format!("-seed=1 -use_cmp=0 -reload=0 -runs={inputs}"),
        ),
    };
    let kept = directory.join(kept).join(target);
    if let Length::Inputs(_) = length
        && kept.exists()
    {
        fs::remove_dir_all(&kept)
            .map_err(|error| format!("cannot remove {}: {error}", kept.display()))?;
    }
    let findings = directory.join("findings").join(target);
    for path in [&kept, &findings] {
        fs::create_dir_all(path)
            .map_err(|error| format!("cannot make {}: {error}", path.display()))?;
    }
    let run = Cmd::program(&program)
        .args(&how_long)
        .arg(HANGS_AFTER)
        .arg(format!("-artifact_prefix={}/", findings.display()))
        .arg(&kept)
        .arg(Path::new("fuzz/corpus").join(target));
    println!("$ {run}");
    let (success, _, said) = run.capture()?;
    if success {
        println!("{target}: {}", summary(&said).unwrap_or("ended"));
        return Ok(());
    }
    Err(match finding(&said) {
        Some(input) => {
            let again = Cmd::program(&program).arg(&input);
            let shorter = Cmd::program(&program)
                .args("-minimize_crash=1 -runs=100000")
                .arg(&input);
            format!(
                "fuzz target `{target}` has found a broken promise:\n{}\n\
                 The input is {}. To run it again:\n    {again}\n\
                 To look for a shorter one:\n    {shorter}",
                complaint(&said),
                input.display(),
            )
        }
        None => format!("`{run}` failed:\n{said}"),
    })
}

/// `#1464243 DONE cov: 2258 ft: 7501 corp: 2451/155Kb …`: inputs tried, places in the code reached,
/// and inputs that reached something new.
fn summary(said: &str) -> Option<&str> {
    let line = said.lines().rfind(|line| line.contains("DONE"))?;
    let end = line
        .find(" lim:")
        .or(line.find(" exec/s"))
        .unwrap_or(line.len());
    line.get(..end)
}

/// The input that libFuzzer kept.
fn finding(said: &str) -> Option<PathBuf> {
    let (_, path) = said.rsplit_once("Test unit written to ")?;
    path.lines().next().map(PathBuf::from)
}

/// What a panic says, without the backtrace; for a hang or too much memory, libFuzzer's words.
fn complaint(said: &str) -> String {
    let said = match said.find("panicked at ") {
        Some(panic) => said.get(panic..).unwrap_or_default(),
        None => said
            .find("ERROR: libFuzzer")
            .map_or(said, |error| said.get(error..).unwrap_or_default()),
    };
    let end = |line: &&str| {
        !line.starts_with("stack backtrace")
            && !line.starts_with("note: ")
            && !line.starts_with("==")
    };
    let lines: Vec<String> = said
        .lines()
        .take_while(end)
        .take(20)
        .map(|line| format!("    {line}"))
        .collect();
    lines.join("\n")
}

/// The target, if one is named, and the seconds for each.
fn chosen(args: &[String]) -> Outcome<(Option<&str>, u32)> {
    let (mut target, mut seconds) = (None, SECONDS);
    let mut words = args.iter().map(String::as_str);
    while let Some(word) = words.next() {
        match word {
            "--seconds" => {
                let number = words.next().unwrap_or_default();
                seconds = number
                    .parse()
                    .ok()
                    .filter(|seconds| *seconds > 0)
                    .ok_or(format!(
                        "`--seconds` needs a whole number from 1, not `{number}`"
                    ))?;
            }
            name if target.is_none() && !name.starts_with('-') => target = Some(name),
            _ => {
                return Err(format!(
                    "`cargo xtask fuzz` does not know `{word}`; it takes a target's name and \
                     `--seconds N`"
                ));
            }
        }
    }
    Ok((target, seconds))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn chosen(words: &[&str]) -> Outcome<(Option<String>, u32)> {
        let args: Vec<String> = words.iter().map(|&word| word.to_owned()).collect();
        super::chosen(&args).map(|(target, seconds)| (target.map(str::to_owned), seconds))
    }

    #[test]
    fn a_target_and_its_time_can_be_chosen() {
        assert_eq!(chosen(&[]), Ok((None, SECONDS)));
        let goal = Some("goal".to_owned());
        assert_eq!(chosen(&["goal"]), Ok((goal.clone(), SECONDS)));
        assert_eq!(chosen(&["--seconds", "60", "goal"]), Ok((goal, 60)));
    }

    #[test]
    fn a_mistake_names_what_would_be_right() {
        assert!(
            chosen(&["--seconds", "x"])
                .unwrap_err()
                .contains("whole number")
        );
        assert!(chosen(&["--seconds", "0"]).unwrap_err().contains("from 1"));
        assert!(chosen(&["--second"]).unwrap_err().contains("--seconds N"));
        assert!(chosen(&["goal", "spec"]).unwrap_err().contains("`spec`"));
    }

    #[test]
    fn every_target_is_built_has_a_corpus_and_is_documented() {
        let fuzz = Path::new(env!("CARGO_MANIFEST_DIR")).join("../fuzz");
        let read = |name: &str| fs::read_to_string(fuzz.join(name)).unwrap();
        let (manifest, readme) = (read("Cargo.toml"), read("README.md"));
        let targets = names(&fuzz.join("fuzz_targets")).unwrap();
        assert!(targets.len() > 5, "{targets:?}");
        for target in targets {
            assert!(manifest.contains(&format!("name = \"{target}\"\npath = \"fuzz_targets/")));
            assert!(readme.contains(&format!("\n| `{target}` |")), "{target}");
            assert!(fuzz.join("corpus").join(&target).is_dir(), "{target}");
        }
    }

    #[test]
    fn a_run_is_told_in_a_line_and_a_finding_with_its_input() {
        let done =
            "#2\tINITED cov: 8\n#147\tDONE   cov: 14 ft: 94 corp: 2/7Kb lim: 9 exec/s: 3\nDone";
        assert_eq!(
            summary(done),
            Some("#147\tDONE   cov: 14 ft: 94 corp: 2/7Kb")
        );
        let crash = "#3\tNEW\n\nthread '<unnamed>' (1) panicked at src/link.rs:3:9:\nno frame\n\
                     stack backtrace:\n   0: x\n==1== ERROR: libFuzzer: deadly signal\n\
                     prefix='a/'; Test unit written to a/crash-1\nBase64: AA==\n";
        assert_eq!(finding(crash), Some(PathBuf::from("a/crash-1")));
        assert_eq!(
            complaint(crash),
            "    panicked at src/link.rs:3:9:\n    no frame"
        );
        let hang = "#3\tNEW\n==1== ERROR: libFuzzer: timeout after 25 seconds\n    #0 x\n";
        assert!(complaint(hang).starts_with("    ERROR: libFuzzer: timeout"));
    }
}
