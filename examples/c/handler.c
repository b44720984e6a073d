/*
 * An old robot's program: its main loop runs as before, and now newer machines can move the robot's head.
 *
 *   cargo xtask c
 *   cc handler.c -I../../target/c/include ../../target/c/lib/libztl.a -lpthread -ldl -lm -lrt -o handler
 *   ./handler tcp://127.0.0.1:5700
 *
 * and from another terminal, or the unchanged Python client:
 *
 *   ztl task-client -r localhost -p 5700 -s /robot robot:head:45
 */
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <ztl.h>

/* What the head says of itself to `ztl describe` and others. */
#define HEAD "{goal: {type: whole, least: -90, most: 90, unit: degrees}, about: turns the head, examples: ['45']}"

/* The original program: each turn of the main loop moves the head by one degree. */
struct head {
    int degrees;
    int goal;
    /* The task that moves it, or ZTL_NO_TASK. */
    unsigned int task;
};

static void move(struct head *head)
{
    head->degrees += (head->goal > head->degrees) - (head->goal < head->degrees);
}

/* Handles a new task: turn the head. */
static void start(void *context, ztl_server *server, const ztl_request *request)
{
    struct head *head = (struct head *)context;
    char *end;
    long goal = strtol(request->goal, &end, 10);

    if (strcmp(request->component, "head") != 0) {
        ztl_task_end(server, request->task, ZTL_REJECTED, "no such component; there is: head");
    } else if (end == request->goal || *end != '\0' || goal < -90 || goal > 90) {
        ztl_task_end(server, request->task, ZTL_REJECTED, "head takes degrees from -90 to 90");
    } else if (head->task != ZTL_NO_TASK) {
        ztl_task_end(server, request->task, ZTL_REJECTED, "busy with another task");
    } else {
        head->goal = (int)goal;
        head->task = request->task;
    }
}

/* Called every 10 ms while a task runs. */
static void poll(void *context, ztl_server *server, unsigned int task)
{
    struct head *head = (struct head *)context;
    char text[32];

    sprintf(text, "%d degrees", head->degrees);
    if (head->degrees == head->goal) {
        head->task = ZTL_NO_TASK;
        ztl_task_end(server, task, ZTL_COMPLETED, text);
    } else {
        ztl_task_progress(server, task, text);
    }
}

/* Handles an ABORT. */
static void stop(void *context, ztl_server *server, unsigned int task)
{
    struct head *head = (struct head *)context;
    char text[48];

    head->goal = head->degrees;
    head->task = ZTL_NO_TASK;
    sprintf(text, "stopped at %d degrees", head->degrees);
    ztl_task_end(server, task, ZTL_ABORTED, text);
}

static volatile sig_atomic_t ended = 0;

static void end(int signal)
{
    (void)signal;
    ended = 1;
}

int main(int count, char **words)
{
    struct head head = {0, 0, ZTL_NO_TASK};
    char text[256];
    ztl_server *server = ztl_server_new();

    signal(SIGINT, end);
    signal(SIGTERM, end);
    if (ztl_server_add_handler(server, "/robot", start, poll, stop, &head) != ZTL_OK
        || ztl_server_describe(server, "/robot", "robot", "head", HEAD) != ZTL_OK
        || ztl_server_start_polled(server, count > 1 ? words[1] : "tcp://127.0.0.1:5700") != ZTL_OK) {
        ztl_server_error(server, text, sizeof text);
        fprintf(stderr, "handler: %s\n", text);
        ztl_server_free(server);
        return 1;
    }
    ztl_server_endpoint(server, text, sizeof text);
    printf("serving /robot at %s\n", text);
    fflush(stdout);

    /* The main loop: one step of the robot, then up to 20 ms for clients. */
    while (!ended && ztl_server_poll(server, 20) == ZTL_OK)
        move(&head);

    ztl_server_free(server);
    printf("ended\n");
    return 0;
}
