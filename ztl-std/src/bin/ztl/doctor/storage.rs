//! Where a gateway keeps its journal: can it be written, and is there room?

use std::fs;
use std::path::{Path, PathBuf};

use serde_json::json;

use super::Finding;
use crate::journal;

/// Less room than this is trouble, in bytes.
const ROOM: u64 = 16 << 20;

pub(super) fn journal(wished: Option<&Path>) -> Finding {
    let remedy =
        "give a directory that this user may write: `ztl gateway --journal DIR`, or --no-journal";
    let Some(directory) = wished.map(PathBuf::from).or_else(journal::directory) else {
        return Finding::trouble(
            "journal",
            "no place for it: neither STATE_DIRECTORY nor XDG_STATE_HOME nor HOME is set",
            remedy,
        );
    };
    let shown = directory.display().to_string();
    if let Err(error) = try_to_write(&directory) {
        return Finding::trouble("journal", format!("{shown}: {error}"), remedy)
            .with(json!({ "directory": shown }));
    }
    // What is nearest to a directory that a gateway would still make.
    let there = directory.ancestors().find(|path| path.exists());
    let free = there
        .and_then(|path| rustix::fs::statvfs(path).ok())
        .map(|disk| disk.f_bavail.saturating_mul(disk.f_frsize));
    let text = match free {
        Some(free) => format!("{shown} can be written, {} MiB are free", free >> 20),
        None => format!("{shown} can be written"),
    };
    let data = json!({ "directory": shown, "free_bytes": free });
    if free.is_some_and(|free| free < ROOM) {
        return Finding::trouble("journal", text, "make room, or choose another disk").with(data);
    }
    Finding::good("journal", text).with(data)
}

/// Writes a file and takes it away; a directory that is not there is made and taken away too.
fn try_to_write(directory: &Path) -> std::io::Result<()> {
    let lacking = !directory.exists();
    let first_made = directory
        .ancestors()
        .take_while(|path| !path.exists())
        .last();
    let first_made = first_made.map(PathBuf::from);
    fs::create_dir_all(directory)?;
    let file = directory.join(format!(".ztl-doctor-{}", std::process::id()));
    let written = fs::write(&file, b"a line as long as one of a journal\n");
    let _ = fs::remove_file(&file);
    if lacking && let Some(made) = first_made {
        // Only what was made here, and is empty.
        for path in directory.ancestors() {
            let _ = fs::remove_dir(path);
            if path == made {
                break;
            }
        }
    }
    written
}
