//! The record of the show and its report, for browsers, while the show goes on.

use std::fs::File;
use std::io::{self, Read as _};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use axum::body::{Body, Bytes};
use axum::http::{StatusCode, header};
use axum::response::{Html, IntoResponse as _, Response};
use futures_util::stream;
use tokio::sync::Semaphore;
use tokio::task::spawn_blocking;

use crate::show::Record;

/// How much of the record is read at once, in bytes.
const PIECE: u64 = 64 << 10;

/// The content security policy of the report: its style is inline, and nothing else is allowed.
const REPORT: (&str, &str) = (
    "content-security-policy",
    "default-src 'none'; style-src 'unsafe-inline'; img-src data:; base-uri 'none'; form-action 'none'; \
     frame-ancestors 'none'; sandbox",
);

pub(crate) struct RecordFile {
    path: PathBuf,
    make_report: fn(&Path) -> Result<String, String>,
    /// One report is made at a time: it takes memory for the whole record.
    turn: Arc<Semaphore>,
}

impl RecordFile {
    pub(crate) fn new(record: &Record) -> Self {
        Self {
            path: record.file.clone(),
            make_report: record.report,
            turn: Arc::new(Semaphore::new(1)),
        }
    }

    /// The report so far.
    pub(crate) async fn report(&self) -> Response {
        let Ok(turn) = Arc::clone(&self.turn).acquire_owned().await else {
            return StatusCode::INTERNAL_SERVER_ERROR.into_response();
        };
        let (path, make) = (self.path.clone(), self.make_report);
        let made = spawn_blocking(move || {
            // Held until the report is made, also if the browser has disconnected.
            let _turn = turn;
            make(&path)
        });
        match made.await {
            Ok(Ok(page)) => ([REPORT], Html(page)).into_response(),
            Ok(Err(why)) => {
                let why = format!("no report: {why}\n");
                (StatusCode::SERVICE_UNAVAILABLE, why).into_response()
            }
            Err(_) => StatusCode::INTERNAL_SERVER_ERROR.into_response(),
        }
    }

    /// The record so far, as a file to keep.
    pub(crate) async fn download(&self) -> Response {
        let path = self.path.clone();
        let opened = spawn_blocking(move || {
            let file = File::open(path)?;
            let length = file.metadata()?.len();
            // What is recorded meanwhile is left out.
            io::Result::Ok(file.take(length))
        });
        let Ok(Ok(file)) = opened.await else {
            let why = "the record cannot be read\n";
            return (StatusCode::INTERNAL_SERVER_ERROR, why).into_response();
        };
        let pieces = stream::try_unfold(file, async |mut file| {
            let read = spawn_blocking(move || {
                let mut piece = Vec::new();
                file.by_ref().take(PIECE).read_to_end(&mut piece)?;
                io::Result::Ok((piece, file))
            });
            let (piece, file) = read.await.map_err(io::Error::other)??;
            Ok::<_, io::Error>((!piece.is_empty()).then(|| (Bytes::from(piece), file)))
        });
        let kept = format!("attachment; filename=\"{}\"", name(&self.path));
        let headers = [
            (header::CONTENT_TYPE, "application/octet-stream".to_owned()),
            (header::CONTENT_DISPOSITION, kept),
        ];
        (headers, Body::from_stream(pieces)).into_response()
    }
}

/// The name of a file, in characters that every header and system takes.
fn name(path: &Path) -> String {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let plain = |c: char| match c {
        '.' | '-' | '_' => c,
        c if c.is_ascii_alphanumeric() => c,
        _ => '_',
    };
    name.chars().map(plain).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_name_of_a_record_ends_no_header() {
        let name = |path: &str| name(Path::new(path));
        assert_eq!(name("/tmp/run-2.jsonl"), "run-2.jsonl");
        assert_eq!(name("a\"; x=\r\nü.mcap"), "a___x____.mcap");
    }
}
