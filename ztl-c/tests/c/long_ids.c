/* A task whose id fits in no number of C: argument 1 is the server's endpoint. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <ztl.h>

#define CHECK(condition) \
    do { \
        if (!(condition)) { \
            printf("%s:%d: not so: %s\n", __FILE__, __LINE__, #condition); \
            exit(1); \
        } \
    } while (0)

static int count_up(void *context, int error, int state, const char *text)
{
    (void)text;
    *(int *)context += error == ZTL_OK && state == ZTL_COMPLETED;
    return 0;
}

int main(int argc, char **argv)
{
    unsigned int task;
    int state, seen = 0;
    char id[64];
    ztl_client *client = ztl_client_new();

    CHECK(argc == 2 && ztl_client_set_timeout(client, 60000) == ZTL_OK && ztl_client_connect(client, argv[1], "/test") == ZTL_OK);
    CHECK(ztl_client_task_id(client)[0] == '\0');
    CHECK(ztl_client_trigger(client, "arm", "left", "up", &task) == ZTL_OK && task == ZTL_LONG_TASK);
    strcpy(id, ztl_client_task_id(client));
    printf("%s\n", id);
    /* Another task is never meant by mistake. */
    CHECK(ztl_client_abort(client, task, &state) == ZTL_E_ARGUMENT && state == ZTL_UNKNOWN);
    CHECK(ztl_client_status_by_id(client, id, &state) == ZTL_OK && state == ZTL_COMPLETED);
    CHECK(ztl_client_wait_by_id(client, id, -1, count_up, &seen, &state) == ZTL_OK && seen == 1);
    CHECK(ztl_client_abort_by_id(client, id, &state) == ZTL_OK && state == ZTL_ABORTED);
    CHECK(ztl_client_run(client, "arm", "left", "up", -1, &task, &state) == ZTL_OK);
    CHECK(task == ZTL_LONG_TASK && state == ZTL_COMPLETED && strcmp(ztl_client_text(client), "there") == 0);
    ztl_client_free(client);
    return 0;
}
