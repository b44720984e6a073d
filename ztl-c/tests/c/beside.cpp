// A program in C++ with a libzmq of its own, and its own idea of everything else: the library beside it notices
// nothing of that, nor does it of the library.
#include <iostream>
#include <map>
#include <stdexcept>
#include <string>
#include <ztl.h>

extern "C" int zmq_ctx_new() { return 42; }
extern "C" int sodium_init() { return 43; }
extern "C" int rust_eh_personality() { return 44; }

static std::map<std::string, int> seen;

static void work(void *, ztl_server *server, const ztl_request *request)
{
    try {
        seen[request->component]++;
        throw std::runtime_error(std::string("no ") + request->goal);
    } catch (const std::exception &error) {
        ztl_task_end(server, request->task, ZTL_FAILED, error.what());
    }
}

int main()
{
    char endpoint[64];
    int state = ZTL_UNKNOWN;
    ztl_server *server = ztl_server_new();
    ztl_client *client = ztl_client_new();

    if (ztl_server_add_worker(server, "/x", work, NULL) != ZTL_OK
        || ztl_server_start(server, "tcp://127.0.0.1:*") != ZTL_OK)
        return 1;
    ztl_server_endpoint(server, endpoint, sizeof endpoint);
    if (ztl_client_connect(client, endpoint, "/x") != ZTL_OK)
        return 1;
    if (ztl_client_run(client, "a", "arm", "hands", 10000, NULL, &state) != ZTL_OK)
        return 1;
    std::cout << ztl_state_name(state) << ' ' << ztl_client_text(client) << ' ' << seen["arm"] << ' '
              << zmq_ctx_new() + sodium_init() + rust_eh_personality() << std::endl;
    ztl_client_free(client);
    ztl_server_free(server);
    return 0;
}
