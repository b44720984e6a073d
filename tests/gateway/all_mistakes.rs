//! `ztl gateway --check` reports all mistakes of a file at once, each at its place.

use ztl_tests::lab::{Ended, Process, Scratch, ztl};

/// Checks a file; returns what is said about it, without its name.
#[track_caller]
fn checked(scratch: &Scratch, text: &str, options: &[&str]) -> (Ended, Vec<String>) {
    let file = scratch.path("lab.yaml");
    std::fs::write(&file, text).expect("to write");
    let mut command = ztl();
    command
        .arg("gateway")
        .arg(&file)
        .arg("--check")
        .args(options);
    let ended = Process::run(&mut command);
    let name = format!("{}:", file.display());
    let lines = ended.stderr.lines();
    let said = lines.filter_map(|line| line.strip_prefix(&name));
    let said = said.map(str::to_owned).collect();
    (ended, said)
}

#[track_caller]
fn assert_places(said: &[String], expected: &[&str]) {
    assert_eq!(said.len(), expected.len(), "{said:#?}");
    for (said, expected) in said.iter().zip(expected) {
        assert!(said.starts_with(expected), "{expected}: {said}");
    }
}

#[test]
fn the_check_reports_all_mistakes_of_a_file_at_once() {
    let scratch = Scratch::new();
    std::fs::write(scratch.path("bad.elf"), "no firmware").expect("to write");
    let text = "\
scope: /lab
prot: 5
key: nokey.key_secret
client-keys: [/lab=anna.key, bert.key]
bind: 192.0.2.1
journal: /proc/x
devices:
  head: {url: 'tcp:localhost:1', elf: no.elf}
  arm: {url: 'tcp:localhost:2', elf: bad.elf}
  bad: usb:1
";
    let (ended, said) = checked(&scratch, text, &[]);
    assert_eq!(ended.code, Some(2), "{ended:?}");
    let expected = [
        "2:1: unknown key 'prot'; did you mean 'port'?",
        "3:6: ",
        "4:15: ",
        "4:30: ",
        "5:7: cannot listen at tcp://192.0.2.1:0: this machine does not have the address",
        "6:10: the journal cannot lie at /proc/x",
        "8:39: there is no file ",
        "9:38: the firmware of 'arm', ",
        "10:8: unknown kind of device 'usb'",
    ];
    assert_places(&said, &expected);
    assert!(
        said[1].contains("nokey.key_secret: No such file"),
        "{said:?}"
    );
    assert!(said[2].contains("anna.key: No such file"), "{said:?}");
    assert!(said[3].contains("bert.key: No such file"), "{said:?}");
    // Everything that is said has its place.
    assert!(!ended.stderr.contains("ztl:"), "{}", ended.stderr);
}

#[test]
fn an_option_is_not_blamed_on_the_file() {
    let scratch = Scratch::new();
    let text = "\
scope: /lab
port: 0
key: nokey.key_secret
bind: 192.0.2.1
journal: /proc/x
devices: {head: sim:head}
";
    let options = [
        "--bind",
        "198.51.100.1",
        "--no-journal",
        "--key",
        "other.key_secret",
    ];
    let (ended, said) = checked(&scratch, text, &options);
    assert_eq!(said, [""; 0], "{ended:?}");
    for part in [
        "ztl: cannot listen at tcp://198.51.100.1:0",
        "ztl: other.key_secret: ",
    ] {
        assert!(ended.stderr.contains(part), "{part}: {ended:?}");
    }
    assert_eq!(ended.code, Some(2), "{ended:?}");
}
