//! What this program was built from, and on which kernels it runs.

use std::sync::LazyLock;

/// The oldest kernel whose system calls are enough.
pub(crate) const OLDEST_KERNEL: (u32, u32, u32) = (2, 6, 32);

/// What it was built from what, for `--version`.
pub(crate) fn version() -> &'static str {
    static VERSION: LazyLock<String> = LazyLock::new(|| {
        let (major, minor, patch) = zmq::version();
        let encrypts = match zmq::has("curve") {
            Some(true) => "with CURVE: it can encrypt",
            _ => "without CURVE: it cannot encrypt",
        };
        format!(
            "{}\ncommit: {}\ntarget: {}\nlibzmq: {major}.{minor}.{patch}, {encrypts}",
            env!("CARGO_PKG_VERSION"),
            option_env!("ZTL_BUILD_COMMIT").unwrap_or("unknown, built by cargo alone"),
            target(),
        )
    });
    &VERSION
}

/// The target, as compilers name it.
pub(crate) fn target() -> String {
    use std::env::consts::{ARCH, OS};
    let plain = || format!("{ARCH}-{OS}");
    option_env!("ZTL_BUILD_TARGET").map_or_else(plain, str::to_owned)
}

/// Whether this is a static program, with a resolver for names of its own.
pub(crate) const fn is_static() -> bool {
    cfg!(target_env = "musl")
}

/// The numbers of a kernel's release, as `3.2.0-4-amd64`.
pub(crate) fn kernel(release: &str) -> Option<(u32, u32, u32)> {
    let mut parts = release.split(['.', '-', '+']).map(str::parse::<u32>);
    let (major, minor) = (parts.next()?.ok()?, parts.next()?.ok()?);
    Some((major, minor, parts.next().and_then(Result::ok).unwrap_or(0)))
}

/// What is wrong with a kernel, if it is too old.
pub(crate) fn too_old(release: &str) -> Option<String> {
    let (major, minor, patch) = OLDEST_KERNEL;
    (kernel(release)? < OLDEST_KERNEL)
        .then(|| format!("this is Linux {release}, and ztl needs {major}.{minor}.{patch} or newer"))
}

/// The same of the kernel that runs.
#[cfg(target_os = "linux")]
pub(crate) fn kernel_is_too_old() -> Option<String> {
    too_old(&rustix::system::uname().release().to_string_lossy())
}

#[cfg(not(target_os = "linux"))]
pub(crate) fn kernel_is_too_old() -> Option<String> {
    None
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
