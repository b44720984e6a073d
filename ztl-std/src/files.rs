//! Reading files that people name. What could keep its reader waiting is refused.

use std::fs::{self, File, Metadata};
use std::io::{self, Read};
use std::path::Path;

#[cfg(feature = "config")]
use ztl_yaml::{Diagnostic, Diagnostics, Document};

/// Opens a file for reading. A named pipe, a socket or a device is refused, but not the streams of this
/// process ([`is_stream`]).
///
/// # Errors
/// Those of the operating system, and that it is not a regular file.
pub fn open(path: &Path) -> io::Result<File> {
    let metadata = fs::metadata(path)?;
    // The system itself refuses to read a directory.
    if !metadata.is_dir() && !is_stream(path) {
        regular(&metadata)?;
    }
    File::open(path)
}

/// Reads a file of at most `most` bytes, as [`open`] opens it.
pub(crate) fn read(path: &Path, most: u64) -> io::Result<Vec<u8>> {
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

/// Reads a YAML file of at most [`MAX_FILE`](ztl_yaml::MAX_FILE) bytes.
///
/// # Errors
/// What keeps it from being read.
#[cfg(feature = "config")]
pub fn read_yaml(path: &Path) -> Result<Vec<u8>, Diagnostics> {
    read(path, ztl_yaml::MAX_FILE).map_err(|error| {
        let message = format!("cannot read it: {error}");
        Diagnostic::of_file(&path.display().to_string(), message).into()
    })
}

/// Reads and parses a YAML file of our own.
///
/// # Errors
/// What keeps it from being read, or is wrong with it.
#[cfg(feature = "config")]
pub fn load_yaml(path: &Path) -> Result<Document, Diagnostics> {
    Document::parse(&path.display().to_string(), &read_yaml(path)?)
}

/// Whether a path names a stream of this process, as `/dev/stdin` and `<(…)` in a shell do. A stream can be
/// read once, and its reader waits for its writer.
#[must_use]
pub fn is_stream(path: &Path) -> bool {
    let streams = ["/dev/stdin", "/dev/fd", "/proc/self/fd", "/dev/null"];
    streams.iter().any(|stream| path.starts_with(stream))
}

/// Refuses what is not a regular file.
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
    fn nothing_is_read_that_never_ends_or_waits_for_a_writer() {
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
