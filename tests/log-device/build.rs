//! Lays out defmt's texts as it does in firmware.

fn main() {
    // Every level is in the program.
    println!("cargo::rustc-env=DEFMT_LOG=trace");
    let directory = std::env::var("CARGO_MANIFEST_DIR").unwrap_or_default();
    println!("cargo::rerun-if-changed=log.x");
    println!("cargo::rustc-link-arg-bins=-T{directory}/log.x");
    // A text's number is its address, which must not depend on where the program is loaded.
    println!("cargo::rustc-link-arg-bins=-no-pie");
}
