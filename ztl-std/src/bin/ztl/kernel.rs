//! On which kernels this program runs.

/// The oldest kernel whose system calls are enough.
const OLDEST: (u32, u32, u32) = (2, 6, 32);

/// What is wrong with the kernel that runs, if it is too old.
pub(crate) fn is_too_old() -> Option<String> {
    too_old(&rustix::system::uname().release().to_string_lossy())
}

/// The numbers of a kernel's release, as `3.2.0-4-amd64`.
fn numbers(release: &str) -> Option<(u32, u32, u32)> {
    let mut parts = release.split(['.', '-', '+']).map(str::parse::<u32>);
    let (major, minor) = (parts.next()?.ok()?, parts.next()?.ok()?);
    Some((major, minor, parts.next().and_then(Result::ok).unwrap_or(0)))
}

/// What is wrong with a kernel, if it is too old.
pub(crate) fn too_old(release: &str) -> Option<String> {
    let (major, minor, patch) = OLDEST;
    (numbers(release)? < OLDEST)
        .then(|| format!("this is Linux {release}, and ztl needs {major}.{minor}.{patch} or newer"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn kernels_are_told_apart_by_their_numbers() {
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
        // A release of nobody's making is no reason to stop.
        assert_eq!(too_old("unknown"), None);
        let said = too_old("2.6.18-164.el5").expect("too old");
        assert_eq!(
            said,
            "this is Linux 2.6.18-164.el5, and ztl needs 2.6.32 or newer"
        );
        assert!(too_old("2.4.20").is_some());
    }
}
