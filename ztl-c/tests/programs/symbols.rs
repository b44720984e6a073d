//! The libraries' exported symbols.

use std::process::Command;

use object::read::archive::ArchiveFile;
use object::{Object, ObjectSymbol};
use ztl_tests::lab::Process;

use crate::build::library;

/// The exported symbols defined in this library.
fn seen(object: &object::File<'_>, names: &mut Vec<String>) {
    let symbols = object.symbols().chain(object.dynamic_symbols());
    for symbol in symbols.filter(|symbol| symbol.is_global() && symbol.is_definition()) {
        names.push(symbol.name().expect("a name").to_owned());
    }
}

#[track_caller]
fn assert_is_ours(what: &str, names: &[String], least: usize) {
    let foreign: Vec<_> = names
        .iter()
        .filter(|name| !name.starts_with("ztl_"))
        .collect();
    assert!(foreign.is_empty(), "{what} also shows {foreign:?}");
    assert!(names.len() >= least, "{what} shows only {names:?}");
}

#[test]
fn only_the_headers_functions_are_exported() {
    let lib = library().join("lib");
    for (name, least) in [("libztl.a", 40), ("libztl_node.a", 10)] {
        let bytes = std::fs::read(lib.join(name)).expect("a static library");
        let archive = ArchiveFile::parse(&*bytes).expect("an archive");
        let mut names = Vec::new();
        for member in archive.members() {
            let member = member.expect("a member").data(&*bytes).expect("its bytes");
            seen(&object::File::parse(member).expect("an object"), &mut names);
        }
        assert_is_ours(name, &names, least);
    }

    let bytes = std::fs::read(lib.join("libztl.so")).expect("the shared library");
    let mut names = Vec::new();
    seen(
        &object::File::parse(&*bytes).expect("an object"),
        &mut names,
    );
    assert_is_ours("libztl.so", &names, 40);
}

#[test]
fn pkg_config_finds_relocated_libraries() {
    let moved = ztl_tests::lab::Scratch::new();
    let copied = Process::run(
        Command::new("cp")
            .arg("-a")
            .arg(library())
            .arg(moved.path("ztl")),
    );
    assert_eq!(copied.code, Some(0), "{}", copied.stderr);
    let script = "export PKG_CONFIG_PATH=$1/lib/pkgconfig LD_LIBRARY_PATH=$1/lib && \
                  cc $2 $(pkg-config --cflags --libs ztl) -o $1/client && \
                  { $1/client 2>&1; test $? = 3; }";
    let example = crate::build::root().join("examples/c/client.c");
    let mut shell = Command::new("sh");
    shell
        .args(["-c", script, "sh"])
        .arg(moved.path("ztl"))
        .arg(example);
    let ended = Process::run(&mut shell);
    assert_eq!(ended.code, Some(0), "{}", ended.stderr);
    assert!(
        ended.stdout.starts_with("usage: client "),
        "{}",
        ended.stdout
    );
}
