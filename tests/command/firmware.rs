//! Keys for firmware, and signed images.

use std::fs;
use std::process::Command;

use ztl_tests::lab::{Ended, Process, Scratch, ztl};

/// Runs a command of `ztl firmware`, with its stdout in a file.
#[track_caller]
fn into(scratch: &Scratch, file: &str, words: &[&str]) -> Ended {
    let ztl = ztl();
    let mut sh = Command::new("sh");
    sh.args(["-c", "out=$1; shift; exec \"$@\" > \"$out\"", "sh"]);
    sh.arg(scratch.path(file)).arg(ztl.get_program());
    sh.args(ztl.get_args()).arg("firmware").args(words);
    sh.current_dir(scratch.path(""));
    Process::run(&mut sh)
}

#[track_caller]
fn firmware(scratch: &Scratch, words: &[&str]) -> Ended {
    let mut ztl = ztl();
    Process::run(
        ztl.arg("firmware")
            .args(words)
            .current_dir(scratch.path("")),
    )
}

#[test]
fn a_signed_image_is_shown_and_verified_and_any_change_is_found() {
    let scratch = Scratch::new();
    for name in ["lab", "other"] {
        let made = firmware(&scratch, &["keygen", name]);
        assert_eq!(made.code, Some(0), "{made:?}");
    }
    let again = firmware(&scratch, &["keygen", "lab"]);
    assert_eq!(again.code, Some(1));
    assert!(
        again
            .stderr
            .contains("lab.firmware_secret is there already"),
        "{again:?}"
    );
    fs::write(scratch.path("image.bin"), [7; 100]).expect("a file");
    let words = [
        "-k",
        "lab.firmware_secret",
        "--board",
        "desk-1",
        "--version",
        "1.2.3",
    ];
    let signed = into(
        &scratch,
        "file",
        &[&["sign", "image.bin"], words.as_slice()].concat(),
    );
    assert_eq!(signed.code, Some(0), "{signed:?}");
    let shown = firmware(&scratch, &["show", "file", "-k", "lab.firmware_key"]);
    let text = "board    desk-1\nversion  1.2.3\nimage    128 bytes\nsigned   with this key\n";
    assert_eq!(
        (shown.code, shown.stdout.as_str()),
        (Some(0), text),
        "{shown:?}"
    );

    let verify = |file: &str, key: &str, text: &str| {
        let shown = firmware(&scratch, &["show", file, "-k", key]);
        assert_eq!(shown.code, Some(1), "{shown:?}");
        assert!(shown.stderr.contains(text), "{shown:?}");
    };
    verify(
        "file",
        "other.firmware_key",
        "the signature is not one of other.firmware_key",
    );
    verify("file", "lab.firmware_secret", "expected a key of 32 bytes");
    verify("image.bin", "lab.firmware_key", "too short for a manifest");
    let file = fs::read(scratch.path("file")).expect("a file");
    // The version, the board, the signature, the image.
    for at in [6, 16, 50, 150] {
        let mut altered = file.clone();
        altered[at] ^= 1;
        fs::write(scratch.path("altered"), altered).expect("a file");
        verify(
            "altered",
            "lab.firmware_key",
            "the signature is not one of lab.firmware_key",
        );
    }
    fs::write(scratch.path("cut"), &file[..200]).expect("a file");
    verify(
        "cut",
        "lab.firmware_key",
        "the manifest says 128 bytes of image, but 96 follow it",
    );
}

#[test]
fn what_cannot_be_signed_is_named() {
    let scratch = Scratch::new();
    assert_eq!(firmware(&scratch, &["keygen", "lab"]).code, Some(0));
    let sign = |content: &[u8], key: &str, board: &str, text: &str| {
        fs::write(scratch.path("image"), content).expect("a file");
        let words = [
            "sign",
            "image",
            "-k",
            key,
            "--board",
            board,
            "--version",
            "1.0.0",
        ];
        let ended = into(&scratch, "file", &words);
        assert_eq!(ended.code, Some(1), "{ended:?}");
        assert!(ended.stderr.contains(text), "{ended:?}");
    };
    let secret = "lab.firmware_secret";
    sign(b"\x7fELF...", secret, "desk", "objcopy -O binary");
    sign(b"", secret, "desk", "empty image");
    sign(b"x", secret, "a desk", "the board's name is not");
    sign(
        b"x",
        "lab.firmware_key",
        "desk",
        "expected 64 hexadecimal digits",
    );
    sign(
        b"x",
        "no.firmware_secret",
        "desk",
        "no.firmware_secret: No such file",
    );
}

#[cfg(unix)]
#[test]
fn signing_with_a_key_that_others_can_read_causes_a_warning() {
    use std::os::unix::fs::PermissionsExt;

    let scratch = Scratch::new();
    assert_eq!(firmware(&scratch, &["keygen", "lab"]).code, Some(0));
    fs::write(scratch.path("image"), "x").expect("a file");
    let key = "lab.firmware_secret";
    let line = format!("sign image -k {key} --board desk --version 1.0.0");
    let words: Vec<&str> = line.split(' ').collect();
    for (mode, said) in [
        (0o600, String::new()),
        (
            0o644,
            format!(
                "ztl: warning: {key}: others can use this secret key (mode 644); run: chmod 600 {key}\n"
            ),
        ),
    ] {
        let rights = fs::Permissions::from_mode(mode);
        fs::set_permissions(scratch.path(key), rights).expect("to change its rights");
        let ended = into(&scratch, "file", &words);
        assert_eq!((ended.code, ended.stderr), (Some(0), said));
    }
}
