//! Build script of the boards with `cortex-m-rt`: tells the linker where the board's memory is. An image with a `memory.x` of
//! its own, beside its `main.rs`, has that.

fn main() {
    let directory = std::env::var("CARGO_MANIFEST_DIR").unwrap_or_default();
    println!("cargo::rerun-if-changed=memory.x");
    println!("cargo::rerun-if-changed=device.x");
    println!("cargo::rerun-if-changed=src/bin");
    let package = std::env::var("CARGO_PKG_NAME").unwrap_or_default();
    for image in std::fs::read_dir("src/bin").into_iter().flatten().flatten() {
        if image.path().join("memory.x").exists() {
            let (name, path) = (image.file_name(), image.path());
            let (name, path) = (name.display(), path.display());
            println!("cargo::rerun-if-changed={path}/memory.x");
            println!("cargo::rustc-link-arg-bin={package}-{name}=-L{directory}/{path}");
        }
    }
    println!("cargo::rustc-link-arg-bins=-L{directory}");
    println!("cargo::rustc-link-arg-bins=--nmagic");
    println!("cargo::rustc-link-arg-bins=-Tlink.x");
    if std::env::var_os("CARGO_FEATURE_DEFMT").is_some() {
        println!("cargo::rustc-link-arg-bins=-Tdefmt.x");
    }
}
