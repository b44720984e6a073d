//! A client of a task server for C.

pub mod functions;

use std::ffi::{CStr, CString, c_char, c_int, c_uint, c_void};
use std::path::Path;
use std::ptr;
use std::sync::{Mutex, TryLockError};
use std::time::Duration;

use ztl_core::{State, TaskId};
use ztl_std::keys::{KeyPair, PublicKey};
use ztl_std::{RemoteId, RemoteTask, RequestError, Status, Triggered, WaitError};

use crate::border::{for_c, guard, null, text};
use crate::error::{
    Failure, ZTL_E_ARGUMENT, ZTL_E_BUSY, ZTL_E_NOT_ENDED, ZTL_E_NULL, ZTL_E_PANIC, ZTL_E_STATE,
    ZTL_OK,
};
use crate::server::read_keys;
use crate::{ZTL_LONG_TASK, ZTL_NO_TASK, ZTL_UNKNOWN};

/// A client of one scope of one server, from ztl_client_new to ztl_client_free. For one thread at a time: a call during
/// another one is ZTL_E_BUSY. Threads that use a server at the same time need a client each (ztl_client_clone).
pub struct Client(Mutex<Line>);

/// Called with each answer during a wait, on the waiting thread: ZTL_OK with the task's state and text, or an error with
/// ZTL_UNKNOWN and a message. The text belongs to the library and is valid during the call. Returns 0 to keep waiting;
/// any other value ends the wait with ZTL_E_NOT_ENDED. It must not use the client.
pub type Seen = Option<
    unsafe extern "C" fn(
        context: *mut c_void,
        error: c_int,
        state: c_int,
        text: *const c_char,
    ) -> c_int,
>;

#[derive(Default)]
struct Line {
    remote: Option<RemoteTask>,
    timeout: Option<Duration>,
    keys: Option<(KeyPair, PublicKey)>,
    /// The task that was started last.
    task: Option<RemoteId>,
    /// Its id in decimal digits.
    task_id: CString,
    /// The answer to the last call.
    text: CString,
    /// The message of the last call that failed.
    error: CString,
}

impl Line {
    fn remote(&mut self) -> Result<&mut RemoteTask, Failure> {
        let text = "the client is not connected: ztl_client_connect comes first";
        self.remote
            .as_mut()
            .ok_or_else(|| Failure::new(ZTL_E_STATE, text))
    }

    fn said(&mut self, status: &Status) -> c_int {
        self.text = for_c(&status.text);
        code(status.state)
    }
}

/// Why a wait ended before the task, and the task's last status.
struct NotEnded {
    failure: Failure,
    last: Option<Status>,
}

impl From<WaitError> for NotEnded {
    fn from(error: WaitError) -> Self {
        match error.last {
            Ok(status) => Self {
                failure: Failure::new(ZTL_E_NOT_ENDED, format!("still {}", status.state)),
                last: Some(status),
            },
            Err(cause) => Self {
                failure: cause.into(),
                last: None,
            },
        }
    }
}

impl From<Failure> for NotEnded {
    fn from(failure: Failure) -> Self {
        Self {
            failure,
            last: None,
        }
    }
}

impl Client {
    /// Does something with a client, and keeps the message of an error.
    ///
    /// # Safety
    /// `client` is NULL, or was made by this library and is not freed.
    unsafe fn with(
        client: *const Self,
        work: impl FnOnce(&mut Line) -> Result<(), Failure>,
    ) -> c_int {
        // SAFETY: as the caller promises; all references to it are shared ones.
        let Some(Self(line)) = (unsafe { client.as_ref() }) else {
            return ZTL_E_NULL;
        };
        let mut line = match line.try_lock() {
            Ok(line) => line,
            Err(TryLockError::Poisoned(line)) => line.into_inner(),
            // The texts belong to the thread that uses the client.
            Err(TryLockError::WouldBlock) => return ZTL_E_BUSY,
        };
        let panicked = || Failure::new(ZTL_E_PANIC, "a mistake in the library; see stderr");
        match guard(Err(panicked()), || work(&mut line)) {
            Ok(()) => ZTL_OK,
            Err(failure) => {
                line.error = for_c(&failure.text);
                failure.code
            }
        }
    }

