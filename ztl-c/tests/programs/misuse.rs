//! Programs that do what they should not, in the wrong order, and from many threads.

use std::process::Command;

use ztl_tests::lab::{Process, Scratch, ztl};

use crate::build::{Build, ended_well};

#[track_caller]
fn prints(command: &mut Command) -> String {
    ended_well(Process::start(command))
}

#[track_caller]
pub(crate) fn is_said(build: Build) {
    assert_eq!(prints(&mut build.test("border.c")), "all is said\n");
    assert_eq!(prints(build.test("border.c").arg("log")), "all is said\n");
}

#[track_caller]
pub(crate) fn of_many_threads(build: Build) {
    let mut threads = build.test("threads.c");
    assert_eq!(prints(&mut threads), "all have ended\n");
}

#[track_caller]
pub(crate) fn of_keys(build: Build) {
    let keys = Scratch::new();
    for name in ["robot", "ann", "bob", "eve"] {
        let ended = Process::run(ztl().arg("keys").arg(keys.path(name)));
        assert_eq!(ended.code, Some(0), "{}", ended.stderr);
    }
    let printed = prints(build.test("keys.c").arg(keys.path("")));
    let mut lines = printed.lines();
    let first = lines.next().unwrap_or_default();
    assert!(first.contains("none.key_secret: "), "{printed}");
    let told: Vec<String> = lines
        .map(|line| line.split(':').next().unwrap_or_default().to_owned())
        .collect();
    assert_eq!(
        told,
        [
            "ann.key_secret /one ZTL_OK",
            "ann.key_secret /two ZTL_OK",
            "bob.key_secret /one ZTL_OK",
            "bob.key_secret /two ZTL_E_REFUSED",
            "eve.key_secret /one ZTL_E_NOT_CONNECTED",
            "nobody /one ZTL_E_NOT_CONNECTED",
        ]
    );
}

#[test]
fn a_cpp_program_can_use_its_own_libzmq() {
    for build in [Build::C89, Build::Shared] {
        let told = prints(&mut build.test("beside.cpp"));
        assert_eq!(told, "FAILED no hands 1 129\n");
    }
}
