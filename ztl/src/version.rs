//! The version and build of this program.

use std::sync::LazyLock;

use ztl_std::Transport;

/// The text of `--version`.
pub(crate) fn text() -> &'static str {
    static VERSION: LazyLock<String> = LazyLock::new(|| {
        let libzmq = Transport::libzmq_version();
        let libzmq = libzmq.map_or_else(
            || "without libzmq".to_owned(),
            |version| format!("also with libzmq {version} (--transport libzmq)"),
        );
        // Compilers and other libraries, in a release.
        let with = option_env!("ZTL_BUILD_WITH").map(|with| format!("\nwith: {with}"));
        format!(
            "{}\ncommit: {}\ntarget: {}\nZeroMQ: ZMTP 3.1 with encryption; {libzmq}{}",
            env!("CARGO_PKG_VERSION"),
            option_env!("ZTL_BUILD_COMMIT").unwrap_or("unknown (built with cargo)"),
            target(),
            with.unwrap_or_default(),
        )
    });
    &VERSION
}

/// The target triple, if known.
pub(crate) fn target() -> String {
    use std::env::consts::{ARCH, OS};
    let plain = || format!("{ARCH}-{OS}");
    option_env!("ZTL_BUILD_TARGET").map_or_else(plain, str::to_owned)
}
