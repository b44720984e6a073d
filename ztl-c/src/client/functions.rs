//! The functions of a client for C.

use super::*;

/// Creates a client that is not connected; NULL if the memory is not enough. Any thread. The caller frees it with
/// ztl_client_free.
#[unsafe(no_mangle)]
pub extern "C" fn ztl_client_new() -> *mut Client {
    guard(ptr::null_mut(), || {
        Box::into_raw(Box::new(Client(Mutex::default())))
    })
}

/// Creates another client of the same server and scope, with the same keys and timeout. NULL if this one is NULL or in
/// use, or there is no memory. The caller frees it; it may outlive this one.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn ztl_client_clone(client: *const Client) -> *mut Client {
    let mut clone = ptr::null_mut();
    let copy = |line: &mut Line| {
        let copy = Line {
            remote: line.remote.clone(),
            timeout: line.timeout,
            keys: line.keys.clone(),
            ..Line::default()
        };
        clone = Box::into_raw(Box::new(Client(Mutex::new(copy))));
        Ok(())
    };
    // SAFETY: NULL, or a client that is not freed, as its caller promises.
    unsafe { Client::with(client, copy) };
    clone
}

/// Frees a client and the texts that it returned; its tasks continue. Any thread. Does nothing for NULL.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn ztl_client_free(client: *mut Client) {
    if !client.is_null() {
        // SAFETY: made by `Box::into_raw` above and not freed before, as its caller promises.
        guard((), || drop(unsafe { Box::from_raw(client) }));
    }
}

/// The answer to the last call: progress, result, or the server's reason; "" at first. It belongs to the client and is
/// valid until the next call with it other than this one and ztl_client_error. Never NULL: for a client that is NULL or
/// used by another thread, it is a text that says so and stays valid.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn ztl_client_text(client: *const Client) -> *const c_char {
    // SAFETY: NULL, or a client that is not freed, as its caller promises.
    unsafe { Client::held(client, |line| &line.text) }
}

/// The message of the last call that failed; "" at first. It belongs to the client and is valid until the next call with
/// it other than this one and ztl_client_text. Never NULL, like ztl_client_text.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn ztl_client_error(client: *const Client) -> *const c_char {
    // SAFETY: NULL, or a client that is not freed, as its caller promises.
    unsafe { Client::held(client, |line| &line.error) }
}

/// The id of the task last started with ztl_client_trigger or ztl_client_run, in decimal digits of any number; "" if the
/// server assigned none. It belongs to the client and is valid until the next call of one of these two. Never NULL, like
/// ztl_client_text.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn ztl_client_task_id(client: *const Client) -> *const c_char {
    // SAFETY: NULL, or a client that is not freed, as its caller promises.
    unsafe { Client::held(client, |line| &line.task_id) }
}

/// Sets the time limit for each answer in milliseconds; default 2000. The time limit of a task is the limit of
/// ztl_client_wait. Call it before ztl_client_connect.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn ztl_client_set_timeout(client: *mut Client, timeout_ms: c_uint) -> c_int {
    // SAFETY: NULL, or a client that is not freed, as its caller promises.
    unsafe {
        Client::with(client, |line| {
            not_connected(line)?;
            line.timeout = Some(Duration::from_millis(timeout_ms.into()));
            Ok(())
        })
    }
}

/// Encrypts with the client's own keys in a file such as "ann.key_secret" (made by `ztl keys ann`); accepts only the
/// server with the public key in the other file, such as "robot.key". Call it before ztl_client_connect. The texts are
/// copied.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn ztl_client_use_keys(
    client: *mut Client,
    own_secret_file: *const c_char,
    server_public_file: *const c_char,
) -> c_int {
    // SAFETY: NULL, or a client that is not freed and texts, as their caller promises.
    unsafe {
        Client::with(client, |line| {
            not_connected(line)?;
            let own = read_keys(text(own_secret_file, "own_secret_file")?)?;
            let server = text(server_public_file, "server_public_file")?;
            line.keys = Some((own, PublicKey::read(Path::new(server))?));
            Ok(())
        })
    }
}

