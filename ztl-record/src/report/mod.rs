//! A page of a recording: streams above the tasks, on one axis. Without scripts or external resources.

mod draw;
mod page;
mod series;
mod streams;
mod tasks;

use std::io;
use std::path::Path;

use crate::reader::{Damage, Reader};
use streams::Streams;
use tasks::Tasks;

/// First and last time of a recording, in nanoseconds since 1970.
#[derive(Debug, Clone, Copy)]
struct Span {
    from: u64,
    to: u64,
}

/// What a page shows.
struct Recorded {
    name: String,
    span: Span,
    messages: u64,
    streams: Streams,
    tasks: Tasks,
    damage: Damage,
}

/// Makes a page of a recording, in HTML. Takes memory for what is drawn only, not for the whole recording. A recording
/// without an end, or with damaged parts, is drawn as far as it can be read; the damage is on the page.
///
/// # Errors
/// If the file cannot be opened, or there is no message in it.
pub fn report(path: &Path) -> io::Result<(String, Damage)> {
    let mut span: Option<Span> = None;
    let mut first = Reader::open(path)?;
    for read in first.by_ref() {
        let at = read.log_time;
        let span = span.get_or_insert(Span { from: at, to: at });
        *span = Span {
            from: span.from.min(at),
            to: span.to.max(at),
        };
    }
    let Some(span) = span else {
        let why = match first.damage().end.as_deref() {
            Some(end) => format!("there is no message in it: it {end}"),
            None => "there is no message in it".to_owned(),
        };
        return Err(io::Error::new(io::ErrorKind::InvalidData, why));
    };
    let mut recorded = Recorded {
        name: path.display().to_string(),
        span,
        messages: 0,
        streams: Streams::new(span),
        tasks: Tasks::default(),
        damage: Damage::default(),
    };
    let mut second = Reader::open(path)?;
    for read in second.by_ref() {
        recorded.messages += 1;
        match &read.content {
            crate::Content::Task(event, _) => {
                recorded
                    .tasks
                    .on_event(event, &read.publisher, read.log_time);
            }
            _ => recorded.streams.on_message(&read),
        }
    }
    recorded.damage = second.damage().clone();
    Ok((page::page(&recorded), recorded.damage))
}

impl Span {
    const fn length(self) -> u64 {
        self.to.saturating_sub(self.from)
    }

    /// From its start to a time.
    const fn at(self, time: u64) -> std::time::Duration {
        std::time::Duration::from_nanos(time.saturating_sub(self.from))
    }
}
