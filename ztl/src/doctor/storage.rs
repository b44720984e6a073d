//! Checks the gateway's journal directory: is it writable, and is there space?

use std::fs;
use std::path::{Path, PathBuf};

use serde_json::json;

use super::finding::Finding;
use crate::journal_options;

/// Less free space than this is a problem, in bytes.
const ROOM: u64 = 16 << 20;

pub(super) fn journal(wished: Option<&Path>) -> Finding {
    let remedy =
        "choose a writable directory with `ztl gateway --journal DIR`, or use --no-journal";
    let Some(directory) = wished
        .map(PathBuf::from)
        .or_else(journal_options::directory)
    else {
        return Finding::problem(
            "journal",
            "no directory: none of STATE_DIRECTORY, XDG_STATE_HOME and HOME is set",
            remedy,
        );
    };
    let shown = directory.display().to_string();
    if let Err(error) = try_to_write(&directory) {
        return Finding::problem("journal", format!("{shown}: {error}"), remedy)
            .with(json!({ "directory": shown }));
    }
    // The nearest existing parent of a directory that the gateway would create.
    let there = directory.ancestors().find(|path| path.exists());
    let free = there
        .and_then(|path| rustix::fs::statvfs(path).ok())
        .map(|disk| disk.f_bavail.saturating_mul(disk.f_frsize));
    let text = match free {
        Some(free) => format!("{shown} is writable, {} MiB free", free >> 20),
        None => format!("{shown} is writable"),
    };
    let data = json!({ "directory": shown, "free_bytes": free });
    if free.is_some_and(|free| free < ROOM) {
        return Finding::problem("journal", text, "free some space, or choose another disk")
            .with(data);
    }
    Finding::good("journal", text).with(data)
}

/// Writes and removes a file; creates and removes missing directories as well.
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
        // Remove only directories created here, and only if empty.
        for path in directory.ancestors() {
            let _ = fs::remove_dir(path);
            if path == made {
                break;
            }
        }
    }
    written
}