/// Connects to a server such as "tcp://robot:12345" and a scope such as "/robot", without ';'. Call it once, before any
/// request. The server need not be there yet. The texts are copied.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn ztl_client_connect(
    client: *mut Client,
    endpoint: *const c_char,
    scope: *const c_char,
) -> c_int {
    // SAFETY: NULL, or a client that is not freed and texts, as their caller promises.
    unsafe {
        Client::with(client, |line| {
            not_connected(line)?;
            let (endpoint, scope) = (text(endpoint, "endpoint")?, text(scope, "scope")?);
            let connected = crate::signals::blocked(|| RemoteTask::connect(endpoint, scope));
            let mut remote = connected.map_err(|error| no_address(endpoint, error))?;
            if let Some(timeout) = line.timeout {
                remote = remote.with_timeout(timeout);
            }
            if let Some((own, server)) = line.keys.clone() {
                remote = remote.with_keys(own, server)?;
            }
            line.remote = Some(remote);
            Ok(())
        })
    }
}

/// Starts a task such as "robot", "head", "left", and writes its id: ZTL_NO_TASK with any error. After ZTL_E_NO_ANSWER,
/// ZTL_E_UNREADABLE and ZTL_E_SYSTEM the task may run; after any other error it does not. A request is never sent twice.
/// An id that does not fit is ZTL_LONG_TASK; see ztl_client_task_id. The texts are copied and must not be NULL; `task`
/// may be NULL.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn ztl_client_trigger(
    client: *mut Client,
    handler: *const c_char,
    component: *const c_char,
    goal: *const c_char,
    task: *mut c_uint,
) -> c_int {
    let mut given = ZTL_NO_TASK;
    // SAFETY: NULL, or a client that is not freed and texts, as their caller promises.
    let code = unsafe {
        Client::with(client, |line| {
            let (handler, component) = (text(handler, "handler")?, text(component, "component")?);
            let goal = text(goal, "goal")?;
            given = number(&trigger(line, handler, component, goal)?);
            Ok(())
        })
    };
    if !task.is_null() {
        // SAFETY: not NULL, and the caller's.
        unsafe { task.write(given) };
    }
    code
}

fn status(line: &mut Line, id: RemoteId) -> Result<Status, NotEnded> {
    let status = line.remote()?.status(id);
    Ok(status.map_err(Failure::from)?)
}

fn abort(line: &mut Line, id: RemoteId) -> Result<Status, NotEnded> {
    let status = line.remote()?.abort(id);
    Ok(status.map_err(Failure::from)?)
}

/// Asks for a task's state; ztl_client_text returns its text. With any error the state is ZTL_UNKNOWN: a missing answer
/// never counts as an end, and a task that the server does not know is ZTL_E_UNKNOWN_TASK. `state` may be NULL.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn ztl_client_status(
    client: *mut Client,
    task: c_uint,
    state: *mut c_int,
) -> c_int {
    // SAFETY: NULL, or a client that is not freed, and a number, as their caller promises.
    unsafe { Client::ask(client, state, |line| status(line, id(task)?)) }
}

/// As ztl_client_status, with the task's id in decimal digits. The text is copied and must not be NULL.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn ztl_client_status_by_id(
    client: *mut Client,
    id: *const c_char,
    state: *mut c_int,
) -> c_int {
    // SAFETY: NULL, or a client that is not freed, a text and a number, as their caller promises.
    unsafe { Client::ask(client, state, |line| status(line, by_id(id)?)) }
}

/// Asks to stop a task, and writes its state: ZTL_ABORTED, a final state that it had already reached, or ZTL_ACCEPTED
/// while it is not stopped yet or cannot be stopped. Otherwise as ztl_client_status.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn ztl_client_abort(
    client: *mut Client,
    task: c_uint,
    state: *mut c_int,
) -> c_int {
    // SAFETY: NULL, or a client that is not freed, and a number, as their caller promises.
    unsafe { Client::ask(client, state, |line| abort(line, id(task)?)) }
}

/// As ztl_client_abort, with the task's id in decimal digits. The text is copied and must not be NULL.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn ztl_client_abort_by_id(
    client: *mut Client,
    id: *const c_char,
    state: *mut c_int,
) -> c_int {
    // SAFETY: NULL, or a client that is not freed, a text and a number, as their caller promises.
    unsafe { Client::ask(client, state, |line| abort(line, by_id(id)?)) }
}

/// Waits for a task's end, at most for this time in milliseconds; a negative limit means forever. ZTL_OK: it has ended
/// in the final state `state`. ZTL_E_NOT_ENDED: it continues in this state. With any other error the state is
/// ZTL_UNKNOWN. ZTL_E_UNKNOWN_TASK: the server does not know it. ZTL_E_UNREADABLE, ZTL_E_NOT_TOLD: the server answered
/// without telling its state. Any other error: the server did not answer at the end of the limit. A server that does
/// not answer does not end the wait earlier. `state` may be NULL; ztl_client_text returns the text.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn ztl_client_wait(
    client: *mut Client,
    task: c_uint,
    limit_ms: c_int,
    state: *mut c_int,
) -> c_int {
    // SAFETY: NULL, or a client that is not freed, and a number, as their caller promises.
    unsafe {
        Client::ask(client, state, |line| {
            Ok(line.remote()?.wait(id(task)?, limit(limit_ms))?)
        })
    }
}

