//! Checks that released files do not reveal where they were built.

use std::env;
use std::fs;
use std::path::{Path, PathBuf};

use crate::Dirs;
use crate::cmd::Outcome;

/// Fails if the file contains a path of this machine: a directory of the project, of cargo or rustup, or the
/// user's home.
pub(crate) fn check(dirs: &Dirs, path: &Path) -> Outcome {
    let bytes =
        fs::read(path).map_err(|error| format!("cannot read {}: {error}", path.display()))?;
    let variables = ["HOME", "CARGO_HOME", "RUSTUP_HOME", "CARGO_TARGET_DIR"];
    let told = variables.into_iter().filter_map(env::var_os);
    let mut places = vec![dirs.root.clone(), dirs.root.join(&dirs.target)];
    places.extend(told.map(PathBuf::from));
    places.retain(|place| place.is_absolute() && place.parent().is_some());
    for place in places {
        if let Some(found) = find(&bytes, &format!("{}/", place.display())) {
            return Err(format!(
                "{} tells a path of the machine that built it, {found}; xtask/src/zig.rs says what compilers put \
                 in its place",
                path.display()
            ));
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
        let at = rest
            .windows(place.len())
            .position(|window| window == place.as_bytes())?;
        let begin = from + at;
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
        assert_eq!(
            find("x\0/home/me/a.rs\0y").as_deref(),
            Some("/home/me/a.rs")
        );
        assert_eq!(find("no/home/me/a.rs").as_deref(), Some("/home/me/a.rs"));
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
