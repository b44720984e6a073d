//! The functions of a server for C.

use super::*;

/// Creates a server that is not started; NULL if the memory is not enough. Any thread. The caller frees it with
/// ztl_server_free.
#[unsafe(no_mangle)]
pub extern "C" fn ztl_server_new() -> *mut Server {
    guard(ptr::null_mut(), || {
        Box::into_raw(Box::new(Server {
            setup: Mutex::default(),
            running: Mutex::default(),
            tasks: Mutex::default(),
            turn: Mutex::default(),
            error: Mutex::default(),
        }))
    })
}

/// Stops and frees a server. Running tasks are asked to stop (their `abort` is called, within this call if
/// ztl_server_poll makes the calls); those that have not ended after 1.4 s end as FAILED. Requests are answered for
/// up to 2 s longer, until a client has asked for the end of each task. Then waits until every callback has
/// returned, however long that takes. Any thread; within a callback it is ZTL_E_STATE, and nothing is freed. Apart
/// from its callbacks, nothing may use the server during or after this call. NULL is ZTL_OK.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn ztl_server_free(server: *mut Server) -> c_int {
    if server.is_null() {
        return ZTL_OK;
    }
    // SAFETY: not NULL, and not freed before, as its caller promises.
    let stopped = unsafe {
        Server::with(server, |handle| {
            if CALLED.with_borrow(|called| called.contains(&server)) {
                let text = "a server cannot be freed by its own callback, which it waits for";
                return Err(Failure::new(ZTL_E_STATE, text));
            }
            handle.stop();
            Ok(())
        })
    };
    if stopped != ZTL_E_STATE {
        // SAFETY: made by `Box::into_raw` in `ztl_server_new`, and no longer used by anyone.
        drop(guard(None, || Some(unsafe { Box::from_raw(server) })));
        return ZTL_OK;
    }
    stopped
}

/// Copies the message of the last call that failed with this server into a buffer of this size, truncated to fit and
/// ended by a zero; returns the length of the whole message. Any thread. The buffer belongs to the caller; if it is
/// NULL or its size is 0, only the length is returned. For a server that is NULL: 0 and an empty text.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn ztl_server_error(
    server: *const Server,
    buffer: *mut c_char,
    size: usize,
) -> usize {
    guard(0, || {
        // SAFETY: NULL, or a server that is not freed, as its caller promises.
        let error = unsafe { server.as_ref() }.map(|server| lock(&server.error).clone());
        // SAFETY: the buffer is the caller's, and has this size.
        unsafe { copy_out(&error.unwrap_or_default(), buffer, size) }
    })
}

/// Sets one of the limits above, such as ZTL_MAX_RUNNING. Any thread; before the start.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn ztl_server_set(
    server: *mut Server,
    setting: c_int,
    value: c_uint,
) -> c_int {
    // SAFETY: NULL, or a server that is not freed, as its caller promises.
    unsafe {
        Server::with(server, |server| {
            server.set_up(|setup| {
                let count = usize::try_from(value).unwrap_or(usize::MAX);
                let limits = &mut setup.limits;
                match setting {
                    ZTL_MAX_MESSAGE => limits.message = count,
                    ZTL_MAX_RUNNING => limits.running = count,
                    ZTL_MAX_REMEMBERED => limits.remembered = count,
                    ZTL_KEEP_MS => limits.keep = millis(value),
                    ZTL_MAX_HELD => limits.held = count,
                    ZTL_MAX_CLIENTS => limits.clients = count,
                    ZTL_MAX_QUEUE => limits.queue = count,
                    ZTL_MAX_CONNECTIONS => limits.connections = count,
                    ZTL_HANDSHAKE_MS => limits.handshake = millis(value),
                    ZTL_POLL_MS => setup.poll_every = Some(millis(value.max(1))),
                    other => {
                        let text = format!("there is no setting {other}; see ztl.h");
                        return Err(Failure::new(ZTL_E_ARGUMENT, text));
                    }
                }
                Ok(())
            })
        })
    }
}