/// As ztl_client_wait; calls `seen`, which must not be NULL, with each answer. `context` is passed to it, belongs to the
/// program, and may be NULL.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn ztl_client_wait_seeing(
    client: *mut Client,
    task: c_uint,
    limit_ms: c_int,
    seen: Seen,
    context: *mut c_void,
    state: *mut c_int,
) -> c_int {
    // SAFETY: NULL, or a client that is not freed, and a number, as their caller promises.
    unsafe {
        Client::ask(client, state, |line| {
            if seen.is_none() {
                return Err(null("seen").into());
            }
            wait_seeing(line, &id(task)?, limit_ms, seen, context)
        })
    }
}

/// As ztl_client_wait_seeing, with the task's id in decimal digits; as ztl_client_wait if `seen` is NULL. The text is
/// copied and must not be NULL.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn ztl_client_wait_by_id(
    client: *mut Client,
    id: *const c_char,
    limit_ms: c_int,
    seen: Seen,
    context: *mut c_void,
    state: *mut c_int,
) -> c_int {
    // SAFETY: NULL, or a client that is not freed, a text and a number, as their caller promises.
    unsafe {
        Client::ask(client, state, |line| {
            wait_seeing(line, &by_id(id)?, limit_ms, seen, context)
        })
    }
}

/// Waits for a task's end, and calls `seen` with each answer.
///
/// # Safety
/// `seen` may be called with `context`, as the header says.
unsafe fn wait_seeing(
    line: &mut Line,
    id: &RemoteId,
    limit_ms: c_int,
    seen: Seen,
    context: *mut c_void,
) -> Result<Status, NotEnded> {
    let (remote, limit) = (line.remote()?, limit(limit_ms));
    let Some(seen) = seen else {
        return Ok(remote.wait(id, limit)?);
    };
    let show = |answer: &Result<Status, RequestError>| {
        let (error, state, text) = match answer {
            Ok(status) => (ZTL_OK, code(status.state), for_c(&status.text)),
            Err(error) => {
                let failure = Failure::from(error.clone());
                (failure.code, ZTL_UNKNOWN, for_c(&failure.text))
            }
        };
        // SAFETY: the program's function, called as the header says; the text outlives the call.
        unsafe { seen(context, error, state, text.as_ptr()) == 0 }
    };
    Ok(remote.wait_with(id, limit, show)?)
}

/// Starts a task and waits for its end: ztl_client_trigger, then ztl_client_wait, with the errors of both. The id is
/// written to `task` as soon as it is known, so that the task can be stopped; `task` and `state` may be NULL.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn ztl_client_run(
    client: *mut Client,
    handler: *const c_char,
    component: *const c_char,
    goal: *const c_char,
    limit_ms: c_int,
    task: *mut c_uint,
    state: *mut c_int,
) -> c_int {
    let mut given = ZTL_NO_TASK;
    // SAFETY: NULL, or a client that is not freed, texts, and numbers, as their caller promises.
    unsafe {
        let code = ztl_client_trigger(client, handler, component, goal, &raw mut given);
        if !task.is_null() {
            task.write(given);
        }
        if code == ZTL_OK {
            return Client::ask(client, state, |line| {
                let id = line.task.clone().ok_or_else(|| null("task"))?;
                Ok(line.remote()?.wait(&id, limit(limit_ms))?)
            });
        }
        if !state.is_null() {
            state.write(ZTL_UNKNOWN);
        }
        code
    }
}

/// Asks the server about itself, for example "tasks" or "devices". ztl_client_text returns the answer in JSON, or "" if
/// the server does not know the question (the Python original knows none). The text is copied.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn ztl_client_ask(client: *mut Client, question: *const c_char) -> c_int {
    // SAFETY: NULL, or a client that is not freed and a text, as their caller promises.
    unsafe {
        Client::with(client, |line| {
            let question = text(question, "question")?;
            let answer = line.remote()?.ask_server(question)?;
            line.text = for_c(&answer.unwrap_or_default());
            Ok(())
        })
    }
}
