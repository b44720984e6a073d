//! Checks whether the kernel is new enough.

/// The oldest kernel that has all the system calls needed.
const OLDEST: (u32, u32, u32) = (2, 6, 32);

/// An error message if the running kernel is too old.
pub(crate) fn is_too_old() -> Option<String> {
    too_old(&rustix::system::uname().release().to_string_lossy())
}

/// The version in a kernel's release, such as `3.2.0-4-amd64`.
fn numbers(release: &str) -> Option<(u32, u32, u32)> {
    let mut parts = release.split(['.', '-', '+']).map(str::parse::<u32>);
    let (major, minor) = (parts.next()?.ok()?, parts.next()?.ok()?);
    Some((major, minor, parts.next().and_then(Result::ok).unwrap_or(0)))
}

/// An error message if this kernel is too old.
pub(crate) fn too_old(release: &str) -> Option<String> {
    let (major, minor, patch) = OLDEST;
    (numbers(release)? < OLDEST)
        .then(|| format!("Linux {release} is too old: ztl needs {major}.{minor}.{patch} or newer"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn kernels_are_compared_by_version() {
        for fine in [
            "2.6.32",
            "2.6.32-5-686",
            "3.2.0-4-amd64",
            "4.4.0+",
            "6.18.44-fc-v509",
            "10.0",
        ] {
            assert_eq!(too_old(fine), None, "{fine}");
        }
        // An unknown release must not prevent the start.
        assert_eq!(too_old("unknown"), None);
        let said = too_old("2.6.18-164.el5").expect("too old");
        assert_eq!(
            said,
            "Linux 2.6.18-164.el5 is too old: ztl needs 2.6.32 or newer"
        );
        assert!(too_old("2.4.20").is_some());
    }
}
