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
 * The interface that this header describes. It changes when a program would have to be compiled anew;
 * new functions and new numbers do not change it.
 */
#define ZTL_ABI 1

/**
 * No task has this id.
 */
#define ZTL_NO_TASK 0

/**
 * Client: the task's id does not fit in an unsigned int, as some servers of the Python original give them.
 * ztl_client_task_id tells it, and the functions named ..._by_id take it.
 */
#define ZTL_LONG_TASK 4294967295

/**
 * Where a task is: it is not known. Only a client is told so, with an error.
 */
#define ZTL_UNKNOWN (-1)

/**
 * Where a task is: asked for, and not decided upon.
 */
#define ZTL_INITIATED 0

/**
 * Where a task is: taken, and under way.
 */
#define ZTL_ACCEPTED 1

/**
 * Where a task is: refused, and nothing was done. Final.
 */
#define ZTL_REJECTED 2

/**
 * Where a task is: ended without reaching its goal. Final.
 */
#define ZTL_FAILED 3

/**
 * Where a task is: stopped because somebody asked for it. Final.
 */
#define ZTL_ABORTED 4

/**
 * Where a task is: its goal is reached. Final.
 */
#define ZTL_COMPLETED 5

/**
 * It is done.
 */
#define ZTL_OK 0

/**
 * An argument is NULL that must not be.
 */
#define ZTL_E_NULL (-1)

/**
 * An argument is wrong: no UTF-8, no address, no such setting.
 */
#define ZTL_E_ARGUMENT (-2)

/**
 * The call does not fit here: too early, too late, or from within a callback.
 */
#define ZTL_E_STATE (-3)

/**
 * Another thread is using this just now.
 */
#define ZTL_E_BUSY (-4)

/**
 * Nothing can listen at this address, or something else does.
 */
#define ZTL_E_ADDRESS (-5)

/**
 * The system gives no socket, thread or memory.
 */
#define ZTL_E_SYSTEM (-6)

/**
 * Keys were given, and this library cannot encrypt.
 */
#define ZTL_E_NO_CURVE (-7)

/**
 * A key or its file is wrong.
 */
#define ZTL_E_KEY (-8)

/**
 * Server: the task has ended, or this server never had it.
 */
#define ZTL_E_ENDED (-9)

/**
 * Server: somebody asked to stop the task.
 */
#define ZTL_E_ABORTED (-10)

/**
 * Client: no connection within the time. Nothing was sent: a task that was asked for does not run, and
 * nothing is known of one that does.
 */
#define ZTL_E_NOT_CONNECTED (-11)

/**
 * Client: sent, and not answered within the time. Whether it was acted on is unknown: the task may run.
 */
#define ZTL_E_NO_ANSWER (-12)

/**
 * Client: the server refused the task, and nothing was done.
 */
#define ZTL_E_REFUSED (-13)

/**
 * Client: the request never came to the server, which will refuse it from now on: nothing runs.
 */
#define ZTL_E_NEVER_CAME (-14)

/**
 * Client: the server does not know the task: it was started anew, or has forgotten it; or it could not
 * learn how the task ended. Whether and how the task ended is unknown.
 */
#define ZTL_E_UNKNOWN_TASK (-15)

/**
 * Client: the answer is not a message of ZTL, its state is not one of ZTL's, or it is about another task.
 * What the task does is unknown: one that was asked for may run.
 */
#define ZTL_E_UNREADABLE (-16)

/**
 * Client: the task had not ended when the limit of the wait had passed. It goes on.
 */
#define ZTL_E_NOT_ENDED (-17)

/**
 * A mistake in this library; it has written a line about it to stderr.
 */
#define ZTL_E_PANIC (-18)

/**
 * Client: the request is longer than the server takes. Nothing was sent.
 */
#define ZTL_E_TOO_LONG (-19)

/**
 * Client: the server answered, but did not say where the task is: its scope is not there (yet), or the
 * handler could not be asked. The task may run.
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
 * Tasks that are remembered, whether they run or have ended. Default 10000.
 */
#define ZTL_MAX_REMEMBERED 3

/**
 * How long a task is remembered after its end, in milliseconds. Default 3600000, an hour.
 */
#define ZTL_KEEP_MS 4

/**
 * Requests whose answer is held. Default 10000.
 */
#define ZTL_MAX_HELD 5

