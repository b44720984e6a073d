use super::*;
use crate::gateway::journal::entry::Moment;
use crate::gateway::journal::records::JournalRecords;

/// A directory of a test's own.
struct Scratch(PathBuf);

impl Scratch {
    fn new(name: &str) -> Self {
        let name = format!("ztl-journal-{}-{name}", std::process::id());
        let path = std::env::temp_dir().join(name);
        let _ = fs::remove_dir_all(&path);
        Self(path)
    }

    /// In a directory that is not there yet.
    fn journal(&self) -> PathBuf {
        self.0.join("state/gateway.jsonl")
    }

    fn files(&self) -> Vec<String> {
        let entries = fs::read_dir(self.0.join("state")).unwrap();
        let name = |entry: io::Result<fs::DirEntry>| entry.unwrap().file_name();
        let mut names: Vec<_> = entries.map(|e| name(e).into_string().unwrap()).collect();
        names.sort();
        names
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.0);
    }
}

fn read(path: &Path) -> String {
    fs::read_to_string(path).unwrap()
}

/// A line that begins as a journal's.
const ONE: &[u8] = b"{\"event\":\"one\"}\n";

#[test]
fn written_lines_are_in_the_file_and_read_by_the_next_gateway() {
    for sync in [false, true] {
        let scratch = Scratch::new(&format!("lines-{sync}"));
        let path = scratch.journal();
        let (mut file, written) = JournalFile::open(&path).unwrap();
        assert_eq!(written, b"");
        file.add(ONE, sync).unwrap();
        assert_eq!(read(&path), std::str::from_utf8(ONE).unwrap());
        drop(file);
        let (mut file, written) = JournalFile::open(&path).unwrap();
        assert_eq!(written, ONE);
        file.add(b"two\n", sync).unwrap();
        assert_eq!(read(&path), concat!(r#"{"event":"one"}"#, "\ntwo\n"));
    }
}

/// A journal that was opened by this process.
fn opened() -> Vec<u8> {
    JournalRecords::open(Vec::new(), b"", Moment::now(), 7)
        .storage()
        .clone()
}

#[track_caller]
fn is_in_use(path: &Path) {
    let error = JournalFile::open(path).unwrap_err().to_string();
    let process = format!("(process {})", std::process::id());
    assert!(error.contains("is another gateway's"), "{error}");
    assert!(error.contains(&process), "{error}");
}

#[test]
fn a_second_gateway_is_told_who_holds_the_journal() {
    let scratch = Scratch::new("second");
    let path = scratch.journal();
    let (mut first, _) = JournalFile::open(&path).unwrap();
    first.add(&opened(), false).unwrap();
    for _ in 0..2 {
        is_in_use(&path);
        // Also when a new file was begun meanwhile.
        first.replace(&opened()).unwrap();
    }
    drop(first);
    assert!(JournalFile::open(&path).is_ok());
}

#[cfg(unix)]
#[test]
fn a_journal_is_locked_under_each_of_its_names() {
    let scratch = Scratch::new("names");
    let path = scratch.journal();
    let (mut first, _) = JournalFile::open(&path).unwrap();
    first.add(&opened(), false).unwrap();
    let [soft, hard, later] = ["soft", "hard", "later"].map(|name| scratch.0.join(name));
    std::os::unix::fs::symlink(&path, &soft).unwrap();
    fs::hard_link(&path, &hard).unwrap();
    for name in [&soft, &hard] {
        is_in_use(name);
    }
    // A hard link leads to the file before, from now on.
    first.replace(&opened()).unwrap();
    fs::hard_link(&path, &later).unwrap();
    for name in [&path, &soft, &hard, &later] {
        is_in_use(name);
    }
    drop(first);
    for name in [&path, &soft, &hard, &later] {
        assert!(JournalFile::open(name).is_ok(), "{name:?}");
    }
    // A symbolic link stays one when a new file is begun.
    let (mut by_link, _) = JournalFile::open(&soft).unwrap();
    by_link.replace(b"new\n").unwrap();
    assert_eq!(read(&path), "new\n");
    assert!(soft.is_symlink());
}

#[cfg(unix)]
#[test]
fn a_journal_that_was_moved_away_stays_locked() {
    let scratch = Scratch::new("moved");
    let (path, moved) = (scratch.journal(), scratch.0.join("moved"));
    let (mut file, _) = JournalFile::open(&path).unwrap();
    file.add(&opened(), false).unwrap();
    fs::rename(&path, &moved).unwrap();
    file.replace(&opened()).unwrap();
    is_in_use(&path);
    is_in_use(&moved);
    // One that nobody can open any more is not kept.
    assert_eq!(file.linked.len(), 1);
    fs::remove_file(&path).unwrap();
    file.replace(&opened()).unwrap();
    file.replace(&opened()).unwrap();
    assert_eq!(file.linked.len(), 1);
}

#[cfg(unix)]
#[test]
fn another_gateways_journal_at_the_path_is_left_alone() {
    let scratch = Scratch::new("put");
    let path = scratch.journal();
    let (mut first, _) = JournalFile::open(&path).unwrap();
    fs::remove_file(&path).unwrap();
    let (mut second, _) = JournalFile::open(&path).unwrap();
    assert_eq!(first.altered().as_deref(), Some("was replaced"));
    first.replace(b"first\n").unwrap_err();
    second.add(b"second\n", false).unwrap();
    assert_eq!(second.altered(), None);
    assert_eq!(read(&path), "second\n");
}

#[test]
fn a_failed_write_is_truncated_before_the_next() {
    let scratch = Scratch::new("torn");
    let path = scratch.journal();
    let (mut file, _) = JournalFile::open(&path).unwrap();
    file.add(b"one\n", true).unwrap();
    file.file.write_all(b"tw").unwrap();
    file.torn = true;
    file.add(b"three\n", true).unwrap();
    assert_eq!(read(&path), "one\nthree\n");
    file.cut(4).unwrap();
    assert_eq!(read(&path), "one\n");
}

#[cfg(target_os = "linux")]
#[test]
fn a_full_disk_is_a_write_error() {
    let scratch = Scratch::new("full");
    let (mut file, _) = JournalFile::open(&scratch.journal()).unwrap();
    file.file = OpenOptions::new().append(true).open("/dev/full").unwrap();
    for _ in 0..2 {
        let error = file.add(b"one\n", true).unwrap_err();
        // The second time it cannot even be cut.
        assert!(file.torn, "{error}");
    }
}

#[test]
fn a_limited_number_of_replaced_files_is_kept() {
    let scratch = Scratch::new("kept");
    let path = scratch.journal();
    let (mut file, _) = JournalFile::open(&path).unwrap();
    for number in 0..6 {
        let lines = format!("{number}\n");
        file.replace(lines.as_bytes()).unwrap();
        file.add(b"more\n", true).unwrap();
    }
    assert_eq!(read(&path), "5\nmore\n");
    let names = ["", ".1", ".2", ".3"].map(|ending| format!("gateway.jsonl{ending}"));
    assert_eq!(scratch.files(), names);
    assert_eq!(read(&beside(&path, "1")), "4\nmore\n");
    assert_eq!(read(&beside(&path, "3")), "2\nmore\n");
}

#[test]
fn a_replacement_that_cannot_be_written_leaves_the_file_unchanged() {
    let scratch = Scratch::new("unwritable");
    let path = scratch.journal();
    let (mut file, _) = JournalFile::open(&path).unwrap();
    file.add(b"one\n", true).unwrap();
    // In the way of the new file.
    fs::create_dir(beside(&path, "new")).unwrap();
    assert!(file.replace(b"two\n").is_err());
    file.add(b"three\n", true).unwrap();
    assert_eq!(read(&path), "one\nthree\n");
}

#[cfg(unix)]
#[test]
fn a_foreign_change_is_noticed_and_a_new_file_started() {
    let scratch = Scratch::new("altered");
    let path = scratch.journal();
    let (mut file, _) = JournalFile::open(&path).unwrap();
    file.add(b"all\n", true).unwrap();
    let other = |bytes: &[u8]| {
        let mut file = OpenOptions::new().append(true).open(&path).unwrap();
        file.write_all(bytes).unwrap();
        file
    };
    type Act<'a> = &'a dyn Fn();
    let acts: [(Act, &str); 4] = [
        (&|| fs::remove_file(&path).unwrap(), "was removed"),
        (
            &|| fs::rename(&path, scratch.0.join("moved")).unwrap(),
            "was removed",
        ),
        (
            &|| drop(other(b"th")),
            "was changed by another program: 2 bytes were added",
        ),
        (
            &|| other(b"").set_len(3).unwrap(),
            "was cut: 1 bytes are missing",
        ),
    ];
    for (act, how) in acts {
        assert_eq!(file.altered(), None);
        act();
        assert_eq!(file.altered().as_deref(), Some(how));
        file.replace(b"all\n").unwrap();
        assert_eq!(read(&path), "all\n");
    }
    file.add(b"more\n", true).unwrap();
    assert_eq!(
        (file.altered(), read(&path)),
        (None, "all\nmore\n".to_owned())
    );
}

#[test]
fn a_journal_path_that_is_a_directory_is_rejected() {
    let scratch = Scratch::new("directory");
    fs::create_dir_all(scratch.journal()).unwrap();
    let error = JournalFile::open(&scratch.journal()).unwrap_err();
    let said = error.to_string();
    assert!(said.starts_with("the journal cannot lie at "), "{said}");
}

#[test]
fn a_file_that_is_not_a_journal_is_rejected_and_unchanged() {
    let scratch = Scratch::new("foreign");
    let path = scratch.journal();
    drop(JournalFile::open(&path).unwrap());
    for mine in [
        &b""[..],
        b"{\"eve",
        b"\0\0\0",
        b"\0\0\n{\"event\":\"",
        &opened(),
    ] {
        fs::write(&path, mine).unwrap();
        assert!(JournalFile::open(&path).is_ok(), "{}", mine.escape_ascii());
    }
    fs::write(beside(&path, "new"), "mine").unwrap();
    for other in ["a: {b: 1}\n", "{\"a\": 1}\n", "x"] {
        fs::write(&path, other).unwrap();
        for error in [JournalFile::open(&path).err(), check(&path).err()] {
            assert!(
                matches!(error, Some(JournalError::Foreign { .. })),
                "{other}"
            );
        }
        assert_eq!(read(&path), other);
    }
    assert_eq!(read(&beside(&path, "new")), "mine");
}
