/*
 * ZTL for programs in C: serve tasks, and have tasks done. https://pypi.org/project/ztl/
 * docs/c.md shows a first handler. This file is made from ztl-c/src; the tests compare the two.
 *
 * Rules for all of it:
 *
 * Errors. A function that can fail says ZTL_OK or one of ZTL_E_...; why, in words, say ztl_server_error and
 * ztl_client_error. A handle that is NULL is ZTL_E_NULL, and so is any other pointer that is NULL where that is not
 * allowed: nothing is done then, and nothing crashes.
 *
 * Texts are UTF-8 and end with a zero. What a program gives is copied before the call returns. What it is given is
 * the library's, and lasts for as long as is said there.
 *
 * Who owns what. What a ..._new gives is the program's until the ..._free of the same name. A task has no
 * handle, only a number, which is never given twice: there is nothing to free, and a call for a task that has
 * ended says ZTL_E_ENDED. Servers and clients know nothing of each other; they are freed in any order.
 *
 * Threads. What is not said otherwise may be called from any thread. Threads of the library have all
 * signals blocked. After fork(), a child must not use what its parent has made.
 *
 * Callbacks must return, and not by longjmp or a C++ exception. They may use the server that they are called
 * with, except ztl_server_free and ztl_server_poll.
 */
#ifndef ZTL_H
#define ZTL_H


#include <stddef.h>