/**
 * Clients whose last request for a task is remembered. Default 10000.
 */
#define ZTL_MAX_CLIENTS 6

/**
 * Messages of one connection that wait. Default 256.
 */
#define ZTL_MAX_QUEUE 7

/**
 * Connections at a time. Default 4096, or what the system's limit on open files leaves.
 */
#define ZTL_MAX_CONNECTIONS 8

/**
 * How long a connection may take to shake hands, in milliseconds. Default 5000.
 */
#define ZTL_HANDSHAKE_MS 9

/**
 * How often a running task's `poll` is called, in milliseconds. Default 10.
 */
#define ZTL_POLL_MS 10

/**
 * Something is wrong.
 */
#define ZTL_LOG_ERROR 1

/**
 * Something may be wrong.
 */
#define ZTL_LOG_WARNING 2

/**
 * Something has happened.
 */
#define ZTL_LOG_INFO 3

/**
 * Details.
 */
#define ZTL_LOG_DEBUG 4

/**
 * A client of one scope of one server. From ztl_client_new to ztl_client_free, and for one thread at a
 * time: a call while another is under way is ZTL_E_BUSY. Threads that talk at the same time have a
 * client each (ztl_client_clone).
 */
typedef struct ztl_client ztl_client;

/**
 * A task server. From ztl_server_new to ztl_server_free; its functions may be called from any thread.
 */
typedef struct ztl_server ztl_server;

/**
 * What a client asks for. It and its texts are the library's, and last for the call that is given them.
 */
typedef struct {
    /**
     * The task's id, by which all else is told of it.
     */
    unsigned int task;
    /**
     * Who is to do it, as "robot".
     */
    const char *handler;
    /**
     * With which part, as "head".
     */
    const char *component;
    /**
     * To what end, as "left".
     */
    const char *goal;
} ztl_request;

/**
 * Carries out a whole task, from its beginning to its end, on a thread of its own. It tells what becomes of
 * the task by ztl_task_...(server, request->task, ...), ends it by ztl_task_end, and returns. It should
 * look at ztl_task_is_aborted often, or wait by ztl_task_sleep. A task that it has not ended when it
 * returns ends as FAILED.
 */
typedef void (*ztl_work_call)(void *context, ztl_server *server, const ztl_request *request);

/**
 * Begins a task, and returns at once. A task that it has not ended by ztl_task_end is accepted.
 */
typedef void (*ztl_start_call)(void *context, ztl_server *server, const ztl_request *request);

/**
 * Moves a task on that runs, and returns at once; called again and again until the task has ended.
 */
typedef void (*ztl_poll_call)(void *context, ztl_server *server, unsigned int task);

/**
 * Somebody wants a task to stop: stops it, or begins to, and returns at once. Called at most once
 * for a task, after its `start`; a task that is to stop before that is ABORTED, and neither is called.
 * When it has stopped, ztl_task_end says so, here or later.
 */
typedef void (*ztl_abort_call)(void *context, ztl_server *server, unsigned int task);

/**
 * Is shown each answer of a wait, on the thread that waits: ZTL_OK with the task's state and text, or an
 * error, ZTL_UNKNOWN, and what went wrong. The text is the library's, and lasts for the call. 0 goes on
 * waiting; anything else ends the wait, which then says ZTL_E_NOT_ENDED. It must not use the client.
 */
typedef int (*ztl_seen_call)(void *context, int error, int state, const char *text);

/**
 * Takes a line of the log, without a line feed. Called from any thread of the library, also from several at
 * the same time, and from within calls to it; it must not call the library. The text is the
 * library's, and lasts for the call.
 */
typedef void (*ztl_log_call)(void *context, int level, const char *line);

/**
 * The library's version, as "0.1.0". Any thread. The text is the library's, and stays.
 */
const char *ztl_version(void);

/**
 * The interface of the library that the program runs with, to be compared with ZTL_ABI. Any thread.
 */
unsigned int ztl_abi(void);

/**
 * 1 when this library can encrypt, so that keys can be used, else 0. Any thread.
 */
int ztl_can_encrypt(void);

/**
 * The name of a state, as "COMPLETED"; "UNKNOWN" for any other number. Any thread. The text is the
 * library's, and stays.
 */
const char *ztl_state_name(int state);

