//! The programs under test and the installations that tests need, below the target directory.

use std::collections::HashSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::{LazyLock, Mutex};
use std::time::SystemTime;

/// The path of a program in the profile's directory, such as `ztl` or `examples/sensor`.
///
/// # Panics
/// When the program is missing, or older than its sources: `cargo test` builds the libraries and the tests, but
/// not the programs that the tests start.
#[track_caller]
pub fn built(name: &str) -> PathBuf {
    // This test is in <target>/<profile>/deps, wherever CARGO_TARGET_DIR or a configuration puts that.
    let profile = ancestor(2);
    let path = profile.join(name);
    let options = match profile.file_name().and_then(|name| name.to_str()) {
        None | Some("debug") => String::new(),
        Some("release") => " --release".to_owned(),
        Some(other) => format!(" --profile {other}"),
    };
    let command = format!("cargo build --workspace --bins --examples{options}");
    assert_fresh(&path, &command);
    path
}

/// Checks a program against the sources that Cargo lists for it, once in each test process. `build` is the command
/// that builds it.
///
/// # Panics
/// When the program is missing or stale.
#[track_caller]
pub(super) fn assert_fresh(program: &Path, build: &str) {
    static FRESH: LazyLock<Mutex<HashSet<PathBuf>>> = LazyLock::new(Mutex::default);
    if FRESH.lock().unwrap().contains(program) {
        return;
    }
    if let Some(reason) = stale(program) {
        panic!("{} {reason}: run `{build}`", program.display());
    }
    FRESH.lock().unwrap().insert(program.to_owned());
}

/// Why a program does not match its sources, if so. Compares times as Cargo does.
fn stale(program: &Path) -> Option<String> {
    let modified = |path: &Path| fs::metadata(path).and_then(|about| about.modified());
    let Ok(built) = modified(program) else {
        return Some("is missing".to_owned());
    };
    let listed = fs::read_to_string(program.with_extension("d")).unwrap_or_default();
    let Some(sources) = sources(&listed, program) else {
        return Some("was not built here".to_owned());
    };
    let newer = |source: &PathBuf| modified(source).unwrap_or_else(|_| SystemTime::now()) > built;
    let source = sources.into_iter().find(newer)?;
    Some(format!("is older than {}", source.display()))
}

/// The sources that a dep-info file lists: `program: source source`, with `\` before a space in a path. `None` when
/// the file is about another program, as in a target directory that was copied.
fn sources(listed: &str, program: &Path) -> Option<Vec<PathBuf>> {
    let escaped = program.to_str()?.replace(' ', "\\ ");
    let list = listed.lines().next()?.strip_prefix(&escaped)?;
    let list = list.strip_prefix(':')?.replace("\\ ", "\0");
    let paths = list.split_whitespace();
    Some(paths.map(|path| path.replace('\0', " ").into()).collect())
}

/// Something that `cargo xtask setup` installs: where `variable` says, or else in the target directory.
///
/// # Panics
/// When it is missing. A test is never skipped silently.
#[track_caller]
pub fn installed(variable: &str, name: &str) -> PathBuf {
    let named = std::env::var_os(variable).filter(|path| !path.is_empty());
    find(named.map(PathBuf::from), name).unwrap_or_else(|message| panic!("{message}"))
}

fn find(named: Option<PathBuf>, name: &str) -> Result<PathBuf, String> {
    // <target>, or above a target directory in the target directory.
    let usual = || [3, 4].map(|levels| ancestor(levels).join(name));
    let candidates = named.map_or_else(|| usual().to_vec(), |path| vec![path]);
    match candidates.iter().find(|path| path.exists()) {
        Some(path) => Ok(path.clone()),
        None => Err(format!(
            "{} is missing: run `cargo xtask setup`",
            candidates[0].display()
        )),
    }
}

/// The directory this many levels above this test's program.
pub(super) fn ancestor(levels: usize) -> PathBuf {
    let program = std::env::current_exe().expect("this program's path");
    let directory = program.ancestors().nth(levels);
    directory.expect("cargo puts tests below target").to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lab::Scratch;

    #[test]
    fn a_program_older_than_a_source_is_refused() {
        let scratch = Scratch::new();
        let [program, source] = ["ztl", "a source.rs"].map(|name| scratch.path(name));
        let list = |program: &Path, source: &Path| {
            let [program, source] =
                [program, source].map(|path| path.to_str().unwrap().replace(' ', "\\ "));
            fs::write(scratch.path("ztl.d"), format!("{program}: {source}\n")).unwrap();
        };
        assert_eq!(stale(&program).as_deref(), Some("is missing"));
        fs::write(&source, "").unwrap();
        let program_file = fs::File::create(&program).unwrap();
        assert_eq!(stale(&program).as_deref(), Some("was not built here"));
        list(&program, &source);
        assert_eq!(stale(&program), None);
        assert_fresh(&program, "cargo build");

        let before = SystemTime::now() - std::time::Duration::from_secs(60);
        program_file.set_modified(before).unwrap();
        let reason = format!("is older than {}", source.display());
        assert_eq!(stale(&program), Some(reason));
        // A build that does not know of a removed source is stale too.
        program_file.set_modified(SystemTime::now()).unwrap();
        list(&program, &scratch.path("removed.rs"));
        assert!(stale(&program).is_some_and(|reason| reason.ends_with("removed.rs")));
        // A copied target directory lists the sources of another checkout.
        list(&scratch.path("elsewhere/ztl"), &source);
        assert_eq!(stale(&program).as_deref(), Some("was not built here"));
    }

    #[test]
    fn a_missing_installation_fails_and_names_the_command() {
        assert_eq!(find(Some("/".into()), "venv"), Ok("/".into()));
        let lacking = "/no/such/python is missing: run `cargo xtask setup`";
        let found = find(Some("/no/such/python".into()), "venv");
        assert_eq!(found, Err(lacking.to_owned()));
        assert!(find(None, "no/such/thing").is_err());
    }
}
