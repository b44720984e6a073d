//! Reads files that people name. Rejects files that could block the reader.

use std::fs::{self, File, Metadata};
use std::io::{self, Read};
use std::path::Path;

#[cfg(feature = "config")]
use ztl_yaml::{Diagnostic, Diagnostics, Document};

/// Opens a regular file, or a stream of this process ([`is_stream`]).
fn open(path: &Path) -> io::Result<File> {
    let metadata = fs::metadata(path)?;
    // Reading a directory fails anyway.
    if !metadata.is_dir() && !is_stream(path) {
        regular(&metadata)?;
    }
    File::open(path)
}

/// Reads a regular file, or a stream of this process, of at most `most` bytes.
///
/// # Errors
/// Why it cannot be read, or that it is longer.
pub fn read(path: &Path, most: u64) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    let read = open(path)?.take(most + 1).read_to_end(&mut bytes)?;
    if read as u64 > most {
        let kind = io::ErrorKind::FileTooLarge;
        return Err(io::Error::new(
            kind,
            format!("it has more than {most} bytes"),
        ));
    }
    Ok(bytes)
}

/// Reads a text file, as [`read`] does.
///
/// # Errors
/// As for [`read`], or that it is not UTF-8.
pub fn read_text(path: &Path, most: u64) -> io::Result<String> {
    String::from_utf8(read(path, most)?)
        .map_err(|error| io::Error::new(io::ErrorKind::InvalidData, error))
}

/// Reads a YAML file of at most [`MAX_FILE`](ztl_yaml::MAX_FILE) bytes.
///
/// # Errors
/// Why it cannot be read.
#[cfg(feature = "config")]
pub fn read_yaml(path: &Path) -> Result<Vec<u8>, Diagnostics> {
    read(path, ztl_yaml::MAX_FILE).map_err(|error| {
        let message = format!("cannot read it: {error}");
        Diagnostic::of_file(&path.display().to_string(), message).into()
    })
}

/// Reads and parses a YAML file in this project's dialect.
///
/// # Errors
/// Why it cannot be read, or what is wrong in it.
#[cfg(feature = "config")]
pub fn load_yaml(path: &Path) -> Result<Document, Diagnostics> {
    Document::parse(&path.display().to_string(), &read_yaml(path)?)
}

/// Whether a path names a stream of this process, like `/dev/stdin` or `<(…)` in a shell. A stream can be read
/// once, and reading waits for its writer.
#[must_use]
pub fn is_stream(path: &Path) -> bool {
    let streams = ["/dev/stdin", "/dev/fd", "/proc/self/fd", "/dev/null"];
    streams.iter().any(|stream| path.starts_with(stream))
}

/// Rejects anything but a regular file.
pub(crate) fn regular(metadata: &Metadata) -> io::Result<()> {
    if metadata.is_file() {
        return Ok(());
    }
    let kind = io::ErrorKind::InvalidInput;
    Err(io::Error::new(kind, "it is not a regular file"))
}

#[cfg(all(test, unix))]
mod tests {
    use super::*;

    #[test]
    fn only_regular_files_of_limited_length_are_read() {
        let directory = std::env::temp_dir().join(format!("ztl-files-{}", crate::random::number()));
        fs::create_dir(&directory).expect("a directory");
        let pipe = directory.join("pipe");
        let mode = rustix::fs::Mode::RUSR | rustix::fs::Mode::WUSR;
        rustix::fs::mkfifoat(rustix::fs::CWD, &pipe, mode).expect("a pipe");
        let link = directory.join("link");
        std::os::unix::fs::symlink("/dev/zero", &link).expect("a link");
        for path in [&pipe, &link] {
            let error = read(path, 10).expect_err("no file");
            assert_eq!(error.to_string(), "it is not a regular file");
        }
        let file = directory.join("file");
        fs::write(&file, "0123456789").expect("to write");
        assert_eq!(read(&file, 10).expect("a file"), b"0123456789");
        let error = read(&file, 9).expect_err("too long");
        assert_eq!(error.to_string(), "it has more than 9 bytes");
        assert_eq!(read(Path::new("/dev/null"), 9).expect("a stream"), b"");
        fs::remove_dir_all(&directory).expect("to clean up");
    }
}