/**
 * The name of an error, as "ZTL_E_NULL"; "ZTL_E_?" for a number that is none. Any thread. The text is
 * the library's, and stays.
 */
const char *ztl_error_name(int error);

/**
 * Makes a server, which does nothing yet; NULL when there is no memory. Any thread. It is the
 * caller's, to be given to ztl_server_free.
 */
ztl_server *ztl_server_new(void);

/**
 * Stops a server and frees it. Tasks that run are asked to stop (their `abort` is called, from within
 * this call where calls are made by ztl_server_poll); what has not ended after 1.4 s ends as FAILED.
 * Then it waits until every callback has returned, however long that takes. Any thread, but not
 * from within a callback, which is ZTL_E_STATE, and nothing is freed. No other call with this
 * server may be under way, except those of its callbacks, nor come later. NULL is ZTL_OK.
 */
int ztl_server_free(ztl_server *server);

/**
 * Copies what the last call that failed with this server said into a buffer of so many bytes, cut
 * to fit and ended by a zero, and says how long all of it is. Any thread. The buffer is the
 * caller's; NULL, or a size of 0, only asks for the length. For a server that is NULL: 0, and an
 * empty text.
 */
size_t ztl_server_error(const ztl_server *server, char *buffer, size_t size);

/**
 * Sets one of the numbers above, as ZTL_MAX_RUNNING. Any thread; before the start.
 */
int ztl_server_set(ztl_server *server, int setting, unsigned int value);

/**
 * Lets only clients connect whose address is in this network, as "192.168.1.0/24", or in another
 * one that is given so. Any thread; before the start. The text is copied.
 */
int ztl_server_allow_network(ztl_server *server, const char *network);

/**
 * Encrypts with the keys of this file, as "robot.key_secret" (`ztl keys robot` makes it). From then on only
 * clients whose keys are allowed may use anything. Any thread; before the start. The text is
 * copied.
 */
int ztl_server_use_keys(ztl_server *server,
                        const char *secret_file);

/**
 * Allows the client whose public key is in this file, as "ann.key", or every client of a directory of
 * such files. `scope` is what it may use; NULL is all. Any thread; before the start. The texts are copied.
 */
int ztl_server_allow_key(ztl_server *server,
                         const char *scope,
                         const char *public_file);

/**
 * Serves a scope, as "/robot", by a function that carries out a whole task: each task has a thread of
 * its own, with all signals blocked. `context` is handed to it, stays the program's, and may be NULL;
 * `work` may not. Any thread; before the start. The text is copied.
 */
int ztl_server_add_worker(ztl_server *server,
                          const char *scope,
                          ztl_work_call work,
                          void *context);

/**
 * Serves a scope by short calls, one at a time for the whole server: on a thread of the library after
 * ztl_server_start, or in ztl_server_poll after ztl_server_start_polled. `poll` and `abort` may be NULL: then
 * the program moves its tasks on by itself, and looks at ztl_task_is_aborted. `context` is handed to
 * them, stays the program's, and may be NULL; `start` may not. Any thread; before the start. The text is
 * copied.
 */
int ztl_server_add_handler(ztl_server *server,
                           const char *scope,
                           ztl_start_call start,
                           ztl_poll_call poll,
                           ztl_abort_call abort,
                           void *context);

/**
 * Listens at an address, as "tcp://0.0.0.0:12345" (every interface), "tcp://127.0.0.1:12345" (this machine only) or
 * "tcp://127.0.0.1:*" (any free port), and serves from now on, on threads of the library, which have
 * all signals blocked. Any thread, once: a start that failed may be tried again. The text is copied.
 */
int ztl_server_start(ztl_server *server,
                     const char *endpoint);

/**
 * The same, but the calls of ztl_server_add_handler are made only within ztl_server_poll: for a program that
 * has a main loop and shares nothing between threads. Clients are answered all the while.
 */
int ztl_server_start_polled(ztl_server *server,
                            const char *endpoint);

/**
 * Makes the calls that are due and returns; waits for the first of them for so many milliseconds at most,
 * 0 not at all. After ztl_server_start there are none, and it only waits. Any thread, one at a time
 * (ZTL_E_BUSY). ZTL_E_SYSTEM when the server can no longer serve.
 */
int ztl_server_poll(ztl_server *server,
                    unsigned int wait_ms);

