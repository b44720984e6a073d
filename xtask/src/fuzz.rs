//! `cargo xtask fuzz`: runs each fuzz target for some seconds, starting with its corpus.
//!
//! Does not use cargo-fuzz, which must be installed and needs a nightly compiler. Coverage counters are an
//! ordinary LLVM pass, which a stable compiler accepts through `-C`. Nightly is only needed for sanitizers,
//! which find nothing in code without `unsafe`. The crate `libfuzzer-sys` contains libFuzzer and compiles it.

use std::fs;
use std::path::{Path, PathBuf};

use crate::Dirs;
use crate::cmd::{Cmd, Outcome};

/// The package of the targets, which is not in the workspace.
pub(crate) const MANIFEST: &str = "fuzz/Cargo.toml";

const TARGETS: &str = "fuzz/fuzz_targets";

/// Default seconds per target.
const SECONDS: u32 = 5;

/// Inputs per target in the test command: a few seconds.
const INPUTS: u32 = 30_000;

/// How long a target runs.
#[derive(Clone, Copy)]
enum Length {
    /// Continues from earlier findings, to find more.
    Seconds(u32),
    /// The same inputs every time, from the committed corpus: the result depends only on the code.
    Inputs(u32),
}

/// An input takes less than a millisecond. After this time it hangs, even on a busy machine.
const HANGS_AFTER: &str = "-timeout=25";

/// The flags of cargo-fuzz, without the sanitizer.
const FLAGS: &str = "-Cpasses=sancov-module -Cllvm-args=-sanitizer-coverage-level=4 \
    -Cllvm-args=-sanitizer-coverage-inline-8bit-counters -Cllvm-args=-sanitizer-coverage-pc-table \
    -Cllvm-args=-sanitizer-coverage-trace-compares --cfg=fuzzing";

/// Runs the named target, or all.
pub(crate) fn run(dirs: &Dirs, args: &[String]) -> Outcome {
    let (target, seconds) = chosen(args)?;
    let all = targets()?;
    let wanted = match target {
        None => all,
        Some(target) if all.iter().any(|known| known == target) => vec![target.to_owned()],
        Some(target) => {
            return Err(format!(
                "unknown fuzz target `{target}`: expected one of {}",
                all.join(", ")
            ));
        }
    };
    fuzz(dirs, &wanted, Length::Seconds(seconds))
}

/// Lints the targets, and runs each on the same inputs every time.
pub(crate) fn smoke(dirs: &Dirs) -> Outcome {
    // They are not in the workspace, so no other step lints them.
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

/// The names of the files in a directory, without `.rs`, sorted.
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
    // libFuzzer stores inputs that reach new code in the first directory that it gets.
    let (kept, how_long) = match length {
        Length::Seconds(seconds) => ("corpus", format!("-max_total_time={seconds}")),
        // Without comparison tracing, which records addresses that differ in every run.
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

/// From `#1464243 DONE cov: 2258 ft: 7501 corp: 2451/155Kb …`: number of inputs, code locations reached, and
/// inputs that reached new code.
fn summary(said: &str) -> Option<&str> {
    let line = said.lines().rfind(|line| line.contains("DONE"))?;
    let end = line
        .find(" lim:")
        .or(line.find(" exec/s"))
        .unwrap_or(line.len());
    line.get(..end)
}

/// The input that libFuzzer saved.
fn finding(said: &str) -> Option<PathBuf> {
    let (_, path) = said.rsplit_once("Test unit written to ")?;
    path.lines().next().map(PathBuf::from)
}

/// A panic's message without the backtrace; for a hang or excessive memory, libFuzzer's message.
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

/// The named target, if any, and the seconds for each.
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
                        "invalid value `{number}` for `--seconds`: expected an integer of at least 1"
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
    fn errors_say_what_is_expected() {
        assert!(
            chosen(&["--seconds", "x"])
                .unwrap_err()
                .contains("an integer")
        );
        assert!(
            chosen(&["--seconds", "0"])
                .unwrap_err()
                .contains("at least 1")
        );
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
    fn a_run_is_summarised_and_a_finding_names_its_input() {
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