#ifdef __cplusplus
extern "C" {
#endif

/**
 * The version of this interface. It changes when programs must be recompiled; new functions and new numbers do
 * not change it.
 */
#define ZTL_ABI 1

/**
 * No task has this id.
 */
#define ZTL_NO_TASK 0

/**
 * Client: the task's id does not fit in an unsigned int; some servers of the Python original assign such ids.
 * ztl_client_task_id returns it, and the functions named ..._by_id take it.
 */
#define ZTL_LONG_TASK 4294967295

/**
 * State: unknown. Only a client gets it, with an error.
 */
#define ZTL_UNKNOWN (-1)

/**
 * State: asked for, not decided yet.
 */
#define ZTL_INITIATED 0

/**
 * State: accepted and running.
 */
#define ZTL_ACCEPTED 1

/**
 * State: rejected; nothing was done. Final.
 */
#define ZTL_REJECTED 2

/**
 * State: ended without reaching its goal. Final.
 */
#define ZTL_FAILED 3

/**
 * State: stopped on request. Final.
 */
#define ZTL_ABORTED 4

/**
 * State: ended with its goal reached. Final.
 */
#define ZTL_COMPLETED 5

/**
 * Success.
 */
#define ZTL_OK 0

/**
 * An argument is NULL that must not be NULL.
 */
#define ZTL_E_NULL (-1)

/**
 * An argument is invalid: not UTF-8, not an address, or an unknown setting.
 */
#define ZTL_E_ARGUMENT (-2)

/**
 * The call is too early, too late, or from within a callback.
 */
#define ZTL_E_STATE (-3)

/**
 * Another thread is using the object.
 */
#define ZTL_E_BUSY (-4)

/**
 * The address is in use, or cannot be used.
 */
#define ZTL_E_ADDRESS (-5)

/**
 * The system has no more sockets, threads or memory.
 */
#define ZTL_E_SYSTEM (-6)

/**
 * A key or its file is invalid.
 */
#define ZTL_E_KEY (-8)

/**
 * Server: the task has ended, or is unknown to this server.
 */
#define ZTL_E_ENDED (-9)

/**
 * Server: the task was asked to stop.
 */
#define ZTL_E_ABORTED (-10)

/**
 * Client: no connection within the time limit. Nothing was sent: a task that was to be started does not run, and
 * nothing is known about one that runs.
 */
#define ZTL_E_NOT_CONNECTED (-11)

/**
 * Client: sent, but not answered within the time limit. Whether the server acted is unknown: the task may run.
 */
#define ZTL_E_NO_ANSWER (-12)

/**
 * Client: the server rejected the task; nothing was done.
 */
#define ZTL_E_REFUSED (-13)

/**
 * Client: the request never reached the server, which will reject it from now on: nothing runs.
 */
#define ZTL_E_NEVER_CAME (-14)

/**
 * Client: the server was restarted or has forgotten the task, or could not learn how the task ended. Whether and how
 * it ended is unknown.
 */
#define ZTL_E_UNKNOWN_TASK (-15)

/**
 * Client: the answer is not a ZTL message, its state is undefined, or it is about another task. What the task does is
 * unknown; it may run.
 */
#define ZTL_E_UNREADABLE (-16)

/**
 * Client: the task did not end within the limit of the wait. It continues.
 */
#define ZTL_E_NOT_ENDED (-17)

/**
 * A mistake in this library, which printed a line to stderr.
 */
#define ZTL_E_PANIC (-18)

/**
 * Client: the request is longer than the server accepts. Nothing was sent.
 */
#define ZTL_E_TOO_LONG (-19)

/**
 * Client: the server answered without telling the task's state: the scope is not served (yet), or the handler failed.
 * The task may run.
 */
#define ZTL_E_NOT_TOLD (-20)

/**
 * Longest message of a client, in bytes. Default and most: 1048576.
 */
#define ZTL_MAX_MESSAGE 1

/**
 * Tasks that have not ended. Default 10000.
 */
#define ZTL_MAX_RUNNING 2

/**
 * Tasks in the task table, running or ended. Default 10000.
 */
#define ZTL_MAX_REMEMBERED 3

/**
 * How long a task is kept after its end, in milliseconds. Default 3600000 (an hour).
 */
#define ZTL_KEEP_MS 4

/**
 * Requests whose answer is held. Default 10000.
 */
#define ZTL_MAX_HELD 5

/**
 * Clients whose last started task is remembered. Default 10000.
 */
#define ZTL_MAX_CLIENTS 6

/**
 * Messages per connection that wait. Default 256.
 */
#define ZTL_MAX_QUEUE 7

/**
 * Connections at a time. Default 4096, or what the limit on open files leaves.
 */
#define ZTL_MAX_CONNECTIONS 8

/**
 * Longest time for the handshake of a connection, in milliseconds. Default 5000.
 */
#define ZTL_HANDSHAKE_MS 9

/**
 * How often a running task's `poll` is called, in milliseconds. Default 10.
 */
#define ZTL_POLL_MS 10

/**
 * An error.
 */
#define ZTL_LOG_ERROR 1

/**
 * A warning.
 */
#define ZTL_LOG_WARNING 2

/**
 * An event.
 */
#define ZTL_LOG_INFO 3

/**
 * Details.
 */
#define ZTL_LOG_DEBUG 4

/**
 * A client of one scope of one server, from ztl_client_new to ztl_client_free. For one thread at a time: a call during
 * another one is ZTL_E_BUSY. Threads that use a server at the same time need a client each (ztl_client_clone).
 */
typedef struct ztl_client ztl_client;

/**
 * A task server, from ztl_server_new to ztl_server_free. Its functions may be called from any thread.
 */
typedef struct ztl_server ztl_server;

/**
 * A client's request. It and its texts belong to the library and are valid during the call.
 */
typedef struct {
    /**
     * The task's id.
     */
    unsigned int task;
    /**
     * Who is to do it, such as "robot".
     */
    const char *handler;
    /**
     * The part to use, such as "head".
     */
    const char *component;
    /**
     * What to achieve, such as "left".
     */
    const char *goal;
} ztl_request;

/**
 * Carries out a whole task on a thread of its own. Reports about the task with ztl_task_...(server, request->task,
 * ...), ends it with ztl_task_end, and returns. It should call ztl_task_is_aborted often, or sleep with
 * ztl_task_sleep. If it returns without ending the task, the task ends as FAILED.
 */
typedef void (*ztl_work_call)(void *context, ztl_server *server, const ztl_request *request);

/**
 * Starts a task and returns at once. The task is accepted, unless it was ended with ztl_task_end.
 */
typedef void (*ztl_start_call)(void *context, ztl_server *server, const ztl_request *request);

/**
 * Advances a running task and returns at once. Called regularly until the task has ended.
 */
typedef void (*ztl_poll_call)(void *context, ztl_server *server, unsigned int task);

/**
 * Stops a task, or begins to stop it, and returns at once. Called at most once per task, after its `start`; a task that
 * is aborted before that ends as ABORTED, and neither function is called. When the task has stopped, call
 * ztl_task_end, here or later.
 */
typedef void (*ztl_abort_call)(void *context, ztl_server *server, unsigned int task);

/**
 * Called with each answer during a wait, on the waiting thread: ZTL_OK with the task's state and text, or an error with
 * ZTL_UNKNOWN and a message. The text belongs to the library and is valid during the call. Returns 0 to keep waiting;
 * any other value ends the wait with ZTL_E_NOT_ENDED. It must not use the client.
 */
typedef int (*ztl_seen_call)(void *context, int error, int state, const char *text);

/**
 * Receives a log line without a line feed. Called from any thread of the library, also from several at the same time,
 * and within calls to the library; it must not call the library. The text belongs to the library and is valid
 * during the call.
 */
typedef void (*ztl_log_call)(void *context, int level, const char *line);

/**
 * The library's version, such as "0.1.0". Any thread. The text belongs to the library and stays valid.
 */
const char *ztl_version(void);

/**
 * The version of the interface in the loaded library, to be compared with ZTL_ABI. Any thread.
 */
unsigned int ztl_abi(void);

/**
 * The name of a state, such as "COMPLETED"; "UNKNOWN" for any other number. Any thread. The text belongs to the
 * library and stays valid.
 */
const char *ztl_state_name(int state);

/**
 * The name of an error, such as "ZTL_E_NULL"; "ZTL_E_?" for any other number. Any thread. The text belongs to the
 * library and stays valid.
 */
const char *ztl_error_name(int error);

/**
 * Creates a server that is not started; NULL if the memory is not enough. Any thread. The caller frees it with
 * ztl_server_free.
 */
ztl_server *ztl_server_new(void);

/**
 * Stops and frees a server. Running tasks are asked to stop (their `abort` is called, within this call if
 * ztl_server_poll makes the calls); those that have not ended after 1.4 s end as FAILED. Requests are answered for
 * up to 2 s longer, until a client has asked for the end of each task. Then waits until every callback has
 * returned, however long that takes. Any thread; within a callback it is ZTL_E_STATE, and nothing is freed. Apart
 * from its callbacks, nothing may use the server during or after this call. NULL is ZTL_OK.
 */
int ztl_server_free(ztl_server *server);

/**
 * Copies the message of the last call that failed with this server into a buffer of this size, truncated to fit and
 * ended by a zero; returns the length of the whole message. Any thread. The buffer belongs to the caller; if it is
 * NULL or its size is 0, only the length is returned. For a server that is NULL: 0 and an empty text.
 */
size_t ztl_server_error(const ztl_server *server,
                        char *buffer,
                        size_t size);

/**
 * Sets one of the limits above, such as ZTL_MAX_RUNNING. Any thread; before the start.
 */
int ztl_server_set(ztl_server *server, int setting, unsigned int value);

/**
 * Admits clients with an address in this network, such as "192.168.1.0/24". Once a network is given, all others are
 * excluded. Any thread; before the start. The text is copied.
 */
int ztl_server_allow_network(ztl_server *server,
                             const char *network);

/**
 * Encrypts with the keys in a file such as "robot.key_secret" (made by `ztl keys robot`). Then only clients with an
 * allowed key may use anything. Any thread; before the start. The text is copied.
 */
int ztl_server_use_keys(ztl_server *server,
                        const char *secret_file);

/**
 * Allows the client whose public key is in a file such as "ann.key", or every client in a directory of such files.
 * `scope` is the scope that it may use; NULL means all. Any thread; before the start. The texts are copied.
 */
int ztl_server_allow_key(ztl_server *server,
                         const char *scope,
                         const char *public_file);

/**
 * Serves a scope such as "/robot" with a function that carries out a whole task. Each task has a thread of its own with
 * all signals blocked. `context` is passed to the function, belongs to the program, and may be NULL; `work` must not
 * be NULL. Any thread; before the start. The text is copied.
 */
int ztl_server_add_worker(ztl_server *server,
                          const char *scope,
                          ztl_work_call work,
                          void *context);

/**
 * Serves a scope with short calls, one at a time for the whole server: on a thread of the library after
 * ztl_server_start, or in ztl_server_poll after ztl_server_start_polled. `poll` and `abort` may be NULL; then the
 * program advances its tasks by itself and checks ztl_task_is_aborted. `context` is passed to the functions, belongs to
 * the program, and may be NULL; `start` must not be NULL. Any thread; before the start. The text is copied.
 */
int ztl_server_add_handler(ztl_server *server,
                           const char *scope,
                           ztl_start_call start,
                           ztl_poll_call poll,
                           ztl_abort_call abort,
                           void *context);

/**
 * Says what goals a component of a served scope takes, and what it does, for `ztl describe`, `ztl check` and others. The
 * library does not check goals by it. `description` is JSON, or a goal in YAML such as
 * "{goal: {type: number, least: -90, most: 90, unit: deg}, about: turns the head, examples: [20]}"; docs/protocol.md
 * [11.7] lists the keys. "*" as handler or component stands for every other name. A second description replaces the
 * first. ZTL_E_ARGUMENT says what is wrong in it, and where. Any thread; before the start. The texts are copied.
 */
int ztl_server_describe(ztl_server *server,
                        const char *scope,
                        const char *handler,
                        const char *component,
                        const char *description);

/**
 * Listens at an address such as "tcp://0.0.0.0:12345" (every interface), "tcp://127.0.0.1:12345" (this machine only) or
 * "tcp://127.0.0.1:*" (any free port), and serves on threads of the library, which have all signals blocked. Any
 * thread, once; a start that failed may be tried again. The text is copied.
 */
int ztl_server_start(ztl_server *server,
                     const char *endpoint);

/**
 * As ztl_server_start, but the functions of ztl_server_add_handler are called only within ztl_server_poll: for a program
 * with a main loop that shares nothing between threads. Clients are answered all the time.
 */
int ztl_server_start_polled(ztl_server *server,
                            const char *endpoint);

/**
 * Makes the calls that are due. Waits for the first one at most for this time in milliseconds; 0 means not at all. After
 * ztl_server_start there are no calls, and it only waits. Any thread, one at a time (else ZTL_E_BUSY). ZTL_E_SYSTEM if
 * the server can no longer serve.
 */
int ztl_server_poll(ztl_server *server,
                    unsigned int wait_ms);

/**
 * Copies the address of a started server, with the chosen port, into a buffer, like ztl_server_error; an empty text
 * before the start. Any thread.
 */
size_t ztl_server_endpoint(const ztl_server *server,
                           char *buffer,
                           size_t size);

/**
 * Accepts the task and informs its client. Not needed after ztl_task_progress or ztl_task_end, which accept it too,
 * nor in a `start`. The client of a task that is undecided after 1.5 s gets its id anyway. Like all ztl_task_...
 * functions: any thread, from the start of a task to its end (then ZTL_E_ENDED).
 */
int ztl_task_accept(ztl_server *server,
                    unsigned int task);

/**
 * Sets the progress that clients see. The text is copied and must not be NULL.
 */
int ztl_task_progress(ztl_server *server, unsigned int task, const char *progress);

/**
 * Ends the task: as ZTL_COMPLETED with the result, ZTL_FAILED or ZTL_REJECTED with the reason, or ZTL_ABORTED with
 * where it stopped. ZTL_REJECTED means that nothing was done; a task that was accepted becomes FAILED instead. The
 * first end counts; a later one is ZTL_E_ENDED and changes nothing. The text is copied and must not be NULL.
 */
int ztl_task_end(ztl_server *server,
                 unsigned int task,
                 int state,
                 const char *result);

/**
 * 1 if the task should stop because of an abort, has ended, or the server is NULL; else 0.
 */
int ztl_task_is_aborted(ztl_server *server, unsigned int task);

/**
 * Sleeps; returns ZTL_E_ABORTED as soon as the task is asked to stop.
 */
int ztl_task_sleep(ztl_server *server, unsigned int task, unsigned int time_ms);

/**
 * Informs the client that asked to stop the task that the task cannot be stopped and continues.
 */
int ztl_task_reject_abort(ztl_server *server, unsigned int task);

/**
 * Stops the task when its client is silent for this time (5000 ms or more) after it was told that the task has started.
 * A clone of a client is another client. Has no effect for clients that do not identify themselves, such as the Python
 * original's.
 */
int ztl_task_needs_client(ztl_server *server,
                          unsigned int task,
                          unsigned int silence_ms);

/**
 * Creates a client that is not connected; NULL if the memory is not enough. Any thread. The caller frees it with
 * ztl_client_free.
 */
ztl_client *ztl_client_new(void);

/**
 * Creates another client of the same server and scope, with the same keys and timeout. NULL if this one is NULL or in
 * use, or there is no memory. The caller frees it; it may outlive this one.
 */
ztl_client *ztl_client_clone(const ztl_client *client);

/**
 * Frees a client and the texts that it returned; its tasks continue. Any thread. Does nothing for NULL.
 */
void ztl_client_free(ztl_client *client);

/**
 * The answer to the last call: progress, result, or the server's reason; "" at first. It belongs to the client and is
 * valid until the next call with it other than this one and ztl_client_error. Never NULL: for a client that is NULL or
 * used by another thread, it is a text that says so and stays valid.
 */
const char *ztl_client_text(const ztl_client *client);

/**
 * The message of the last call that failed; "" at first. It belongs to the client and is valid until the next call with
 * it other than this one and ztl_client_text. Never NULL, like ztl_client_text.
 */
const char *ztl_client_error(const ztl_client *client);

/**
 * The id of the task last started with ztl_client_trigger or ztl_client_run, in decimal digits of any number; "" if the
 * server assigned none. It belongs to the client and is valid until the next call of one of these two. Never NULL, like
 * ztl_client_text.
 */
const char *ztl_client_task_id(const ztl_client *client);

/**
 * Sets the time limit for each answer in milliseconds; default 2000. The time limit of a task is the limit of
 * ztl_client_wait. Call it before ztl_client_connect.
 */
int ztl_client_set_timeout(ztl_client *client,
                           unsigned int timeout_ms);

/**
 * Encrypts with the client's own keys in a file such as "ann.key_secret" (made by `ztl keys ann`); accepts only the
 * server with the public key in the other file, such as "robot.key". Call it before ztl_client_connect. The texts are
 * copied.
 */
int ztl_client_use_keys(ztl_client *client,
                        const char *own_secret_file,
                        const char *server_public_file);

/**
 * Connects to a server such as "tcp://robot:12345" and a scope such as "/robot", without ';'. Call it once, before any
 * request. The server need not be there yet. The texts are copied.
 */
int ztl_client_connect(ztl_client *client,
                       const char *endpoint,
                       const char *scope);

/**
 * Starts a task such as "robot", "head", "left", and writes its id: ZTL_NO_TASK with any error. After ZTL_E_NO_ANSWER,
 * ZTL_E_UNREADABLE and ZTL_E_SYSTEM the task may run; after any other error it does not. A request is never sent twice.
 * An id that does not fit is ZTL_LONG_TASK; see ztl_client_task_id. The texts are copied and must not be NULL; `task`
 * may be NULL.
 */
int ztl_client_trigger(ztl_client *client,
                       const char *handler,
                       const char *component,
                       const char *goal,
                       unsigned int *task);

/**
 * Asks for a task's state; ztl_client_text returns its text. With any error the state is ZTL_UNKNOWN: a missing answer
 * never counts as an end, and a task that the server does not know is ZTL_E_UNKNOWN_TASK. `state` may be NULL.
 */
int ztl_client_status(ztl_client *client,
                      unsigned int task,
                      int *state);

/**
 * As ztl_client_status, with the task's id in decimal digits. The text is copied and must not be NULL.
 */
int ztl_client_status_by_id(ztl_client *client,
                            const char *id,
                            int *state);

/**
 * Asks to stop a task, and writes its state: ZTL_ABORTED, a final state that it had already reached, or ZTL_ACCEPTED
 * while it is not stopped yet or cannot be stopped. Otherwise as ztl_client_status.
 */
int ztl_client_abort(ztl_client *client,
                     unsigned int task,
                     int *state);

/**
 * As ztl_client_abort, with the task's id in decimal digits. The text is copied and must not be NULL.
 */
int ztl_client_abort_by_id(ztl_client *client,
                           const char *id,
                           int *state);

/**
 * Waits for a task's end, at most for this time in milliseconds; a negative limit means forever. ZTL_OK: it has ended
 * in the final state `state`. ZTL_E_NOT_ENDED: it continues in this state. With any other error the state is
 * ZTL_UNKNOWN. ZTL_E_UNKNOWN_TASK: the server does not know it. ZTL_E_UNREADABLE, ZTL_E_NOT_TOLD: the server answered
 * without telling its state. Any other error: the server did not answer at the end of the limit. A server that does
 * not answer does not end the wait earlier. `state` may be NULL; ztl_client_text returns the text.
 */
int ztl_client_wait(ztl_client *client,
                    unsigned int task,
                    int limit_ms,
                    int *state);

/**
 * As ztl_client_wait; calls `seen`, which must not be NULL, with each answer. `context` is passed to it, belongs to the
 * program, and may be NULL.
 */
int ztl_client_wait_seeing(ztl_client *client,
                           unsigned int task,
                           int limit_ms,
                           ztl_seen_call seen,
                           void *context,
                           int *state);

/**
 * As ztl_client_wait_seeing, with the task's id in decimal digits; as ztl_client_wait if `seen` is NULL. The text is
 * copied and must not be NULL.
 */
int ztl_client_wait_by_id(ztl_client *client,
                          const char *id,
                          int limit_ms,
                          ztl_seen_call seen,
                          void *context,
                          int *state);

/**
 * Starts a task and waits for its end: ztl_client_trigger, then ztl_client_wait, with the errors of both. The id is
 * written to `task` as soon as it is known, so that the task can be stopped; `task` and `state` may be NULL.
 */
int ztl_client_run(ztl_client *client,
                   const char *handler,
                   const char *component,
                   const char *goal,
                   int limit_ms,
                   unsigned int *task,
                   int *state);

/**
 * Asks the server about itself, for example "tasks" or "devices". ztl_client_text returns the answer in JSON, or "" if
 * the server does not know the question (the Python original knows none). The text is copied.
 */
int ztl_client_ask(ztl_client *client,
                   const char *question);

/**
 * Passes the library's log, up to a level, to a function of the program; by default nothing is logged. Call it once per
 * process (else ZTL_E_STATE), best before anything else; it cannot be undone. `log` must not be NULL. `context` is passed
 * to it, belongs to the program, and may be NULL. Any thread.
 */
int ztl_log_to(int level,
               ztl_log_call log,
               void *context);

#ifdef __cplusplus
}
#endif

#endif
