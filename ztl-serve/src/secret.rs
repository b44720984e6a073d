//! Files with secrets.

use std::path::Path;

/// The text of a file with a secret, of at most `most` bytes.
///
/// # Errors
/// Why it cannot be read.
pub(crate) fn read(file: &Path, most: u64) -> Result<String, String> {
    let text = ztl_std::files::read_text(file, most);
    text.map_err(|error| format!("{}: {error}", file.display()))
}
