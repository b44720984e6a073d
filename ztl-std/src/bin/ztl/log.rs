//! Log lines on stderr: in the original's form, `LEVEL:logger:text`, or as JSON for machines.

use std::fmt;

use tracing::field::{Field, Visit};
use tracing::{Event, Level, Subscriber};
use tracing_subscriber::filter::Targets;
use tracing_subscriber::fmt::format::{FormatEvent, FormatFields, Writer};
use tracing_subscriber::fmt::{FmtContext, MakeWriter};
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::registry::LookupSpan;
use tracing_subscriber::util::SubscriberInitExt;
use ztl_std::listen::LogFormat;

use crate::terminal::{Errors, flat};

struct PythonForm;

impl<S, N> FormatEvent<S, N> for PythonForm
where
    S: Subscriber + for<'a> LookupSpan<'a>,
    N: for<'a> FormatFields<'a> + 'static,
{
    fn format_event(
        &self,
        _context: &FmtContext<'_, S, N>,
        mut writer: Writer<'_>,
        event: &Event<'_>,
    ) -> fmt::Result {
        let metadata = event.metadata();
        let level = match *metadata.level() {
            Level::ERROR => "ERROR",
            Level::WARN => "WARNING",
            Level::INFO => "INFO",
            Level::DEBUG | Level::TRACE => "DEBUG",
        };
        write!(writer, "{level}:{}:", metadata.target())?;
        let mut text = Text {
            writer: writer.by_ref(),
            written: Ok(()),
        };
        event.record(&mut text);
        text.written?;
        writeln!(writer)
    }
}

/// Writes the text of an event alone: it says what the fields say, which are for machines.
struct Text<'a> {
    writer: Writer<'a>,
    written: fmt::Result,
}

impl Visit for Text<'_> {
    fn record_debug(&mut self, field: &Field, value: &dyn fmt::Debug) {
        if field.name() == "message" {
            // One event is one line, and nothing in it commands a terminal that shows it later.
            self.written = self.writer.write_str(&flat(&format!("{value:?}")));
        }
    }
}

/// Logs what is at least as grave as `level`, in the original's form.
pub(crate) fn init(level: Level) {
    init_as(level, LogFormat::Text);
}

/// The same in any form.
pub(crate) fn init_as(level: Level, format: LogFormat) {
    let log = tracing_subscriber::fmt()
        .with_max_level(level)
        .with_writer(|| Errors);
    match format {
        LogFormat::Text => log.event_format(PythonForm).init(),
        LogFormat::Json => log.json().flatten_event(true).init(),
    }
}

/// Logs in the original's form to anywhere; of the loggers in `quiet` only warnings and errors.
pub(crate) fn init_to<W>(level: Level, quiet: &[&str], writer: W)
where
    W: for<'w> MakeWriter<'w> + Send + Sync + 'static,
{
    let quiet = quiet.iter().map(|logger| (*logger, Level::WARN));
    tracing_subscriber::fmt()
        .with_max_level(level)
        .with_writer(writer)
        .event_format(PythonForm)
        .finish()
        .with(Targets::new().with_default(level).with_targets(quiet))
        .init();
}
