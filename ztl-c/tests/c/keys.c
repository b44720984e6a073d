/* A server that knows its clients: keys DIRECTORY, with keys made by `ztl keys`. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <ztl.h>

static char path[3][512];

static const char *file(int index, const char *directory, const char *name)
{
    sprintf(path[index], "%.400s/%.100s", directory, name);
    return path[index];
}

static void work(void *context, ztl_server *server, const ztl_request *request)
{
    (void)context;
    ztl_task_end(server, request->task, ZTL_COMPLETED, "done");
}

static int run(const char *endpoint, const char *scope, const char *keys, const char *directory, unsigned int time_ms)
{
    int error, state;
    ztl_client *client = ztl_client_new();

    error = ztl_client_set_timeout(client, time_ms);
    if (keys != NULL && error == ZTL_OK)
        error = ztl_client_use_keys(client, file(0, directory, keys), file(1, directory, "robot.key"));
    if (error == ZTL_OK)
        error = ztl_client_connect(client, endpoint, scope);
    if (error == ZTL_OK)
        error = ztl_client_run(client, "a", "b", "c", 60000, NULL, &state);
    printf("%s %s %s: %s\n", keys == NULL ? "nobody" : keys, scope, ztl_error_name(error),
           error == ZTL_OK ? ztl_client_text(client) : ztl_client_error(client));
    ztl_client_free(client);
    return error;
}

int main(int count, char **words)
{
    char endpoint[64], text[256];
    const char *directory = words[count - 1];
    ztl_server *server = ztl_server_new();

    if (ztl_server_use_keys(server, file(0, directory, "none.key_secret")) != ZTL_E_KEY)
        return 1;
    ztl_server_error(server, text, sizeof text);
    printf("%s\n", text);
    if (ztl_server_use_keys(server, file(0, directory, "robot.key_secret")) != ZTL_OK
        || ztl_server_allow_key(server, NULL, file(0, directory, "ann.key")) != ZTL_OK
        || ztl_server_allow_key(server, "/one", file(0, directory, "bob.key")) != ZTL_OK
        || ztl_server_allow_network(server, "127.0.0.0/8") != ZTL_OK
        || ztl_server_add_worker(server, "/one", work, NULL) != ZTL_OK
        || ztl_server_add_worker(server, "/two", work, NULL) != ZTL_OK
        || ztl_server_start(server, "tcp://127.0.0.1:*") != ZTL_OK)
        return 1;
    ztl_server_endpoint(server, endpoint, sizeof endpoint);
    run(endpoint, "/one", "ann.key_secret", directory, 20000);
    run(endpoint, "/two", "ann.key_secret", directory, 20000);
    run(endpoint, "/one", "bob.key_secret", directory, 20000);
    run(endpoint, "/two", "bob.key_secret", directory, 20000);
    run(endpoint, "/one", "eve.key_secret", directory, 1000);
    run(endpoint, "/one", NULL, directory, 1000);
    ztl_server_free(server);
    return 0;
}
