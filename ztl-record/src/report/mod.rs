//! A recording as a page, and as a part of the page of its run: streams above the tasks, on one axis. Without scripts or
//! external resources.

mod draw;
mod page;
mod series;
mod span;
mod streams;
mod tasks;

use std::io;
use std::path::Path;

use ztl_script::drawing::{BELOW_OVERVIEW, NARROW, WIDE};
use ztl_script::record::Record;

use crate::reader::{Content, Damage, Reader};
use span::Span;
use streams::Streams;
use tasks::Tasks;

/// A recording, reduced to what is drawn. It takes memory for that only, not for the whole recording.
pub struct Drawn {
    name: String,
    span: Span,
    messages: u64,
    streams: Streams,
    tasks: Tasks,
    run: Vec<u8>,
    /// What could not be read.
    pub damage: Damage,
}

impl Drawn {
    /// Reads a recording. One without an end, or with damaged parts, is read as far as possible.
    ///
    /// # Errors
    /// If the file cannot be opened, or there is no message in it.
    pub fn read(path: &Path) -> io::Result<Self> {
        let mut span: Option<Span> = None;
        let mut run_span: Option<Span> = None;
        let mut run = Vec::new();
        let mut first = Reader::open(path)?;
        for read in first.by_ref() {
            Span::widen(&mut span, read.log_time);
            if let Content::Run(event) = read.content {
                Span::widen(&mut run_span, read.log_time);
                run.extend_from_slice(&event);
                run.push(b'\n');
            }
        }
        // The axis of a run is that of its report.
        let Some(span) = run_span.or(span) else {
            let why = match first.damage().end.as_deref() {
                Some(end) => format!("there is no message in it: it {end}"),
                None => "there is no message in it".to_owned(),
            };
            return Err(io::Error::new(io::ErrorKind::InvalidData, why));
        };
        let mut drawn = Self {
            name: path.display().to_string(),
            span,
            messages: 0,
            streams: Streams::new(span),
            tasks: Tasks::default(),
            run,
            damage: Damage::default(),
        };
        let mut second = Reader::open(path)?;
        for read in second.by_ref() {
            drawn.messages += 1;
            match &read.content {
                Content::Run(_) => {}
                Content::Task(event, _) => {
                    let publisher = &read.source.name;
                    drawn.tasks.on_event(event, publisher, read.log_time);
                }
                _ => drawn.streams.on_message(&read),
            }
        }
        drawn.damage = second.damage().clone();
        Ok(drawn)
    }

    /// The events of the run that it has: a line for each, as [`ztl_script::record::read`] reads them. Empty if it has
    /// none.
    #[must_use]
    pub fn run(&self) -> &[u8] {
        &self.run
    }

    /// The page of a recording without a run, in HTML.
    #[must_use]
    pub fn page(&self) -> String {
        page::page(self)
    }

    /// Streams above the tasks, for the page of its run: below its overview, on the same axis. `number` tells several
    /// runs on one page apart.
    #[must_use]
    pub fn below_overview(&mut self, run: &Record, number: usize) -> String {
        self.tasks.add_run(run, self.span.from);
        let layouts = [&BELOW_OVERVIEW[0], &BELOW_OVERVIEW[1]];
        draw::images(self, number) + &draw::timeline(self, layouts, number) + &page::streams(self)
    }

    /// Streams above the tasks, for a page of their own.
    fn timeline(&self) -> String {
        draw::images(self, 0) + &draw::timeline(self, [&WIDE, &NARROW], 0)
    }
}
