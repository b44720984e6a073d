//! What this program was built from.

use std::sync::LazyLock;

/// What it was built from what, for `--version`.
pub(crate) fn version() -> &'static str {
    static VERSION: LazyLock<String> = LazyLock::new(|| {
        let (major, minor, patch) = zmq::version();
        let encrypts = match zmq::has("curve") {
            Some(true) => "with CURVE: it can encrypt",
            _ => "without CURVE: it cannot encrypt",
        };
        // Of a release: its compilers and the other libraries in it.
        let with = option_env!("ZTL_BUILD_WITH").map(|with| format!("\nwith: {with}"));
        format!(
            "{}\ncommit: {}\ntarget: {}\nlibzmq: {major}.{minor}.{patch}, {encrypts}{}",
            env!("CARGO_PKG_VERSION"),
            option_env!("ZTL_BUILD_COMMIT").unwrap_or("unknown, built by cargo alone"),
            target(),
            with.unwrap_or_default(),
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
