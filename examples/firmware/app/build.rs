//! What is logged, unless DEFMT_LOG says otherwise. Without either, defmt leaves out all but errors.

fn main() {
    println!("cargo::rerun-if-env-changed=DEFMT_LOG");
    if std::env::var_os("DEFMT_LOG").is_none() {
        println!("cargo::rustc-env=DEFMT_LOG=info");
    }
}