/// Admits clients with an address in this network, such as "192.168.1.0/24". Once a network is given, all others are
/// excluded. Any thread; before the start. The text is copied.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn ztl_server_allow_network(
    server: *mut Server,
    network: *const c_char,
) -> c_int {
    // SAFETY: NULL, or a server that is not freed and a text, as their caller promises.
    unsafe {
        Server::with(server, |server| {
            let network = text(network, "network")?;
            let network = network.parse().map_err(|_| {
                let text = format!("'{network}' is not a network; write it as 192.168.1.0/24");
                Failure::new(ZTL_E_ARGUMENT, text)
            })?;
            server.set_up(|setup| {
                setup.access = std::mem::take(&mut setup.access).from_network(network);
                Ok(())
            })
        })
    }
}

/// Encrypts with the keys in a file such as "robot.key_secret" (made by `ztl keys robot`). Then only clients with an
/// allowed key may use anything. Any thread; before the start. The text is copied.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn ztl_server_use_keys(
    server: *mut Server,
    secret_file: *const c_char,
) -> c_int {
    // SAFETY: NULL, or a server that is not freed and a text, as their caller promises.
    unsafe {
        Server::with(server, |server| {
            let keys = read_keys(text(secret_file, "secret_file")?)?;
            server.set_up(|setup| {
                setup.access = std::mem::take(&mut setup.access).with_keys(keys);
                Ok(())
            })
        })
    }
}

/// Allows the client whose public key is in a file such as "ann.key", or every client in a directory of such files.
/// `scope` is the scope that it may use; NULL means all. Any thread; before the start. The texts are copied.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn ztl_server_allow_key(
    server: *mut Server,
    scope: *const c_char,
    public_file: *const c_char,
) -> c_int {
    // SAFETY: NULL, or a server that is not freed and texts, as their caller promises.
    unsafe {
        Server::with(server, |server| {
            let scope = match scope.is_null() {
                true => None,
                false => Some(text(scope, "scope")?),
            };
            let keys = PublicKey::read_all(Path::new(text(public_file, "public_file")?))?;
            server.set_up(|setup| {
                for key in keys {
                    let access = std::mem::take(&mut setup.access);
                    setup.access = match scope {
                        Some(scope) => access.allow_scope(scope, key),
                        None => access.allow(key),
                    };
                }
                Ok(())
            })
        })
    }
}

/// Serves a scope such as "/robot" with a function that carries out a whole task. Each task has a thread of its own with
/// all signals blocked. `context` is passed to the function, belongs to the program, and may be NULL; `work` must not
/// be NULL. Any thread; before the start. The text is copied.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn ztl_server_add_worker(
    server: *mut Server,
    scope: *const c_char,
    work: WorkCall,
    context: *mut c_void,
) -> c_int {
    // SAFETY: NULL, or a server that is not freed and a text, as their caller promises.
    unsafe {
        Server::with(server, |server| {
            work.ok_or_else(|| null("work"))?;
            server.add(text(scope, "scope")?, Functions::Worker(work), context)
        })
    }
}

/// Serves a scope with short calls, one at a time for the whole server: on a thread of the library after
/// ztl_server_start, or in ztl_server_poll after ztl_server_start_polled. `poll` and `abort` may be NULL; then the
/// program advances its tasks by itself and checks ztl_task_is_aborted. `context` is passed to the functions, belongs to
/// the program, and may be NULL; `start` must not be NULL. Any thread; before the start. The text is copied.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn ztl_server_add_handler(
    server: *mut Server,
    scope: *const c_char,
    start: StartCall,
    poll: PollCall,
    abort: AbortCall,
    context: *mut c_void,
) -> c_int {
    // SAFETY: NULL, or a server that is not freed and a text, as their caller promises.
    unsafe {
        Server::with(server, |server| {
            start.ok_or_else(|| null("start"))?;
            let functions = Functions::Handler { start, poll, abort };
            server.add(text(scope, "scope")?, functions, context)
        })
    }
}

