/*
 * A first handler: each task is one call of a function, on a thread of its own.
 *
 *   cargo xtask c
 *   cc worker.c -I../../target/c/include ../../target/c/lib/libztl.a -lpthread -ldl -lm -lrt -o worker
 *   ./worker tcp://127.0.0.1:5700
 *
 * and from another terminal: ztl task-client -r localhost -p 5700 -s /robot robot:base:forward
 */
#include <stdio.h>
#include <string.h>
#include <ztl.h>

static void drive(void *context, ztl_server *server, const ztl_request *request)
{
    unsigned int task = request->task;
    char text[32];
    int percent;

    (void)context;
    if (strcmp(request->component, "base") != 0) {
        ztl_task_end(server, task, ZTL_REJECTED, "no such component; there is: base");
        return;
    }
    for (percent = 0; percent < 100; percent++) {
        sprintf(text, "%d percent", percent);
        ztl_task_progress(server, task, text);
        /* Returns early on an ABORT. */
        if (ztl_task_sleep(server, task, 20) != ZTL_OK) {
            ztl_task_end(server, task, ZTL_ABORTED, text);
            return;
        }
    }
    ztl_task_end(server, task, ZTL_COMPLETED, "arrived");
}

int main(int count, char **words)
{
    char text[256];
    ztl_server *server = ztl_server_new();

    ztl_server_add_worker(server, "/robot", drive, NULL);
    if (ztl_server_start(server, count > 1 ? words[1] : "tcp://127.0.0.1:5700") != ZTL_OK) {
        ztl_server_error(server, text, sizeof text);
        fprintf(stderr, "worker: %s\n", text);
        ztl_server_free(server);
        return 1;
    }
    ztl_server_endpoint(server, text, sizeof text);
    printf("serving /robot at %s; Enter ends it\n", text);
    fflush(stdout);
    getchar();
    ztl_server_free(server);
    return 0;
}