/**
 * Copies where a started server listens, with the port that was chosen, into a buffer, as
 * ztl_server_error does; an empty text before the start. Any thread.
 */
size_t ztl_server_endpoint(const ztl_server *server, char *buffer, size_t size);

/**
 * The task is taken, and its client is told so. Not needed after ztl_task_progress or ztl_task_end, which
 * say it too, nor in a `start`. A task that nobody has decided upon after 1.5 s is answered with its id
 * all the same. Any thread, from a task's beginning to its end (ZTL_E_ENDED); so are all ztl_task_....
 */
int ztl_task_accept(ztl_server *server,
                    unsigned int task);

/**
 * Where the task is now, for its clients; the latest is what they see. The text is copied, and must not be
 * NULL.
 */
int ztl_task_progress(ztl_server *server,
                      unsigned int task,
                      const char *progress);

/**
 * Ends the task: as ZTL_COMPLETED with its result, ZTL_FAILED or ZTL_REJECTED with the reason, or
 * ZTL_ABORTED with where it stopped. ZTL_REJECTED says that nothing was done: of a task that was
 * accepted already it becomes FAILED. The first end counts; a later one is ZTL_E_ENDED and changes
 * nothing. The text is copied, and must not be NULL.
 */
int ztl_task_end(ztl_server *server, unsigned int task, int state, const char *result);

/**
 * 1 when the task should stop, since somebody asked for it or it has ended (or the server is NULL), else 0.
 */
int ztl_task_is_aborted(ztl_server *server,
                        unsigned int task);

/**
 * Waits for so many milliseconds; ZTL_E_ABORTED as soon as somebody asks to stop the task.
 */
int ztl_task_sleep(ztl_server *server, unsigned int task, unsigned int time_ms);

/**
 * The task cannot be stopped and goes on, as the client that asked for it is told.
 */
int ztl_task_refuse_abort(ztl_server *server, unsigned int task);

/**
 * The task is to be stopped when nothing has come from its client for so many milliseconds (5000 or more),
 * though it had asked for something after the task began. Never happens to a client that does not say who
 * it is, as the Python original's.
 */
int ztl_task_needs_client(ztl_server *server,
                          unsigned int task,
                          unsigned int silence_ms);

/**
 * Makes a client, which is not connected; NULL when there is no memory. Any thread. It is the caller's,
 * to be given to ztl_client_free.
 */
ztl_client *ztl_client_new(void);

/**
 * Makes another client of the same server and scope, with the same keys and time. NULL when this one
 * is NULL or in use, or there is no memory. It is the caller's, and lasts longer than this one if need be.
 */
ztl_client *ztl_client_clone(const ztl_client *client);

/**
 * Frees a client and the texts that it gave; its tasks go on. Any thread. NULL is allowed, and nothing
 * is done.
 */
void ztl_client_free(ztl_client *client);

/**
 * What the last call was answered: progress, result, or a server's reason; at first "". It is the
 * client's, and lasts until the next call with it other than this and ztl_client_error. Never NULL: for a
 * client that is NULL, or that another thread is using, it is a text that says so, and stays.
 */
const char *ztl_client_text(const ztl_client *client);

/**
 * What the last call that failed said; at first "". It is the client's, and lasts until the next call with
 * it other than this and ztl_client_text. Never NULL, as ztl_client_text.
 */
const char *ztl_client_error(const ztl_client *client);

/**
 * The id of the task that was asked for last with ztl_client_trigger or ztl_client_run, in decimal digits,
 * however long it is; "" when the server gave none. It is the client's, and lasts until the next call of one
 * of these two. Never NULL, as ztl_client_text.
 */
const char *ztl_client_task_id(const ztl_client *client);

/**
 * Sets the longest time for the server to answer, in milliseconds; default 2000. It is not a task's time:
 * that is the limit of ztl_client_wait. Before ztl_client_connect.
 */
int ztl_client_set_timeout(ztl_client *client,
                           unsigned int timeout_ms);

/**
 * Encrypts with one's own keys, as "ann.key_secret" (`ztl keys ann` makes it), towards the server with the
 * public key in the other file, as "robot.key", and no other. Before ztl_client_connect. The texts are
 * copied.
 */
int ztl_client_use_keys(ztl_client *client,
                        const char *own_secret_file,
                        const char *server_public_file);

