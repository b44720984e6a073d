//! What a server's callbacks report about a task.

use std::ffi::{c_char, c_int, c_uint};
use std::time::Duration;

use ztl_core::{State, TaskId};

use crate::border::{guard, text};
use crate::error::{Failure, ZTL_E_ARGUMENT, ZTL_E_ENDED};
use crate::server::Server;
use crate::{ZTL_ABORTED, ZTL_COMPLETED, ZTL_FAILED, ZTL_REJECTED};

/// A task id from C.
fn id(task: c_uint) -> Result<TaskId, Failure> {
    TaskId::new(task).ok_or_else(|| Failure::new(ZTL_E_ENDED, "no task has the id 0"))
}

/// Accepts the task and informs its client. Not needed after ztl_task_progress or ztl_task_end, which accept it too,
/// nor in a `start`. The client of a task that is undecided after 1.5 s gets its id anyway. Like all ztl_task_...
/// functions: any thread, from the start of a task to its end (then ZTL_E_ENDED).
#[unsafe(no_mangle)]
pub unsafe extern "C" fn ztl_task_accept(server: *mut Server, task: c_uint) -> c_int {
    // SAFETY: NULL, or a server that is not freed, as its caller promises.
    unsafe { Server::with(server, |server| server.tasks()?.accept(id(task)?)) }
}

/// Sets the progress that clients see. The text is copied and must not be NULL.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn ztl_task_progress(
    server: *mut Server,
    task: c_uint,
    progress: *const c_char,
) -> c_int {
    // SAFETY: NULL, or a server that is not freed and a text, as their caller promises.
    unsafe {
        Server::with(server, |server| {
            let progress = text(progress, "progress")?;
            server.tasks()?.progress(id(task)?, progress)
        })
    }
}

/// Ends the task: as ZTL_COMPLETED with the result, ZTL_FAILED or ZTL_REJECTED with the reason, or ZTL_ABORTED with
/// where it stopped. ZTL_REJECTED means that nothing was done; a task that was accepted becomes FAILED instead. The
/// first end counts; a later one is ZTL_E_ENDED and changes nothing. The text is copied and must not be NULL.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn ztl_task_end(
    server: *mut Server,
    task: c_uint,
    state: c_int,
    result: *const c_char,
) -> c_int {
    // SAFETY: NULL, or a server that is not freed and a text, as their caller promises.
    unsafe {
        Server::with(server, |server| {
            let result = text(result, "result")?;
            let end = match state {
                ZTL_COMPLETED => State::Completed,
                ZTL_FAILED => State::Failed,
                ZTL_REJECTED => State::Rejected,
                ZTL_ABORTED => State::Aborted,
                other => {
                    let text = format!(
                        "{other} is not a final state; there are ZTL_COMPLETED, ZTL_FAILED, ZTL_ABORTED and ZTL_REJECTED"
                    );
                    return Err(Failure::new(ZTL_E_ARGUMENT, text));
                }
            };
            server.tasks()?.end(id(task)?, end, result)
        })
    }
}

/// 1 if the task should stop because of an abort, has ended, or the server is NULL; else 0.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn ztl_task_is_aborted(server: *mut Server, task: c_uint) -> c_int {
    guard(1, || {
        // SAFETY: NULL, or a server that is not freed, as its caller promises.
        let tasks = unsafe { server.as_ref() }.and_then(|server| server.tasks().ok());
        let runs = tasks.zip(TaskId::new(task));
        c_int::from(runs.is_none_or(|(tasks, id)| tasks.is_aborted(id)))
    })
}

/// Sleeps; returns ZTL_E_ABORTED as soon as the task is asked to stop.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn ztl_task_sleep(
    server: *mut Server,
    task: c_uint,
    time_ms: c_uint,
) -> c_int {
    // SAFETY: NULL, or a server that is not freed, as its caller promises.
    unsafe {
        Server::with(server, |server| {
            let time = Duration::from_millis(time_ms.into());
            server.tasks()?.sleep(id(task)?, time)
        })
    }
}

/// Informs the client that asked to stop the task that the task cannot be stopped and continues.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn ztl_task_reject_abort(server: *mut Server, task: c_uint) -> c_int {
    // SAFETY: NULL, or a server that is not freed, as its caller promises.
    unsafe { Server::with(server, |server| server.tasks()?.reject_abort(id(task)?)) }
}

/// Stops the task when its client is silent for this time (5000 ms or more) after it was told that the task has started.
/// A clone of a client is another client. Has no effect for clients that do not identify themselves, such as the Python
/// original's.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn ztl_task_needs_client(
    server: *mut Server,
    task: c_uint,
    silence_ms: c_uint,
) -> c_int {
    // SAFETY: NULL, or a server that is not freed, as its caller promises.
    unsafe {
        Server::with(server, |server| {
            let silence = Duration::from_millis(silence_ms.into());
            server.tasks()?.needs_client(id(task)?, silence)
        })
    }
}
