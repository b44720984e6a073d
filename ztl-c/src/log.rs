//! What the library logs, for the program's own log.

use std::ffi::{c_char, c_int, c_void};
use std::fmt::Write;

use tracing::field::{Field, Visit};
use tracing::span::{Attributes, Id, Record};
use tracing::{Event, Level, Metadata, Subscriber};

use crate::border::{Context, for_c, guard};
use crate::error::{ZTL_E_ARGUMENT, ZTL_E_NULL, ZTL_E_STATE, ZTL_OK};

/// Something is wrong.
pub const ZTL_LOG_ERROR: c_int = 1;
/// Something may be wrong.
pub const ZTL_LOG_WARNING: c_int = 2;
/// Something has happened.
pub const ZTL_LOG_INFO: c_int = 3;
/// Details.
pub const ZTL_LOG_DEBUG: c_int = 4;

/// Takes a line of the log, without a line feed. Called from any thread of the library, also from several at
/// the same time, and from within calls to it; it must not call the library. The text is the
/// library's, and lasts for the call.
pub type LogCall =
    Option<unsafe extern "C" fn(context: *mut c_void, level: c_int, line: *const c_char)>;

struct Log {
    most: c_int,
    log: unsafe extern "C" fn(*mut c_void, c_int, *const c_char),
    context: Context,
}

/// The level as a number that rises with the details.
fn number(level: &Level) -> c_int {
    match *level {
        Level::ERROR => ZTL_LOG_ERROR,
        Level::WARN => ZTL_LOG_WARNING,
        Level::INFO => ZTL_LOG_INFO,
        _ => ZTL_LOG_DEBUG,
    }
}

/// The message of an event, and its other fields behind it.
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

    // There are no spans here.

    fn new_span(&self, _: &Attributes<'_>) -> Id {
        Id::from_u64(1)
    }

    fn record(&self, _: &Id, _: &Record<'_>) {}

    fn record_follows_from(&self, _: &Id, _: &Id) {}

    fn enter(&self, _: &Id) {}

    fn exit(&self, _: &Id) {}
}

/// Gives what the library logs, up to a level, to a function of the program; else nothing is logged. Once for
/// the whole process (ZTL_E_STATE), for good, and best before anything else. `log` must not be NULL; `context` is
/// handed to it, stays the program's, and may be NULL. Any thread.
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
