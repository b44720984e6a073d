//! Tells the linker where the memory layout of the images is.

fn main() {
    let directory = std::env::var("CARGO_MANIFEST_DIR").unwrap_or_default();
    println!("cargo::rerun-if-changed=image.x");
    println!("cargo::rustc-link-arg-bins=-T{directory}/image.x");
}