    /// As [`with`](Self::with), and writes a task's state: ZTL_UNKNOWN unless it is known.
    ///
    /// # Safety
    /// As [`with`](Self::with); and nobody else uses `state`, unless it is NULL.
    unsafe fn ask(
        client: *const Self,
        state: *mut c_int,
        work: impl FnOnce(&mut Line) -> Result<Status, NotEnded>,
    ) -> c_int {
        let mut known = ZTL_UNKNOWN;
        let done = |line: &mut Line| match work(line) {
            Ok(status) => {
                known = line.said(&status);
                Ok(())
            }
            Err(NotEnded { failure, last }) => {
                if let Some(status) = last {
                    known = line.said(&status);
                }
                Err(failure)
            }
        };
        // SAFETY: as the caller promises.
        let code = unsafe { Self::with(client, done) };
        if !state.is_null() {
            // SAFETY: not NULL, and the caller's.
            unsafe { state.write(known) };
        }
        code
    }

    /// A text that the client holds.
    ///
    /// # Safety
    /// As [`with`](Self::with).
    unsafe fn held(client: *const Self, which: fn(&Line) -> &CStr) -> *const c_char {
        guard(c"".as_ptr(), || {
            // SAFETY: as the caller promises.
            let Some(Self(line)) = (unsafe { client.as_ref() }) else {
                return c"the client is NULL".as_ptr();
            };
            match line.try_lock() {
                Ok(line) => which(&line).as_ptr(),
                Err(TryLockError::Poisoned(line)) => which(&line.into_inner()).as_ptr(),
                Err(TryLockError::WouldBlock) => c"another thread uses this client".as_ptr(),
            }
        })
    }
}

const fn code(state: State) -> c_int {
    state.code() as c_int
}

fn id(task: c_uint) -> Result<RemoteId, Failure> {
    if task == ZTL_LONG_TASK {
        let text = "the task's id does not fit in an unsigned int: give the text of ztl_client_task_id \
                    to ztl_client_wait_by_id and its like";
        return Err(Failure::new(ZTL_E_ARGUMENT, text));
    }
    let id = TaskId::new(task).map(RemoteId::from);
    id.ok_or_else(|| Failure::new(ZTL_E_ARGUMENT, "no task has the id 0"))
}

/// The number for an id in C.
fn number(id: &RemoteId) -> c_uint {
    id.number().map_or(ZTL_LONG_TASK, TaskId::get)
}

/// An id in a text from C.
///
/// # Safety
/// As [`text`].
unsafe fn by_id(id: *const c_char) -> Result<RemoteId, Failure> {
    // SAFETY: as the caller promises.
    let written = unsafe { text(id, "id") }?;
    let id = written.parse().ok().filter(RemoteId::names_task);
    id.ok_or_else(|| {
        let text = format!("invalid task id '{written}': expected a whole number above 0");
        Failure::new(ZTL_E_ARGUMENT, text)
    })
}

/// A negative limit means forever.
fn limit(limit_ms: c_int) -> Option<Duration> {
    u64::try_from(limit_ms).ok().map(Duration::from_millis)
}

fn trigger(
    line: &mut Line,
    handler: &str,
    component: &str,
    goal: &str,
) -> Result<RemoteId, Failure> {
    line.task = None;
    line.task_id = CString::default();
    for (name, part) in [("handler", handler), ("component", component)] {
        if part.contains(':') {
            let text = format!("the {name} '{part}' must not contain ':', which would end it");
            return Err(Failure::new(ZTL_E_ARGUMENT, text));
        }
    }
    let triggered = line.remote()?.trigger(handler, component, goal);
    let triggered = triggered.map_err(Failure::from);
    // A rejection is an answer as well.
    line.text = match &triggered {
        Ok(triggered) => for_c(&triggered.reply),
        Err(failure) => for_c(&failure.text),
    };
    let Triggered { id, .. } = triggered?;
    line.task_id = for_c(id.as_str());
    line.task = Some(id.clone());
    Ok(id)
}

fn not_connected(line: &Line) -> Result<(), Failure> {
    match line.remote {
        None => Ok(()),
        Some(_) => Err(Failure::new(
            ZTL_E_STATE,
            "the client is already connected; call this before",
        )),
    }
}

fn no_address(endpoint: &str, error: RequestError) -> Failure {
    let is_scope = matches!(error, RequestError::Scope(_));
    let failure = Failure::from(error);
    match failure.code {
        ZTL_E_ARGUMENT if !is_scope => {
            let text = format!("'{endpoint}' is not an address; write it as tcp://robot:12345");
            Failure::new(ZTL_E_ARGUMENT, text)
        }
        _ => failure,
    }
}
