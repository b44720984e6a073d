//! Errors as numbers and texts.

use std::ffi::{c_char, c_int};

use ztl_std::keys::KeyError;
use ztl_std::{BindError, RequestError, TriggerError};

/// Success.
pub const ZTL_OK: c_int = 0;
/// An argument is NULL that must not be NULL.
pub const ZTL_E_NULL: c_int = -1;
/// An argument is invalid: not UTF-8, not an address, or an unknown setting.
pub const ZTL_E_ARGUMENT: c_int = -2;
/// The call is too early, too late, or from within a callback.
pub const ZTL_E_STATE: c_int = -3;
/// Another thread is using the object.
pub const ZTL_E_BUSY: c_int = -4;
/// The address is in use, or cannot be used.
pub const ZTL_E_ADDRESS: c_int = -5;
/// The system has no more sockets, threads or memory.
pub const ZTL_E_SYSTEM: c_int = -6;
/// A key or its file is invalid.
pub const ZTL_E_KEY: c_int = -8;
/// Server: the task has ended, or is unknown to this server.
pub const ZTL_E_ENDED: c_int = -9;
/// Server: the task was asked to stop.
pub const ZTL_E_ABORTED: c_int = -10;
/// Client: no connection within the time limit. Nothing was sent: a task that was to be started does not run, and
/// nothing is known about one that runs.
pub const ZTL_E_NOT_CONNECTED: c_int = -11;
/// Client: sent, but not answered within the time limit. Whether the server acted is unknown: the task may run.
pub const ZTL_E_NO_ANSWER: c_int = -12;
/// Client: the server rejected the task; nothing was done.
pub const ZTL_E_REFUSED: c_int = -13;
/// Client: the request never reached the server, which will reject it from now on: nothing runs.
pub const ZTL_E_NEVER_CAME: c_int = -14;
/// Client: the server was restarted or has forgotten the task, or could not learn how the task ended. Whether and how
/// it ended is unknown.
pub const ZTL_E_UNKNOWN_TASK: c_int = -15;
/// Client: the answer is not a ZTL message, its state is undefined, or it is about another task. What the task does is
/// unknown; it may run.
pub const ZTL_E_UNREADABLE: c_int = -16;
/// Client: the task did not end within the limit of the wait. It continues.
pub const ZTL_E_NOT_ENDED: c_int = -17;
/// A mistake in this library, which printed a line to stderr.
pub const ZTL_E_PANIC: c_int = -18;
/// Client: the request is longer than the server accepts. Nothing was sent.
pub const ZTL_E_TOO_LONG: c_int = -19;

/// Client: the server answered without telling the task's state: the scope is not served (yet), or the handler failed.
/// The task may run.
pub const ZTL_E_NOT_TOLD: c_int = -20;

/// The name of an error, such as "ZTL_E_NULL"; "ZTL_E_?" for any other number. Any thread. The text belongs to the
/// library and stays valid.
#[unsafe(no_mangle)]
pub extern "C" fn ztl_error_name(error: c_int) -> *const c_char {
    let name = match error {
        ZTL_OK => c"ZTL_OK",
        ZTL_E_NULL => c"ZTL_E_NULL",
        ZTL_E_ARGUMENT => c"ZTL_E_ARGUMENT",
        ZTL_E_STATE => c"ZTL_E_STATE",
        ZTL_E_BUSY => c"ZTL_E_BUSY",
        ZTL_E_ADDRESS => c"ZTL_E_ADDRESS",
        ZTL_E_SYSTEM => c"ZTL_E_SYSTEM",
        ZTL_E_KEY => c"ZTL_E_KEY",
        ZTL_E_ENDED => c"ZTL_E_ENDED",
        ZTL_E_ABORTED => c"ZTL_E_ABORTED",
        ZTL_E_NOT_CONNECTED => c"ZTL_E_NOT_CONNECTED",
        ZTL_E_NO_ANSWER => c"ZTL_E_NO_ANSWER",
        ZTL_E_REFUSED => c"ZTL_E_REFUSED",
        ZTL_E_NEVER_CAME => c"ZTL_E_NEVER_CAME",
        ZTL_E_UNKNOWN_TASK => c"ZTL_E_UNKNOWN_TASK",
        ZTL_E_UNREADABLE => c"ZTL_E_UNREADABLE",
        ZTL_E_NOT_ENDED => c"ZTL_E_NOT_ENDED",
        ZTL_E_PANIC => c"ZTL_E_PANIC",
        ZTL_E_TOO_LONG => c"ZTL_E_TOO_LONG",
        ZTL_E_NOT_TOLD => c"ZTL_E_NOT_TOLD",
        _ => c"ZTL_E_?",
    };
    name.as_ptr()
}

/// Why a call failed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Failure {
    pub(crate) code: c_int,
    pub(crate) text: String,
}

impl Failure {
    pub(crate) fn new(code: c_int, text: impl Into<String>) -> Self {
        Self {
            code,
            text: text.into(),
        }
    }
}

impl From<BindError> for Failure {
    fn from(error: BindError) -> Self {
        let code = match error {
            BindError::InUse { .. } | BindError::Endpoint { .. } => ZTL_E_ADDRESS,
            _ => ZTL_E_SYSTEM,
        };
        Self::new(code, error.to_string())
    }
}

impl From<KeyError> for Failure {
    fn from(error: KeyError) -> Self {
        Self::new(ZTL_E_KEY, error.to_string())
    }
}

impl From<RequestError> for Failure {
    fn from(error: RequestError) -> Self {
        let code = match &error {
            RequestError::NotConnected { .. } => ZTL_E_NOT_CONNECTED,
            RequestError::TooLong { .. } => ZTL_E_TOO_LONG,
            RequestError::NoAnswer { .. } => ZTL_E_NO_ANSWER,
            RequestError::UnknownTask { .. } | RequestError::UnknownOutcome { .. } => {
                ZTL_E_UNKNOWN_TASK
            }
            RequestError::NotTold { .. } => ZTL_E_NOT_TOLD,
            RequestError::UndefinedState { .. }
            | RequestError::OtherTask { .. }
            | RequestError::Unreadable { .. } => ZTL_E_UNREADABLE,
            RequestError::Scope(_) | RequestError::Endpoint { .. } => ZTL_E_ARGUMENT,
            _ => ZTL_E_SYSTEM,
        };
        Self::new(code, error.to_string())
    }
}

impl From<TriggerError> for Failure {
    fn from(error: TriggerError) -> Self {
        let text = error.to_string();
        match error {
            TriggerError::Rejected { reason, .. } => Self::new(ZTL_E_REFUSED, reason),
            TriggerError::Request(cause) => Self {
                text,
                ..cause.into()
            },
            _ => Self::new(ZTL_E_NEVER_CAME, text),
        }
    }
}
