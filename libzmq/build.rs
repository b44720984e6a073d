//! Compiles libzmq against the libsodium that `libsodium-sys-stable` has compiled, and says where
//! both are.

use std::env;
use std::path::PathBuf;

fn main() {
    let path = |name: &str| env::var_os(name).map(PathBuf::from);
    let (Some(lib), Some(include)) = (path("DEP_SODIUM_LIB"), path("DEP_SODIUM_INCLUDE")) else {
        panic!("libsodium-sys-stable has not said where its library is");
    };
    let sodium = zeromq_src::LibLocation::new(&lib, &include);
    zeromq_src::Build::new()
        .with_libsodium(Some(sodium))
        .build();
    let zmq = path("OUT_DIR").unwrap_or_default().join("lib");
    println!("cargo:rustc-env=ZTL_ZMQ={}", zmq.display());
    println!("cargo:rustc-env=ZTL_SODIUM={}", lib.display());
}