/**
 * Says which server, as "tcp://robot:12345", and which scope, as "/robot", without ';'; before anything is asked.
 * The server need not be there yet. Once for a client. The texts are copied.
 */
int ztl_client_connect(ztl_client *client,
                       const char *endpoint,
                       const char *scope);

/**
 * Asks for a task, as "robot", "head", "left", and gives its id: ZTL_NO_TASK with any error. After
 * ZTL_E_NO_ANSWER, ZTL_E_UNREADABLE and ZTL_E_SYSTEM the task may run; after any other error it does not. A
 * request is never sent twice. An id that does not fit is ZTL_LONG_TASK: ztl_client_task_id tells it. The texts
 * are copied; `task` may be NULL, they may not.
 */
int ztl_client_trigger(ztl_client *client,
                       const char *handler,
                       const char *component,
                       const char *goal,
                       unsigned int *task);

/**
 * Asks where a task is. With any error the state is ZTL_UNKNOWN: no answer is never taken for an end, and a
 * task that the server does not know is ZTL_E_UNKNOWN_TASK. `state` may be NULL; the text is
 * ztl_client_text's.
 */
int ztl_client_status(ztl_client *client,
                      unsigned int task,
                      int *state);

/**
 * The same, by the task's id in decimal digits. The text is copied, and must not be NULL.
 */
int ztl_client_status_by_id(ztl_client *client, const char *id, int *state);

/**
 * Asks to stop a task, and where it is then: ZTL_ABORTED, an end that it had reached before, or ZTL_ACCEPTED
 * while it is not stopped yet, or cannot be. Else as ztl_client_status.
 */
int ztl_client_abort(ztl_client *client,
                     unsigned int task,
                     int *state);

/**
 * The same, by the task's id in decimal digits. The text is copied, and must not be NULL.
 */
int ztl_client_abort_by_id(ztl_client *client, const char *id, int *state);

/**
 * Waits for a task to end, at most for so many milliseconds; less than 0 is for ever. ZTL_OK: it has ended,
 * and `state` says how. ZTL_E_NOT_ENDED: it goes on, and `state` says where it is. ZTL_E_UNKNOWN_TASK: the
 * server does not know it. ZTL_E_UNREADABLE, ZTL_E_NOT_TOLD: it answered, but not where the task is. Any other
 * error: the server did not answer when the time was over. With all of these the state is ZTL_UNKNOWN. A server
 * that does not answer does not end the wait before. `state` may be NULL; the
 * text is ztl_client_text's.
 */
int ztl_client_wait(ztl_client *client,
                    unsigned int task,
                    int limit_ms,
                    int *state);

/**
 * The same; each answer on the way is shown to `seen`, which must not be NULL. `context` is handed to
 * it, stays the program's, and may be NULL.
 */
int ztl_client_wait_seeing(ztl_client *client,
                           unsigned int task,
                           int limit_ms,
                           ztl_seen_call seen,
                           void *context,
                           int *state);

/**
 * Waits as ztl_client_wait_seeing does, by the task's id in decimal digits; or as ztl_client_wait, when
 * `seen` is NULL. The text is copied, and must not be NULL.
 */
int ztl_client_wait_by_id(ztl_client *client,
                          const char *id,
                          int limit_ms,
                          ztl_seen_call seen,
                          void *context,
                          int *state);

/**
 * Asks for a task and waits for its end: ztl_client_trigger, then ztl_client_wait, with the errors of both.
 * `task` gets the id as soon as there is one, so that a task that has not ended can be stopped; it and
 * `state` may be NULL.
 */
int ztl_client_run(ztl_client *client,
                   const char *handler,
                   const char *component,
                   const char *goal,
                   int limit_ms,
                   unsigned int *task,
                   int *state);

/**
 * Asks the server about itself, as "tasks" or "devices": ztl_client_text is the answer in JSON, "" where
 * it does not know the question (the Python original knows none). The text is copied.
 */
int ztl_client_ask(ztl_client *client,
                   const char *question);

/**
 * Gives what the library logs, up to a level, to a function of the program; else nothing is logged. Once for
 * the whole process (ZTL_E_STATE), for good, and best before anything else. `log` must not be NULL; `context` is
 * handed to it, stays the program's, and may be NULL. Any thread.
 */
int ztl_log_to(int level,
               ztl_log_call log,
               void *context);

#ifdef __cplusplus
}
#endif

#endif
