//! Checks that released files do not reveal where they were built.

use std::env;
use std::path::{Path, PathBuf};

use anyhow::{Result, bail};

use crate::project::Project;

/// Fails if the file contains a path of this machine: a directory of the project, of cargo or rustup, or the
/// user's home.
pub(crate) fn check(project: &Project, path: &Path) -> Result<()> {
    let bytes = project.sh.read_binary_file(path)?;
    let variables = ["HOME", "CARGO_HOME", "RUSTUP_HOME", "CARGO_TARGET_DIR"];
    let named = variables.into_iter().filter_map(env::var_os);
    let mut places = vec![project.root.clone(), project.target.clone()];
    places.extend(named.map(PathBuf::from));
    places.retain(|place| place.is_absolute() && place.parent().is_some());
    for place in places {
        if let Some(found) = find(&bytes, &format!("{}/", place.display())) {
            let path = path.display();
            bail!(
                "{path} contains {found}, a path of this machine: xtask/src/zig.rs replaces these"
            );
        }
    }
    Ok(())
}

/// The first path that begins with `place`.
fn find(bytes: &[u8], place: &str) -> Option<String> {
    // A short prefix such as `/src/` is also the end of others, such as `library/src/`. A longer one is
    // unambiguous, and may directly follow other text, because compilers place texts side by side.
    let is_short = place.matches('/').count() == 2;
    let within = |byte: &u8| byte.is_ascii_alphanumeric() || b"._-/".contains(byte);
    let mut from = 0;
    while let Some(rest) = bytes.get(from..) {
        let mut windows = rest.windows(place.len());
        let begin = from + windows.position(|window| window == place.as_bytes())?;
        let before = begin.checked_sub(1).and_then(|before| bytes.get(before));
        if !(is_short && before.is_some_and(within)) {
            let path = bytes.get(begin..)?.iter();
            let path = path.take_while(|byte| byte.is_ascii_graphic()).take(200);
            return Some(path.map(|byte| char::from(*byte)).collect());
        }
        from = begin + place.len();
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_path_is_found_anywhere() {
        let find = |text: &str| find(text.as_bytes(), "/home/me/");
        for text in ["x\0/home/me/a.rs\0y", "no/home/me/a.rs"] {
            assert_eq!(find(text).as_deref(), Some("/home/me/a.rs"));
        }
        assert_eq!(find("/home/men/b"), None);
        assert_eq!(find(""), None);
    }

    #[test]
    fn a_short_path_is_found_only_at_its_start() {
        let find = |text: &str| find(text.as_bytes(), "/src/");
        assert_eq!(find("library/src/a.rs, ztl/src/b.rs"), None);
        assert_eq!(find("ztl/src/a.rs:/src/b.rs").as_deref(), Some("/src/b.rs"));
    }
}
