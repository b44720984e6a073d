/*
 * Runs a task and prints its outcome.
 *
 *   cargo xtask c
 *   cc client.c -I../../target/c/include ../../target/c/lib/libztl.a -lpthread -ldl -lm -lrt -o client
 *   ./client tcp://localhost:5700 /robot robot head 45 10000
 *
 * The last number is a timeout in milliseconds, after which the task is aborted. Exit status: 0 COMPLETED;
 * 1 another final state; 2 still running, or outcome unknown; 3 wrong usage.
 */
#include <stdio.h>
#include <stdlib.h>
#include <ztl.h>

static int show(void *context, int error, int state, const char *text)
{
    (void)context;
    if (error == ZTL_OK)
        printf("%s %s\n", ztl_state_name(state), text);
    else
        printf("no answer: %s\n", text);
    fflush(stdout);
    return 0;
}

/* The result of the client's last call; `state` is only valid if `error` is ZTL_OK. */
static int tell(ztl_client *client, int error, int state, unsigned int task)
{
    if (error == ZTL_OK) {
        printf("%s: %s\n", ztl_state_name(state), ztl_client_text(client));
        return state == ZTL_COMPLETED ? 0 : state == ZTL_ACCEPTED ? 2 : 1;
    }
    printf("%s: %s\n", ztl_error_name(error), ztl_client_error(client));
    /* The server has the task; without a reply its outcome is unknown. */
    if (task != ZTL_NO_TASK)
        return 2;
    switch (error) {
    case ZTL_E_NO_ANSWER:
    case ZTL_E_UNREADABLE:
    case ZTL_E_SYSTEM:
        return 2;
    default:
        return 1;
    }
}

int main(int count, char **words)
{
    ztl_client *client;
    unsigned int task;
    int error, state, status;

    if (count != 7) {
        fprintf(stderr, "usage: client ENDPOINT SCOPE HANDLER COMPONENT GOAL MILLISECONDS\n");
        return 3;
    }
    client = ztl_client_new();
    error = ztl_client_connect(client, words[1], words[2]);
    if (error != ZTL_OK) {
        fprintf(stderr, "client: %s\n", ztl_client_error(client));
        ztl_client_free(client);
        return 3;
    }
    error = ztl_client_trigger(client, words[3], words[4], words[5], &task);
    if (error != ZTL_OK) {
        status = tell(client, error, ZTL_UNKNOWN, ZTL_NO_TASK);
    } else {
        error = ztl_client_wait_seeing(client, task, atoi(words[6]), show, NULL, &state);
        if (error == ZTL_E_NOT_ENDED) {
            printf("too long: it is aborted\n");
            error = ztl_client_abort(client, task, &state);
        }
        status = tell(client, error, state, task);
    }
    ztl_client_free(client);
    return status;
}