/// Says what goals a component of a served scope takes, and what it does, for `ztl describe`, `ztl check` and others. The
/// library does not check goals by it. `description` is JSON, or a goal in YAML such as
/// "{goal: {type: number, least: -90, most: 90, unit: deg}, about: turns the head, examples: [20]}"; docs/protocol.md
/// [11.7] lists the keys. "*" as handler or component stands for every other name. A second description replaces the
/// first. ZTL_E_ARGUMENT says what is wrong in it, and where. Any thread; before the start. The texts are copied.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn ztl_server_describe(
    server: *mut Server,
    scope: *const c_char,
    handler: *const c_char,
    component: *const c_char,
    description: *const c_char,
) -> c_int {
    // SAFETY: NULL, or a server that is not freed and texts, as their caller promises.
    unsafe {
        Server::with(server, |server| {
            let scope = text(scope, "scope")?;
            let (handler, component) = (text(handler, "handler")?, text(component, "component")?);
            let is = describe::parse(text(description, "description")?);
            let invalid = |text: String| Failure::new(ZTL_E_ARGUMENT, text);
            for (name, what) in [(handler, "handler"), (component, "component")] {
                if name.contains(':') {
                    let text = format!("'{name}' is not the name of a {what}: it has a ':'");
                    return Err(invalid(text));
                }
            }
            let is = is.map_err(|why| invalid(format!("{handler}:{component}: {why}")))?;
            server.set_up(|setup| {
                if !setup.scopes.iter().any(|(known, _)| known == scope) {
                    let text = format!("the scope '{scope}' is not served; add it first");
                    return Err(invalid(text));
                }
                let handlers = setup.described.entry(scope.to_owned()).or_default();
                let components = handlers.entry(handler.to_owned()).or_default();
                components.insert(component.to_owned(), is);
                Ok(())
            })
        })
    }
}

/// Listens at an address such as "tcp://0.0.0.0:12345" (every interface), "tcp://127.0.0.1:12345" (this machine only) or
/// "tcp://127.0.0.1:*" (any free port), and serves on threads of the library, which have all signals blocked. Any
/// thread, once; a start that failed may be tried again. The text is copied.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn ztl_server_start(server: *mut Server, endpoint: *const c_char) -> c_int {
    // SAFETY: NULL, or a server that is not freed and a text, as their caller promises.
    unsafe {
        Server::with(server, |it| {
            it.start(Handle(server), text(endpoint, "endpoint")?, true)
        })
    }
}

/// As ztl_server_start, but the functions of ztl_server_add_handler are called only within ztl_server_poll: for a program
/// with a main loop that shares nothing between threads. Clients are answered all the time.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn ztl_server_start_polled(
    server: *mut Server,
    endpoint: *const c_char,
) -> c_int {
    // SAFETY: NULL, or a server that is not freed and a text, as their caller promises.
    unsafe {
        Server::with(server, |it| {
            it.start(Handle(server), text(endpoint, "endpoint")?, false)
        })
    }
}

/// Makes the calls that are due. Waits for the first one at most for this time in milliseconds; 0 means not at all. After
/// ztl_server_start there are no calls, and it only waits. Any thread, one at a time (else ZTL_E_BUSY). ZTL_E_SYSTEM if
/// the server can no longer serve.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn ztl_server_poll(server: *mut Server, wait_ms: c_uint) -> c_int {
    // SAFETY: NULL, or a server that is not freed, as its caller promises.
    unsafe { Server::with(server, |server| server.poll(millis(wait_ms))) }
}

/// Copies the address of a started server, with the chosen port, into a buffer, like ztl_server_error; an empty text
/// before the start. Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn ztl_server_endpoint(
    server: *const Server,
    buffer: *mut c_char,
    size: usize,
) -> usize {
    guard(0, || {
        // SAFETY: NULL, or a server that is not freed, as its caller promises.
        let endpoint = unsafe { server.as_ref() }.and_then(|server| {
            let running = lock(&server.running);
            let running = running.as_ref()?;
            Some(running.server.endpoint().to_owned())
        });
        // SAFETY: the buffer is the caller's, and has this size.
        unsafe { copy_out(&endpoint.unwrap_or_default(), buffer, size) }
    })
}
