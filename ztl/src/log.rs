//! Log lines on stderr: in the original's form, `LEVEL:logger:text`, or as JSON for machines.

use std::fmt;
use std::sync::OnceLock;
use std::time::SystemTime;

use tracing::field::{Field, Visit};
use tracing::{Event, Level, Subscriber};
use tracing_subscriber::filter::{LevelFilter, Targets};
use tracing_subscriber::fmt::format::{FormatEvent, FormatFields, Writer};
use tracing_subscriber::fmt::{FmtContext, MakeWriter};
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::registry::LookupSpan;
use tracing_subscriber::util::SubscriberInitExt;
use tracing_subscriber::{Registry, reload};
use ztl_std::listen::LogFormat;

use crate::terminal::{Errors, flat};

/// The original's format.
struct PythonForm {
    /// Whether each line begins with the time.
    timestamps: bool,
}

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
        if self.timestamps {
            let now = humantime::format_rfc3339_millis(SystemTime::now());
            write!(writer, "{now} ")?;
        }
        write!(writer, "{level}:{}:", metadata.target())?;
        let mut text = MessageText {
            writer: writer.by_ref(),
            written: Ok(()),
        };
        event.record(&mut text);
        text.written?;
        writeln!(writer)
    }
}

/// Writes only the message of an event. Its fields are for machines.
struct MessageText<'a> {
    writer: Writer<'a>,
    written: fmt::Result,
}

impl Visit for MessageText<'_> {
    fn record_debug(&mut self, field: &Field, value: &dyn fmt::Debug) {
        if field.name() == "message" {
            // One event is one line, and nothing in it commands a terminal that shows it later.
            self.written = self.writer.write_str(&flat(&format!("{value:?}")));
        }
    }
}

/// Logs in the original's format.
pub(crate) fn init(level: Level) {
    tracing_subscriber::fmt()
        .with_max_level(level)
        .with_writer(|| Errors)
        .event_format(PythonForm { timestamps: false })
        .init();
}

/// Changes the level of the log of [`init_as`].
static LEVEL: OnceLock<reload::Handle<LevelFilter, Registry>> = OnceLock::new();

/// Logs as a service: text has timestamps, unless the service manager adds them.
pub(crate) fn init_as(level: Level, format: LogFormat) {
    let (filter, handle) = reload::Layer::new(LevelFilter::from(level));
    // This is called once.
    let _ = LEVEL.set(handle);
    let log = tracing_subscriber::registry().with(filter);
    let lines = tracing_subscriber::fmt::layer().with_writer(|| Errors);
    let timestamps = !is_journal();
    match format {
        LogFormat::Text => log
            .with(lines.event_format(PythonForm { timestamps }))
            .init(),
        LogFormat::Json => log.with(lines.json().flatten_event(true)).init(),
    }
}

/// Changes the level.
pub(crate) fn set_level(level: Level) {
    if let Some(handle) = LEVEL.get() {
        // Fails only if there is no log.
        let _ = handle.reload(LevelFilter::from(level));
    }
}

/// Whether stderr is systemd's journal, which adds timestamps.
#[cfg(target_os = "linux")]
fn is_journal() -> bool {
    let journal = std::env::var("JOURNAL_STREAM").unwrap_or_default();
    let Some((device, inode)) = journal.split_once(':') else {
        return false;
    };
    let told = device.parse().ok().zip(inode.parse().ok());
    let stderr = rustix::fs::fstat(std::io::stderr()).ok();
    told.is_some() && told == stderr.map(|stat| (stat.st_dev, stat.st_ino))
}

/// This system has no journal.
#[cfg(not(target_os = "linux"))]
fn is_journal() -> bool {
    false
}

/// Logs to a writer in the original's format. The targets in `quiet` have levels of their own.
pub(crate) fn init_to<W>(level: Level, quiet: &[(&str, Level)], writer: W)
where
    W: for<'w> MakeWriter<'w> + Send + Sync + 'static,
{
    let quiet = quiet.iter().copied();
    tracing_subscriber::fmt()
        .with_max_level(level)
        .with_writer(writer)
        .event_format(PythonForm { timestamps: false })
        .finish()
        .with(Targets::new().with_default(level).with_targets(quiet))
        .init();
}

#[cfg(test)]
mod tests {
    use std::io::{self, Write};
    use std::sync::{Arc, Mutex};

    use super::*;

    #[derive(Clone, Default)]
    struct Page(Arc<Mutex<Vec<u8>>>);

    impl Write for Page {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            self.0.lock().unwrap().write(bytes)
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    #[test]
    fn control_characters_are_escaped() {
        let page = Page::default();
        let written = page.clone();
        let log = tracing_subscriber::fmt()
            .with_writer(move || written.clone())
            .event_format(PythonForm { timestamps: false })
            .finish();
        tracing::subscriber::with_default(log, || {
            let text = "it says \u{1b}[2J\nERROR:x:y\t\u{9b}\u{7f}ä";
            tracing::info!(target: "gateway", device = "arm", "{text}");
        });
        let page = String::from_utf8(page.0.lock().unwrap().clone()).unwrap();
        let line = "INFO:gateway:it says \\u001b[2J\\nERROR:x:y\\t\\u009b\\u007fä\n";
        assert_eq!(page, line);
    }
}
