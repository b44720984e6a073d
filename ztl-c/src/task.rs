//! What a server's callbacks tell of a task.

use std::ffi::{c_char, c_int, c_uint};
use std::time::Duration;

use ztl_core::{State, TaskId};

use crate::border::{guard, text};
use crate::error::{Failure, ZTL_E_ARGUMENT, ZTL_E_ENDED};
use crate::server::Server;
use crate::{ZTL_ABORTED, ZTL_COMPLETED, ZTL_FAILED, ZTL_REJECTED};

/// The id behind a number from C.
fn id(task: c_uint) -> Result<TaskId, Failure> {
    TaskId::new(task).ok_or_else(|| Failure::new(ZTL_E_ENDED, "no task has the id 0"))
}

/// The task is taken, and its client is told so. Not needed after ztl_task_progress or ztl_task_end, which
/// say it too, nor in a `start`. A task that nobody has decided upon after 1.5 s is answered with its id
/// all the same. Any thread, from a task's beginning to its end (ZTL_E_ENDED); so are all ztl_task_....
#[unsafe(no_mangle)]
pub unsafe extern "C" fn ztl_task_accept(server: *mut Server, task: c_uint) -> c_int {
    // SAFETY: NULL, or a server that is not freed, as its caller promises.
    unsafe { Server::with(server, |server| server.tasks()?.accept(id(task)?)) }
}

/// Where the task is now, for its clients; the latest is what they see. The text is copied, and must not be
/// NULL.
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

/// Ends the task: as ZTL_COMPLETED with its result, ZTL_FAILED or ZTL_REJECTED with the reason, or
/// ZTL_ABORTED with where it stopped. ZTL_REJECTED says that nothing was done: of a task that was
/// accepted already it becomes FAILED. The first end counts; a later one is ZTL_E_ENDED and changes
/// nothing. The text is copied, and must not be NULL.
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
                        "{other} is no end of a task; there are ZTL_COMPLETED, ZTL_FAILED, ZTL_ABORTED and ZTL_REJECTED"
                    );
                    return Err(Failure::new(ZTL_E_ARGUMENT, text));
                }
            };
            server.tasks()?.end(id(task)?, end, result)
        })
    }
}

/// 1 when the task should stop, since somebody asked for it or it has ended (or the server is NULL), else 0.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn ztl_task_is_aborted(server: *mut Server, task: c_uint) -> c_int {
    guard(1, || {
        // SAFETY: NULL, or a server that is not freed, as its caller promises.
        let tasks = unsafe { server.as_ref() }.and_then(|server| server.tasks().ok());
        let runs = tasks.zip(TaskId::new(task));
        c_int::from(runs.is_none_or(|(tasks, id)| tasks.is_aborted(id)))
    })
}

/// Waits for so many milliseconds; ZTL_E_ABORTED as soon as somebody asks to stop the task.
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

/// The task cannot be stopped and goes on, as the client that asked for it is told.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn ztl_task_refuse_abort(server: *mut Server, task: c_uint) -> c_int {
    // SAFETY: NULL, or a server that is not freed, as its caller promises.
    unsafe { Server::with(server, |server| server.tasks()?.refuse_abort(id(task)?)) }
}

/// The task is to be stopped when nothing has come from its client for so many milliseconds (5000 or more),
/// though it had asked for something after the task began. Never happens to a client that does not say who
/// it is, as the Python original's.
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
