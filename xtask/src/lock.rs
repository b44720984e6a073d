//! Reads Cargo's lock files.

use anyhow::{Result, bail};
use xshell::Shell;

/// An entry of a lock file.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct Package {
    pub(crate) name: String,
    pub(crate) version: String,
    /// Only packages from a registry have one.
    pub(crate) checksum: Option<String>,
}

/// The packages in a lock file's text.
pub(crate) fn packages(lock: &str) -> Vec<Package> {
    let value = |package: &str, key: &str| {
        let mut lines = package.lines();
        let value = lines.find_map(|line| line.strip_prefix(key)?.strip_prefix(" = \""))?;
        Some(value.trim_end_matches('"').to_owned())
    };
    let package = |text: &str| {
        Some(Package {
            name: value(text, "name")?,
            version: value(text, "version")?,
            checksum: value(text, "checksum"),
        })
    };
    lock.split("[[package]]").filter_map(package).collect()
}

/// Checks that a separate workspace uses the same crate versions as the main one, because it has its own lock file.
pub(crate) fn check(sh: &Shell, manifest: &str) -> Result<()> {
    let ours = packages(&sh.read_file(manifest.replace(".toml", ".lock"))?);
    let others = packages(&sh.read_file("Cargo.lock")?);
    if let Some([name, ours, others]) = differing(&ours, &others) {
        bail!(
            "{manifest} locks {name} {ours}, but Cargo.lock locks {others}: run \
             `cargo update --manifest-path {manifest} {name} --precise {others}`"
        );
    }
    Ok(())
}

/// A package that could have the same version in both, but does not: its name and both versions.
fn differing<'a>(ours: &'a [Package], others: &'a [Package]) -> Option<[&'a str; 3]> {
    ours.iter().find_map(|Package { name, version, .. }| {
        let same = others.iter().filter(|other| other.name == *name);
        let mut same = same.map(|other| other.version.as_str());
        match same.clone().any(|other| other == version) {
            true => None,
            false => Some([
                name,
                version,
                same.find(|other| series(other) == series(version))?,
            ]),
        }
    })
}

/// The part of a version that Cargo treats as compatible: `1` of 1.2.3, `0.2` of 0.2.3.
fn series(version: &str) -> &str {
    let parts = if version.starts_with("0.") { 1 } else { 0 };
    let end = version.match_indices('.').nth(parts);
    end.and_then(|(end, _)| version.get(..end))
        .unwrap_or(version)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn locked(list: &[(&str, &str)]) -> Vec<Package> {
        let text = |(name, version): &(&str, &str)| {
            format!("[[package]]\nname = \"{name}\"\nversion = \"{version}\"\n\n")
        };
        packages(&list.iter().map(text).collect::<String>())
    }

    #[test]
    fn compatible_versions_must_be_equal() {
        let others = locked(&[("a", "1.2.3"), ("b", "0.2.7"), ("b", "1.0.0")]);
        assert_eq!(others.len(), 3);
        for fine in [
            locked(&[("a", "1.2.3"), ("c", "7.0.0")]),
            locked(&[("b", "0.2.7"), ("b", "0.3.0")]),
        ] {
            assert_eq!(differing(&fine, &others), None);
        }
        for (name, version, other) in [("a", "1.3.0", "1.2.3"), ("b", "0.2.8", "0.2.7")] {
            let ours = locked(&[(name, version)]);
            assert_eq!(differing(&ours, &others), Some([name, version, other]));
        }
    }
}
