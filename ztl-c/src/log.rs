//! Passes the library's log to the program.

use std::ffi::{c_char, c_int, c_void};
use std::fmt::Write;

use tracing::field::{Field, Visit};
use tracing::span::{Attributes, Id, Record};
use tracing::{Event, Level, Metadata, Subscriber};

use crate::border::{Context, for_c, guard};
use crate::error::{ZTL_E_ARGUMENT, ZTL_E_NULL, ZTL_E_STATE, ZTL_OK};

/// An error.
pub const ZTL_LOG_ERROR: c_int = 1;
/// A warning.
pub const ZTL_LOG_WARNING: c_int = 2;
/// An event.
pub const ZTL_LOG_INFO: c_int = 3;
/// Details.
pub const ZTL_LOG_DEBUG: c_int = 4;

/// Receives a log line without a line feed. Called from any thread of the library, also from several at the same time,
/// and within calls to the library; it must not call the library. The text belongs to the library and is valid
/// during the call.
pub type LogCall =
    Option<unsafe extern "C" fn(context: *mut c_void, level: c_int, line: *const c_char)>;

struct Log {
    most: c_int,
    log: unsafe extern "C" fn(*mut c_void, c_int, *const c_char),
    context: Context,
}

/// The level as a number; higher means more detail.
fn number(level: &Level) -> c_int {
    match *level {
        Level::ERROR => ZTL_LOG_ERROR,
        Level::WARN => ZTL_LOG_WARNING,
        Level::INFO => ZTL_LOG_INFO,
        _ => ZTL_LOG_DEBUG,
    }
}

/// An event's message, followed by its other fields.
#[derive(Default)]
struct Line(String);

impl Visit for Line {
    fn record_debug(&mut self, field: &Field, value: &dyn std::fmt::Debug) {
        // Writing to a `String` does not fail.
        let _ = match field.name() {
            "message" => write!(self.0, "{value:?}"),
            name => write!(self.0, " {name}={value:?}"),
        };
    }
}

impl Subscriber for Log {
    fn enabled(&self, metadata: &Metadata<'_>) -> bool {
        metadata.is_event() && number(metadata.level()) <= self.most
    }

    fn event(&self, event: &Event<'_>) {
        let mut line = Line::default();
        event.record(&mut line);
        let line = for_c(&line.0);
        // SAFETY: the program's function, called as the header says; the text outlives the call.
        unsafe {
            (self.log)(
                self.context.0,
                number(event.metadata().level()),
                line.as_ptr(),
            )
        };
    }

    // The library uses no spans.

    fn new_span(&self, _: &Attributes<'_>) -> Id {
        Id::from_u64(1)
    }

    fn record(&self, _: &Id, _: &Record<'_>) {}

    fn record_follows_from(&self, _: &Id, _: &Id) {}

    fn enter(&self, _: &Id) {}

    fn exit(&self, _: &Id) {}
}

/// Passes the library's log, up to a level, to a function of the program; by default nothing is logged. Call it once per
/// process (else ZTL_E_STATE), best before anything else; it cannot be undone. `log` must not be NULL. `context` is passed
/// to it, belongs to the program, and may be NULL. Any thread.
#[unsafe(no_mangle)]
pub extern "C" fn ztl_log_to(level: c_int, log: LogCall, context: *mut c_void) -> c_int {
    guard(ZTL_E_STATE, || {
        let Some(log) = log else {
            return ZTL_E_NULL;
        };
        if !(ZTL_LOG_ERROR..=ZTL_LOG_DEBUG).contains(&level) {
            return ZTL_E_ARGUMENT;
        }
        let context = Context(context);
        let most = level;
        let log = Log { most, log, context };
        match tracing::subscriber::set_global_default(log) {
            Ok(()) => ZTL_OK,
            Err(_) => ZTL_E_STATE,
        }
    })
}
