//! The headers are what the code says.

#![expect(clippy::expect_used, reason = "a test says what is wrong by panicking")]

use std::path::Path;

#[track_caller]
fn assert_is_made_of(package: &str, header: &str) {
    let package = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("..")
        .join(package);
    let config = cbindgen::Config::from_file(package.join("cbindgen.toml")).expect("its settings");
    let builder = cbindgen::Builder::new().with_config(config);
    let builder = builder.with_src(package.join("src/lib.rs"));
    let mut made = Vec::new();
    builder.generate().expect("a header").write(&mut made);
    let made = String::from_utf8(made).expect("UTF-8");
    // A number below 0 in brackets, so that it stays one wherever the macro is used.
    let brackets = |line: &str| match line.split_once(" -") {
        Some((define, number)) if define.starts_with("#define") => {
            format!("{define} (-{number})\n")
        }
        _ => format!("{line}\n"),
    };
    let made: String = made.lines().map(brackets).collect();
    let path = package.join("include").join(header);
    if std::env::var_os("ZTL_ACCEPT").is_some() {
        std::fs::write(&path, &made).expect("the header");
    }
    let kept = std::fs::read_to_string(&path).unwrap_or_default();
    let lines = made.lines().zip(kept.lines().chain(std::iter::repeat("")));
    let other = lines.enumerate().find(|(_, (made, kept))| made != kept);
    assert!(
        made == kept,
        "{header} is not what the code says, first at {other:?}; look at the change, then write it by \
         `ZTL_ACCEPT=1 cargo test -p ztl-c --test header`"
    );
}

#[test]
fn the_header_matches_the_code() {
    assert_is_made_of("ztl-c", "ztl.h");
}

#[test]
fn the_nodes_header_matches_the_code() {
    assert_is_made_of("ztl-node-c", "ztl_node.h");
}
