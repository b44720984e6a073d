//! The lines of a run, written by threads of their own: the show waits for nobody who reads them.

use std::collections::VecDeque;
use std::fmt::Display;
use std::io::{self, Write};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use tracing_subscriber::fmt::MakeWriter;

use crate::terminal;

/// How many bytes wait for a reader; what goes beyond leaves out the oldest lines.
const KEPT: usize = 1 << 20;
/// A write that took longer stood still: nobody has seen meanwhile what was asked.
const STOOD: Duration = Duration::from_secs(1);

/// stdout and stderr of a run. What is said is in order on each of them, and on both when they are one
/// place, as a terminal.
#[derive(Clone)]
pub(super) struct Lines {
    out: Arc<Queue>,
    err: Arc<Queue>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Stream {
    Out,
    Err,
}

#[derive(Default)]
struct Queue {
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Default)]
struct State {
    waiting: VecDeque<Piece>,
    bytes: usize,
    /// How many were left out before those that wait.
    left_out: usize,
    writing: bool,
}

/// What is written at once.
struct Piece {
    stream: Stream,
    text: Vec<u8>,
    /// Whom to tell since when it can be seen.
    seen: Option<Seen>,
}

type Seen = Box<dyn FnOnce(Instant) + Send>;

impl Lines {
    /// Starts to write.
    ///
    /// # Errors
    /// When there can be no thread for it.
    pub(super) fn start() -> io::Result<Self> {
        let out = Queue::start("ztl-stdout")?;
        let err = match are_one() {
            true => Arc::clone(&out),
            // A warning is seen although nobody reads stdout.
            false => Queue::start("ztl-stderr")?,
        };
        Ok(Self { out, err })
    }

    /// Says a line on stdout.
    pub(super) fn line(&self, text: impl Display) {
        self.out.push(Stream::Out, format!("{text}\n"), None);
    }

    /// Asks something on stdout; `seen` is called on another thread when that was written, with the time
    /// since when a key can be an answer.
    pub(super) fn ask(&self, text: &str, seen: impl FnOnce(Instant) + Send + 'static) {
        let seen: Seen = Box::new(seen);
        self.out.push(Stream::Out, format!("{text}\n"), Some(seen));
    }

    /// Waits until all is written, at most for `limit`; whether it is.
    pub(super) fn finish(&self, limit: Duration) -> bool {
        let until = Instant::now() + limit;
        [&self.err, &self.out]
            .into_iter()
            .all(|queue| queue.is_empty_by(until))
    }
}

impl<'w> MakeWriter<'w> for Lines {
    type Writer = Log<'w>;

    fn make_writer(&'w self) -> Log<'w> {
        Log(&self.err)
    }
}

/// Log lines, for stderr; each is written at once.
pub(super) struct Log<'q>(&'q Queue);

impl Write for Log<'_> {
    fn write(&mut self, text: &[u8]) -> io::Result<usize> {
        self.0.push(Stream::Err, text, None);
        Ok(text.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl Queue {
    fn start(name: &str) -> io::Result<Arc<Self>> {
        let queue = Arc::new(Self::default());
        let writer = Arc::clone(&queue);
        std::thread::Builder::new()
            .name(name.to_owned())
            .spawn(move || {
                loop {
                    writer.write(|stream, text| match stream {
                        Stream::Out => terminal::put(io::stdout().lock(), text),
                        Stream::Err => terminal::put(io::stderr().lock(), text),
                    });
                }
            })?;
        Ok(queue)
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn push(&self, stream: Stream, text: impl Into<Vec<u8>>, seen: Option<Seen>) {
        let text = text.into();
        let mut state = self.lock();
        state.bytes += text.len();
        state.waiting.push_back(Piece { stream, text, seen });
        while state.bytes > KEPT {
            // A question stays, or nobody could answer it.
            let oldest = state.waiting.iter().position(|piece| piece.seen.is_none());
            let Some(piece) = oldest.and_then(|oldest| state.waiting.remove(oldest)) else {
                break;
            };
            state.bytes -= piece.text.len();
            state.left_out += 1;
        }
        self.changed.notify_all();
    }

    /// Waits for the next piece, and writes it.
    fn write(&self, put: impl Fn(Stream, &[u8])) {
        let state = self.lock();
        let nothing = |state: &mut State| state.waiting.is_empty();
        let waited = self.changed.wait_while(state, nothing);
        let mut state = waited.unwrap_or_else(PoisonError::into_inner);
        let Some(piece) = state.waiting.pop_front() else {
            return;
        };
        state.bytes -= piece.text.len();
        state.writing = true;
        let left_out = std::mem::take(&mut state.left_out);
        drop(state);
        if left_out > 0 {
            let note = format!("[{left_out} lines are left out that nobody has read in time]\n");
            put(piece.stream, note.as_bytes());
        }
        let before = Instant::now();
        put(piece.stream, &piece.text);
        if let Some(seen) = piece.seen {
            let stood = before.elapsed() > STOOD;
            seen(if stood { Instant::now() } else { before });
        }
        self.lock().writing = false;
        self.changed.notify_all();
    }

    fn is_empty_by(&self, until: Instant) -> bool {
        let left = until.saturating_duration_since(Instant::now());
        let busy = |state: &mut State| state.writing || !state.waiting.is_empty();
        let waited = self.changed.wait_timeout_while(self.lock(), left, busy);
        !waited.unwrap_or_else(PoisonError::into_inner).1.timed_out()
    }
}

/// Whether stdout and stderr are one place, so that their order can be seen.
#[cfg(unix)]
fn are_one() -> bool {
    use std::fs::File;
    use std::os::fd::AsFd;
    use std::os::unix::fs::MetadataExt;

    let place = |stream: std::os::fd::BorrowedFd<'_>| {
        let file = File::from(stream.try_clone_to_owned().ok()?);
        let meta = file.metadata().ok()?;
        Some((meta.dev(), meta.ino()))
    };
    place(io::stdout().as_fd()) == place(io::stderr().as_fd())
}

/// It cannot be told here.
#[cfg(not(unix))]
const fn are_one() -> bool {
    true
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc;

    use super::*;

    #[test]
    fn what_nobody_reads_makes_nobody_wait_and_its_newest_lines_and_questions_stay() {
        let queue = Arc::new(Queue::default());
        let (answered, since) = mpsc::channel();
        let seen: Seen = Box::new(move |at| answered.send(at).unwrap());
        queue.push(Stream::Out, "asked\n", Some(seen));
        let line = "x".repeat(KEPT / 10);
        for nth in 0..20 {
            queue.push(Stream::Out, format!("{nth}{line}"), None);
        }
        assert!(queue.lock().bytes <= KEPT);
        assert!(!queue.is_empty_by(Instant::now()));
        assert!(since.try_recv().is_err(), "nobody has seen it");
        let written = Mutex::new(Vec::new());
        while !queue.is_empty_by(Instant::now()) {
            queue.write(|_, text| {
                let text = String::from_utf8_lossy(text);
                written.lock().unwrap().push(text.replace('x', ""));
            });
        }
        assert!(since.try_recv().is_ok());
        let written = written.into_inner().unwrap();
        let [note, asked, newest @ ..] = written.as_slice() else {
            panic!("{written:?}");
        };
        assert_eq!(
            note,
            "[11 lines are left out that nobody has read in time]\n"
        );
        assert_eq!(asked, "asked\n");
        let expected: Vec<String> = (11..20).map(|nth| nth.to_string()).collect();
        assert_eq!(newest, expected);
    }
}
