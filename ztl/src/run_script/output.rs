//! The output of the plain view. Threads write it, so that a slow reader never delays the run.

use std::collections::VecDeque;
use std::fmt::Display;
use std::io::{self, Write};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use tracing_subscriber::fmt::MakeWriter;

use crate::key_press::STALLED;
use crate::terminal;

/// Queue size in bytes; beyond it the oldest lines are dropped.
const QUEUE_SIZE: usize = 1 << 20;

/// What stderr gets if the reader of stdout was too slow.
const TOO_SLOW: &str = "ztl: cannot write the output: its reader is too slow\n";
/// Time for writing that.
const LAST_WARNING: Duration = Duration::from_millis(200);

/// stdout and stderr of a run. The order is kept on each, and across both if they are the same file, such as
/// a terminal.
#[derive(Clone)]
pub(super) struct LineOutput {
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
    /// How many pieces were dropped before those that wait.
    dropped: usize,
    /// Whether something for stdout was dropped.
    is_stdout_lost: bool,
    writing: bool,
}

/// A text to write.
struct Piece {
    stream: Stream,
    text: Vec<u8>,
    /// Receives the time from which it is visible.
    seen: Option<Seen>,
}

type Seen = Box<dyn FnOnce(Instant) + Send>;

impl LineOutput {
    /// Starts the writing threads.
    ///
    /// # Errors
    /// If a thread cannot be started.
    pub(super) fn start() -> io::Result<Self> {
        let out = Queue::start("ztl-stdout")?;
        let err = match are_same_file() {
            true => Arc::clone(&out),
            // A stalled stdout must not hold back warnings.
            false => Queue::start("ztl-stderr")?,
        };
        Ok(Self { out, err })
    }

    /// Writes a line to stdout.
    pub(super) fn line(&self, text: impl Display) {
        self.out.push(Stream::Out, format!("{text}\n"), None);
    }

    /// Writes a question to stdout. A thread calls `seen` when it is written, with the time from which keys
    /// count as answers.
    pub(super) fn ask(&self, text: &str, seen: impl FnOnce(Instant) + Send + 'static) {
        let seen: Seen = Box::new(seen);
        self.out.push(Stream::Out, format!("{text}\n"), Some(seen));
    }

    /// Waits up to `limit` until all is written. Tells it if something of stdout is not.
    pub(super) fn finish(&self, limit: Duration) {
        let start = Instant::now();
        if !self.out.is_empty_by(start + limit) || self.out.lock().is_stdout_lost {
            // A write from here could block for ever.
            if terminal::mark_output_lost() {
                self.err.push(Stream::Err, TOO_SLOW, None);
            }
        }
        self.err
            .is_empty_by((start + limit).max(Instant::now() + LAST_WARNING));
    }
}

impl<'w> MakeWriter<'w> for LineOutput {
    type Writer = LogWriter<'w>;

    fn make_writer(&'w self) -> LogWriter<'w> {
        LogWriter(&self.err)
    }
}

/// Queues log lines for stderr.
pub(super) struct LogWriter<'q>(&'q Queue);

impl Write for LogWriter<'_> {
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
                        Stream::Out => terminal::out(text),
                        Stream::Err => terminal::err(text),
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
        while state.bytes > QUEUE_SIZE {
            // Questions are kept, because the operator must answer them.
            let oldest = state.waiting.iter().position(|piece| piece.seen.is_none());
            let Some(piece) = oldest.and_then(|oldest| state.waiting.remove(oldest)) else {
                break;
            };
            state.bytes -= piece.text.len();
            state.dropped += 1;
            state.is_stdout_lost |= piece.stream == Stream::Out;
        }
        self.changed.notify_all();
    }

    /// Waits for the next piece and writes it.
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
        let dropped = std::mem::take(&mut state.dropped);
        drop(state);
        if dropped > 0 {
            let note = format!("[{dropped} lines dropped: the reader is too slow]\n");
            put(piece.stream, note.as_bytes());
        }
        let before = Instant::now();
        put(piece.stream, &piece.text);
        if let Some(seen) = piece.seen {
            let stalled = before.elapsed() > STALLED;
            seen(if stalled { Instant::now() } else { before });
        }
        self.lock().writing = false;
        self.changed.notify_all();
    }

    /// Waits until all is written; returns whether it is.
    fn is_empty_by(&self, until: Instant) -> bool {
        let left = until.saturating_duration_since(Instant::now());
        let busy = |state: &mut State| state.writing || !state.waiting.is_empty();
        let waited = self.changed.wait_timeout_while(self.lock(), left, busy);
        !waited.unwrap_or_else(PoisonError::into_inner).1.timed_out()
    }
}

/// Whether stdout and stderr are the same file, where their order is visible.
#[cfg(unix)]
fn are_same_file() -> bool {
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

/// Assumes that they are.
#[cfg(not(unix))]
const fn are_same_file() -> bool {
    true
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc;

    use super::*;

    #[test]
    fn a_full_queue_drops_the_oldest_lines_and_keeps_questions() {
        let queue = Arc::new(Queue::default());
        let (answered, since) = mpsc::channel();
        let seen: Seen = Box::new(move |at| answered.send(at).unwrap());
        queue.push(Stream::Out, "asked\n", Some(seen));
        let line = "x".repeat(QUEUE_SIZE / 10);
        for nth in 0..20 {
            queue.push(Stream::Out, format!("{nth}{line}"), None);
        }
        assert!(queue.lock().bytes <= QUEUE_SIZE);
        assert!(!queue.is_empty_by(Instant::now()));
        assert!(since.try_recv().is_err(), "nobody has seen it");
        assert!(queue.lock().is_stdout_lost);
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
        assert_eq!(note, "[11 lines dropped: the reader is too slow]\n");
        assert_eq!(asked, "asked\n");
        let expected: Vec<String> = (11..20).map(|nth| nth.to_string()).collect();
        assert_eq!(newest, expected);
    }
}
