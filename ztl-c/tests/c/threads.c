/* Many threads with a client each, one server; and one client that two threads fight for. */
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <ztl.h>

#define THREADS 8
#define TASKS 20

static void echo(void *context, ztl_server *server, const ztl_request *request)
{
    (void)context;
    ztl_task_progress(server, request->task, request->goal);
    if (strcmp(request->component, "long") == 0 && ztl_task_sleep(server, request->task, 60000) != ZTL_OK)
        ztl_task_end(server, request->task, ZTL_ABORTED, request->goal);
    else
        ztl_task_end(server, request->task, ZTL_COMPLETED, request->goal);
}

static void *ask(void *argument)
{
    ztl_client *client = (ztl_client *)argument;
    char goal[16];
    int i, state;
    unsigned int task;

    for (i = 0; i < TASKS; i++) {
        sprintf(goal, "%d", i);
        if (ztl_client_run(client, "a", "b", goal, 20000, NULL, &state) != ZTL_OK || state != ZTL_COMPLETED
            || strcmp(ztl_client_text(client), goal) != 0)
            abort();
    }
    if (ztl_client_trigger(client, "a", "long", "x", &task) != ZTL_OK
        || ztl_client_abort(client, task, &state) != ZTL_OK
        || ztl_client_wait(client, task, 20000, &state) != ZTL_OK || state != ZTL_ABORTED
        || ztl_client_trigger(client, "a", "long", "x", &task) != ZTL_OK)
        abort();
    ztl_client_free(client);
    return NULL;
}

static void *fight(void *argument)
{
    int i, state, error;

    for (i = 0; i < TASKS; i++) {
        error = ztl_client_run((ztl_client *)argument, "a", "b", "c", 20000, NULL, &state);
        if (error != ZTL_OK && error != ZTL_E_BUSY)
            abort();
    }
    return NULL;
}

int main(void)
{
    pthread_t threads[THREADS + 2];
    char endpoint[64];
    int i;
    ztl_server *server = ztl_server_new();
    ztl_client *client = ztl_client_new();

    if (ztl_server_add_worker(server, "/x", echo, NULL) != ZTL_OK
        || ztl_server_start(server, "tcp://127.0.0.1:*") != ZTL_OK)
        return 1;
    ztl_server_endpoint(server, endpoint, sizeof endpoint);
    if (ztl_client_set_timeout(client, 20000) != ZTL_OK || ztl_client_connect(client, endpoint, "/x") != ZTL_OK)
        return 1;
    for (i = 0; i < THREADS; i++)
        if (pthread_create(&threads[i], NULL, ask, ztl_client_clone(client)) != 0)
            return 1;
    for (; i < THREADS + 2; i++)
        if (pthread_create(&threads[i], NULL, fight, client) != 0)
            return 1;
    for (i = 0; i < THREADS + 2; i++)
        pthread_join(threads[i], NULL);
    /* A long task of each thread still runs. */
    ztl_server_free(server);
    ztl_client_free(client);
    printf("all have ended\n");
    return 0;
}
