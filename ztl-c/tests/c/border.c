/* What a program can do wrong, and in which order it can free things: nothing of it crashes, and each is said. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <ztl.h>

/* Milliseconds: ample also under valgrind on a busy machine. */
#define PATIENCE 60000

#define CHECK(condition) \
    do { \
        if (!(condition)) { \
            printf("%s:%d: not so: %s\n", __FILE__, __LINE__, #condition); \
            exit(1); \
        } \
    } while (0)

static char text[256];

static int said(const ztl_server *server, const char *part)
{
    ztl_server_error(server, text, sizeof text);
    return strstr(text, part) != NULL;
}

/* Every function with NULL where there should be something. */
static void nulls(void)
{
    unsigned int task = 7;
    int state = 7;
    ztl_server *server = ztl_server_new();
    ztl_client *client = ztl_client_new();

    CHECK(ztl_server_free(NULL) == ZTL_OK);
    CHECK(ztl_server_error(NULL, text, sizeof text) == 0 && text[0] == '\0');
    CHECK(ztl_server_endpoint(NULL, text, sizeof text) == 0);
    CHECK(ztl_server_endpoint(server, NULL, 0) == 0);
    CHECK(ztl_server_set(NULL, ZTL_MAX_RUNNING, 1) == ZTL_E_NULL);
    CHECK(ztl_server_allow_network(NULL, "10.0.0.0/8") == ZTL_E_NULL);
    CHECK(ztl_server_allow_network(server, NULL) == ZTL_E_NULL && said(server, "network is NULL"));
    CHECK(ztl_server_use_keys(NULL, "x") == ZTL_E_NULL);
    CHECK(ztl_server_use_keys(server, NULL) == ZTL_E_NULL);
    CHECK(ztl_server_allow_key(NULL, NULL, "x") == ZTL_E_NULL);
    CHECK(ztl_server_allow_key(server, NULL, NULL) == ZTL_E_NULL);
    CHECK(ztl_server_add_worker(NULL, "/x", NULL, NULL) == ZTL_E_NULL);
    CHECK(ztl_server_add_worker(server, "/x", NULL, NULL) == ZTL_E_NULL && said(server, "work is NULL"));
    CHECK(ztl_server_add_handler(NULL, "/x", NULL, NULL, NULL, NULL) == ZTL_E_NULL);
    CHECK(ztl_server_add_handler(server, "/x", NULL, NULL, NULL, NULL) == ZTL_E_NULL);
    CHECK(ztl_server_start(NULL, "tcp://127.0.0.1:*") == ZTL_E_NULL);
    CHECK(ztl_server_start(server, NULL) == ZTL_E_NULL);
    CHECK(ztl_server_start_polled(NULL, "tcp://127.0.0.1:*") == ZTL_E_NULL);
    CHECK(ztl_server_start_polled(server, NULL) == ZTL_E_NULL);
    CHECK(ztl_server_poll(NULL, 0) == ZTL_E_NULL);
    CHECK(ztl_task_accept(NULL, 1) == ZTL_E_NULL);
    CHECK(ztl_task_progress(NULL, 1, "x") == ZTL_E_NULL);
    CHECK(ztl_task_progress(server, 1, NULL) == ZTL_E_NULL);
    CHECK(ztl_task_end(NULL, 1, ZTL_FAILED, "x") == ZTL_E_NULL);
    CHECK(ztl_task_end(server, 1, ZTL_FAILED, NULL) == ZTL_E_NULL);
    CHECK(ztl_task_is_aborted(NULL, 1) == 1);
    CHECK(ztl_task_sleep(NULL, 1, 1) == ZTL_E_NULL);
    CHECK(ztl_task_reject_abort(NULL, 1) == ZTL_E_NULL);
    CHECK(ztl_task_needs_client(NULL, 1, 5000) == ZTL_E_NULL);

    CHECK(ztl_client_clone(NULL) == NULL);
    ztl_client_free(NULL);
    CHECK(ztl_client_text(NULL) != NULL);
    CHECK(strcmp(ztl_client_error(NULL), "the client is NULL") == 0);
    CHECK(ztl_client_set_timeout(NULL, 1) == ZTL_E_NULL);
    CHECK(ztl_client_use_keys(NULL, "x", "x") == ZTL_E_NULL);
    CHECK(ztl_client_connect(NULL, "tcp://127.0.0.1:1", "/x") == ZTL_E_NULL);
    CHECK(ztl_client_connect(client, NULL, "/x") == ZTL_E_NULL);
    CHECK(ztl_client_connect(client, "tcp://127.0.0.1:1", NULL) == ZTL_E_NULL);
    CHECK(strcmp(ztl_client_error(client), "scope is NULL") == 0);
    CHECK(ztl_client_trigger(NULL, "a", "b", "c", &task) == ZTL_E_NULL && task == ZTL_NO_TASK);
    CHECK(ztl_client_trigger(client, NULL, "b", "c", NULL) == ZTL_E_NULL);
    CHECK(ztl_client_trigger(client, "a", NULL, "c", NULL) == ZTL_E_NULL);
    CHECK(ztl_client_trigger(client, "a", "b", NULL, NULL) == ZTL_E_NULL);
    CHECK(ztl_client_status(NULL, 1, &state) == ZTL_E_NULL && state == ZTL_UNKNOWN);
    CHECK(ztl_client_abort(NULL, 1, NULL) == ZTL_E_NULL);
    CHECK(ztl_client_wait(NULL, 1, 0, NULL) == ZTL_E_NULL);
    CHECK(ztl_client_wait_seeing(client, 1, 0, NULL, NULL, NULL) == ZTL_E_NULL);
    CHECK(ztl_client_run(NULL, "a", "b", "c", 0, NULL, NULL) == ZTL_E_NULL);
    CHECK(ztl_client_ask(client, NULL) == ZTL_E_NULL);
    CHECK(ztl_log_to(ZTL_LOG_INFO, NULL, NULL) == ZTL_E_NULL);

    ztl_client_free(client);
    CHECK(ztl_server_free(server) == ZTL_OK);
}

static void nothing(void *context, ztl_server *server, const ztl_request *request)
{
    (void)context;
    (void)server;
    (void)request;
}

/* Calls that come too early, too late or with what they do not take. */
static void mistakes(void)
{
    ztl_server *server = ztl_server_new();
    ztl_client *client = ztl_client_new();
    char small[8];

    CHECK(ztl_abi() == ZTL_ABI);
    CHECK(strcmp(ztl_error_name(ZTL_E_NO_ANSWER), "ZTL_E_NO_ANSWER") == 0);
    CHECK(strcmp(ztl_error_name(99), "ZTL_E_?") == 0);
    CHECK(strcmp(ztl_state_name(ZTL_ABORTED), "ABORTED") == 0);
    CHECK(strcmp(ztl_state_name(99), "UNKNOWN") == 0);

    CHECK(ztl_server_poll(server, 0) == ZTL_E_STATE && said(server, "not started"));
    CHECK(ztl_task_end(server, 1, ZTL_FAILED, "x") == ZTL_E_STATE);
    CHECK(ztl_server_set(server, 99, 1) == ZTL_E_ARGUMENT && said(server, "99"));
    CHECK(ztl_server_allow_network(server, "10.0.0") == ZTL_E_ARGUMENT && said(server, "10.0.0"));
    CHECK(ztl_server_add_worker(server, "", nothing, NULL) == ZTL_E_ARGUMENT);
    CHECK(ztl_server_add_worker(server, "a;b", nothing, NULL) == ZTL_E_ARGUMENT && said(server, ";"));
    CHECK(ztl_server_add_worker(server, "/\xff", nothing, NULL) == ZTL_E_ARGUMENT && said(server, "UTF-8"));
    CHECK(ztl_server_add_worker(server, "/x", nothing, NULL) == ZTL_OK);
    CHECK(ztl_server_add_worker(server, "/x", nothing, NULL) == ZTL_E_ARGUMENT && said(server, "already"));
    CHECK(ztl_server_describe(NULL, "/x", "arm", "left", "{}") == ZTL_E_NULL);
    CHECK(ztl_server_describe(server, "/x", "arm", NULL, "{}") == ZTL_E_NULL && said(server, "component is NULL"));
    CHECK(ztl_server_describe(server, "/x", "arm", "left", NULL) == ZTL_E_NULL && said(server, "description is NULL"));
    CHECK(ztl_server_describe(server, "/y", "arm", "left", "{}") == ZTL_E_ARGUMENT && said(server, "'/y' is not served"));
    CHECK(ztl_server_describe(server, "/x", "a:b", "left", "{}") == ZTL_E_ARGUMENT && said(server, "':'"));
    CHECK(ztl_server_describe(server, "/x", "arm", "left", "\xff") == ZTL_E_ARGUMENT && said(server, "UTF-8"));
    CHECK(ztl_server_describe(server, "/x", "arm", "left", "left or right") == ZTL_E_ARGUMENT && said(server, "a mapping"));
    CHECK(ztl_server_describe(server, "/x", "arm", "left", "{goal: {type: numbr}}") == ZTL_E_ARGUMENT
          && said(server, "arm:left: goal.type: not understood"));
    CHECK(ztl_server_describe(server, "/x", "arm", "left", "{goal: {type: number}, about: lifts}") == ZTL_OK);
    CHECK(ztl_server_start(server, "nowhere") == ZTL_E_ARGUMENT && said(server, "'nowhere' is not an address"));
    CHECK(ztl_server_start(server, "tcp://1.2.3.4:1") == ZTL_E_ADDRESS);
    CHECK(ztl_server_error(server, small, sizeof small) > 7 && strlen(small) == 7);
    CHECK(ztl_server_error(server, small, 1) > 7 && small[0] == '\0');
    CHECK(ztl_server_start(server, "tcp://127.0.0.1:*") == ZTL_OK);
    CHECK(ztl_server_start(server, "tcp://127.0.0.1:*") == ZTL_E_STATE && said(server, "started already"));
    CHECK(ztl_server_describe(server, "/x", "arm", "left", "{}") == ZTL_E_STATE);
    CHECK(ztl_server_add_worker(server, "/y", nothing, NULL) == ZTL_E_STATE);
    CHECK(ztl_server_set(server, ZTL_MAX_RUNNING, 1) == ZTL_E_STATE);
    CHECK(ztl_server_poll(server, 1) == ZTL_OK);
    CHECK(ztl_task_end(server, 1, ZTL_FAILED, "x") == ZTL_E_ENDED);
    CHECK(ztl_task_end(server, 0, ZTL_FAILED, "x") == ZTL_E_ENDED);
    CHECK(ztl_task_end(server, 1, ZTL_ACCEPTED, "x") == ZTL_E_ARGUMENT && said(server, "ZTL_COMPLETED"));
    CHECK(ztl_task_is_aborted(server, 1) == 1);

    CHECK(ztl_client_status(client, 1, NULL) == ZTL_E_STATE);
    CHECK(strstr(ztl_client_error(client), "ztl_client_connect") != NULL);
    CHECK(ztl_client_connect(client, "nowhere", "/x") == ZTL_E_ARGUMENT);
    CHECK(strstr(ztl_client_error(client), "'nowhere' is not an address") != NULL);
    CHECK(ztl_client_connect(client, "tcp://127.0.0.1:1", "/a;b") == ZTL_E_ARGUMENT);
    CHECK(strstr(ztl_client_error(client), "the scope '/a;b' contains ';'") != NULL);
    CHECK(ztl_server_endpoint(server, text, sizeof text) == strlen(text));
    CHECK(ztl_client_set_timeout(client, PATIENCE) == ZTL_OK);
    CHECK(ztl_client_connect(client, text, "/x") == ZTL_OK);
    CHECK(ztl_client_connect(client, text, "/x") == ZTL_E_STATE);
    CHECK(ztl_client_set_timeout(client, 1) == ZTL_E_STATE);
    CHECK(ztl_client_trigger(client, "a:b", "c", "d", NULL) == ZTL_E_ARGUMENT);
    CHECK(ztl_client_status(client, 0, NULL) == ZTL_E_ARGUMENT);
    ztl_client_free(client);
    CHECK(ztl_server_free(server) == ZTL_OK);
}

/* No answer is never FAILED. */
static void unanswered(void)
{
    unsigned int task = 7;
    int state = ZTL_FAILED;
    ztl_client *client = ztl_client_new();

    CHECK(ztl_client_set_timeout(client, 100) == ZTL_OK);
    CHECK(ztl_client_connect(client, "tcp://127.0.0.1:1", "/x") == ZTL_OK);
    CHECK(ztl_client_run(client, "a", "b", "c", 100, &task, &state) == ZTL_E_NOT_CONNECTED);
    CHECK(task == ZTL_NO_TASK && state == ZTL_UNKNOWN);
    CHECK(strstr(ztl_client_error(client), "nothing was sent") != NULL);
    state = ZTL_FAILED;
    CHECK(ztl_client_wait(client, 1, 100, &state) == ZTL_E_NOT_CONNECTED && state == ZTL_UNKNOWN);
    ztl_client_free(client);
}

/* A worker that does all that it must not, and says what came of it. */
static void wrong(void *context, ztl_server *server, const ztl_request *request)
{
    unsigned int task = request->task;

    (void)context;
    if (strcmp(request->component, "silent") == 0)
        return;
    if (strcmp(request->component, "late") == 0) {
        ztl_task_accept(server, task);
        ztl_task_end(server, task, ZTL_REJECTED, "too late");
        return;
    }
    if (strcmp(request->component, "deaf") == 0) {
        ztl_task_reject_abort(server, task);
        while (ztl_task_sleep(server, task, 10000) == ZTL_OK)
            continue;
        return;
    }
    if (ztl_server_free(server) != ZTL_E_STATE || !said(server, "own callback")
        || ztl_task_end(server, task, ZTL_COMPLETED, "first") != ZTL_OK
        || ztl_task_end(server, task, ZTL_FAILED, "second") != ZTL_E_ENDED
        || ztl_task_progress(server, task, "x") != ZTL_E_ENDED
        || ztl_task_sleep(server, task, 10000) != ZTL_E_ENDED
        || ztl_task_is_aborted(server, task) != 1)
        abort();
}

static int stop_at_once(void *context, int error, int state, const char *progress)
{
    (void)progress;
    *(int *)context = state;
    return error == ZTL_OK;
}

/* Ends count once, clients are freed before and after their server, and a server with tasks that run. */
static void orders(void)
{
    unsigned int task, other;
    int state, seen = ZTL_UNKNOWN;
    ztl_server *server = ztl_server_new();
    ztl_client *client = ztl_client_new();
    ztl_client *later;

    CHECK(ztl_server_add_worker(server, "/x", wrong, NULL) == ZTL_OK);
    CHECK(ztl_server_start(server, "tcp://127.0.0.1:*") == ZTL_OK);
    ztl_server_endpoint(server, text, sizeof text);
    CHECK(ztl_client_set_timeout(client, PATIENCE) == ZTL_OK);
    CHECK(ztl_client_connect(client, text, "/x") == ZTL_OK);
    later = ztl_client_clone(client);
    CHECK(later != NULL);

    CHECK(ztl_client_run(client, "a", "twice", "", PATIENCE, &task, &state) == ZTL_OK);
    CHECK(task != ZTL_NO_TASK && state == ZTL_COMPLETED);
    CHECK(strcmp(ztl_client_text(client), "first") == 0);
    sprintf(text, "%u", task);
    CHECK(strcmp(ztl_client_task_id(client), text) == 0);
    CHECK(ztl_client_status_by_id(client, text, &state) == ZTL_OK && state == ZTL_COMPLETED);
    CHECK(ztl_client_abort_by_id(client, text, &state) == ZTL_OK && state == ZTL_COMPLETED);
    CHECK(ztl_client_wait_by_id(client, text, PATIENCE, NULL, NULL, &state) == ZTL_OK && state == ZTL_COMPLETED);
    CHECK(ztl_client_status_by_id(client, "x", &state) == ZTL_E_ARGUMENT && state == ZTL_UNKNOWN);
    CHECK(strstr(ztl_client_error(client), "invalid task id 'x'") != NULL);
    CHECK(ztl_client_status_by_id(client, "0", &state) == ZTL_E_ARGUMENT);
    CHECK(ztl_client_status_by_id(client, NULL, &state) == ZTL_E_NULL);
    CHECK(ztl_client_status(client, ZTL_LONG_TASK, &state) == ZTL_E_ARGUMENT);
    CHECK(strstr(ztl_client_error(client), "ztl_client_task_id") != NULL);
    CHECK(ztl_client_run(client, "a", "silent", "", PATIENCE, NULL, &state) == ZTL_OK);
    CHECK(state == ZTL_FAILED && strstr(ztl_client_text(client), "without an end") != NULL);
    CHECK(ztl_client_run(client, "a", "late", "", PATIENCE, NULL, &state) == ZTL_OK);
    CHECK(state == ZTL_FAILED && strcmp(ztl_client_text(client), "too late") == 0);

    CHECK(ztl_client_run(later, "a", "deaf", "", 50, &other, &state) == ZTL_E_NOT_ENDED);
    CHECK(state == ZTL_ACCEPTED && other != task);
    CHECK(ztl_client_wait_seeing(later, other, -1, stop_at_once, &seen, &state) == ZTL_E_NOT_ENDED);
    CHECK(seen == ZTL_ACCEPTED);
    CHECK(ztl_client_ask(later, "tasks") == ZTL_OK && ztl_client_text(later)[0] == '{');
    CHECK(ztl_client_ask(later, "weather") == ZTL_OK && ztl_client_text(later)[0] == '\0');
    CHECK(ztl_client_status(later, 1, &state) == ZTL_E_UNKNOWN_TASK && state == ZTL_UNKNOWN);
    CHECK(ztl_client_wait(later, 1, 1000, &state) == ZTL_E_UNKNOWN_TASK && state == ZTL_UNKNOWN);

    ztl_client_free(client);
    CHECK(ztl_server_free(server) == ZTL_OK);
    ztl_client_free(later);
}

/* What is too long for the server is not sent, and the client goes on. */
static void too_long(void)
{
    static char goal[1000001];
    unsigned int task = 7;
    int state;
    ztl_server *server = ztl_server_new();
    ztl_client *client = ztl_client_new();

    CHECK(ztl_server_add_worker(server, "/x", wrong, NULL) == ZTL_OK);
    CHECK(ztl_server_start(server, "tcp://127.0.0.1:*") == ZTL_OK);
    ztl_server_endpoint(server, text, sizeof text);
    CHECK(ztl_client_set_timeout(client, PATIENCE) == ZTL_OK);
    CHECK(ztl_client_connect(client, text, "/x") == ZTL_OK);
    memset(goal, 'x', sizeof goal - 1);
    CHECK(ztl_client_trigger(client, "a", "twice", goal, &task) == ZTL_E_TOO_LONG && task == ZTL_NO_TASK);
    CHECK(strstr(ztl_client_error(client), "has 1333352 bytes") != NULL);
    CHECK(strstr(ztl_client_error(client), "takes at most 1048576") != NULL);
    goal[786000] = '\0';
    CHECK(ztl_client_run(client, "a", "twice", goal, PATIENCE, &task, &state) == ZTL_OK);
    CHECK(task != ZTL_NO_TASK && state == ZTL_COMPLETED);
    ztl_client_free(client);
    CHECK(ztl_server_free(server) == ZTL_OK);
}

static void count_up(void *context, ztl_server *server, const ztl_request *request)
{
    (void)server;
    (void)request;
    ++*(int *)context;
}

static void end_it(void *context, ztl_server *server, unsigned int task)
{
    (void)context;
    if (ztl_server_poll(server, 0) == ZTL_OK)
        abort();
    ztl_task_end(server, task, ZTL_ABORTED, "stopped");
}

/* Calls are made within ztl_server_poll alone; what is to stop before its start is never begun; freeing stops the task. */
static void polled(void)
{
    unsigned int task;
    int state, starts = 0;
    ztl_server *server = ztl_server_new();
    ztl_client *client = ztl_client_new();

    CHECK(ztl_server_set(server, ZTL_POLL_MS, 1) == ZTL_OK);
    CHECK(ztl_server_add_handler(server, "/x", count_up, NULL, end_it, &starts) == ZTL_OK);
    CHECK(ztl_server_start_polled(server, "tcp://127.0.0.1:*") == ZTL_OK);
    ztl_server_endpoint(server, text, sizeof text);
    CHECK(ztl_client_set_timeout(client, PATIENCE) == ZTL_OK);
    CHECK(ztl_client_connect(client, text, "/x") == ZTL_OK);
    /* Nobody polls: the server itself answers after 1.5 s. */
    CHECK(ztl_client_trigger(client, "a", "b", "c", &task) == ZTL_OK);
    CHECK(ztl_client_abort(client, task, &state) == ZTL_OK && state == ZTL_ACCEPTED);
    CHECK(ztl_server_poll(server, 0) == ZTL_OK && starts == 0);
    CHECK(ztl_client_wait(client, task, PATIENCE, &state) == ZTL_OK && state == ZTL_ABORTED);
    CHECK(strcmp(ztl_client_text(client), "stopped before it had begun") == 0);
    CHECK(ztl_client_trigger(client, "a", "b", "c", NULL) == ZTL_OK);
    CHECK(ztl_server_poll(server, PATIENCE) == ZTL_OK && starts == 1);
    CHECK(ztl_client_trigger(client, "a", "b", "c", NULL) == ZTL_OK);
    CHECK(ztl_server_free(server) == ZTL_OK && starts == 1);
    ztl_client_free(client);
}

/* Runs the other server for a while, in whose callback this one is freed, or not. */
static void run_other(void *context, ztl_server *server, const ztl_request *request)
{
    CHECK(ztl_server_poll((ztl_server *)context, PATIENCE) == ZTL_OK);
    CHECK(ztl_task_end(server, request->task, ZTL_COMPLETED, "still here") == ZTL_OK);
}

static void free_other(void *context, ztl_server *server, const ztl_request *request)
{
    CHECK(ztl_server_free(*(ztl_server **)context) == ZTL_E_STATE);
    CHECK(ztl_task_end(server, request->task, ZTL_COMPLETED, "not freed") == ZTL_OK);
}

/* A callback within a callback frees neither server. */
static void nested(void)
{
    ztl_server *outer = ztl_server_new();
    ztl_server *inner = ztl_server_new();
    ztl_client *client;
    int i;

    CHECK(ztl_server_add_handler(outer, "/x", run_other, NULL, NULL, inner) == ZTL_OK);
    CHECK(ztl_server_add_handler(inner, "/x", free_other, NULL, NULL, &outer) == ZTL_OK);
    CHECK(ztl_server_start_polled(outer, "tcp://127.0.0.1:*") == ZTL_OK);
    CHECK(ztl_server_start_polled(inner, "tcp://127.0.0.1:*") == ZTL_OK);
    for (i = 0; i < 2; i++) {
        client = ztl_client_new();
        ztl_server_endpoint(i == 0 ? outer : inner, text, sizeof text);
        CHECK(ztl_client_set_timeout(client, PATIENCE) == ZTL_OK && ztl_client_connect(client, text, "/x") == ZTL_OK);
        /* Nobody polls: the server itself answers after 1.5 s. */
        CHECK(ztl_client_trigger(client, "a", "b", "c", NULL) == ZTL_OK);
        ztl_client_free(client);
    }
    CHECK(ztl_server_poll(outer, PATIENCE) == ZTL_OK);
    CHECK(ztl_server_free(outer) == ZTL_OK && ztl_server_free(inner) == ZTL_OK);
}

static void log_line(void *context, int level, const char *line)
{
    (void)context;
    (void)level;
    CHECK(line != NULL && strchr(line, '\n') == NULL);
}

int main(int count, char **words)
{
    (void)words;
    if (count > 1) {
        CHECK(ztl_log_to(0, log_line, NULL) == ZTL_E_ARGUMENT);
        CHECK(ztl_log_to(ZTL_LOG_DEBUG, log_line, NULL) == ZTL_OK);
        CHECK(ztl_log_to(ZTL_LOG_DEBUG, log_line, NULL) == ZTL_E_STATE);
    }
    nulls();
    mistakes();
    unanswered();
    too_long();
    orders();
    polled();
    nested();
    printf("all is said\n");
    return 0;
}
