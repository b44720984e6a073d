/* A ZTL client in C, with no library but libzmq (Debian: libzmq3-dev): starts a task and waits for
 * its final state.
 *
 *     cc -o client client.c -lzmq
 *     ./client tcp://localhost:12345 /robot robot:base:forward
 *
 * prints the outcome, `COMPLETED: arrived`; the exit status is 0 only for COMPLETED. */

#include <stdio.h>
#include <string.h>
#include <time.h>
#include <zmq.h>

static const char *STATES[] = {"INITIATED", "ACCEPTED", "REJECTED", "FAILED", "ABORTED", "COMPLETED"};
static char message[(1 << 20) + 1], task[1 << 16];

/* Sends *id and *text and stores those of the reply; returns its state, or -1 without a reply. */
static int ask(void *server, const char *scope, int code, long *id, char **text)
{
    int state = -1, end = 0;
    int length = snprintf(message, sizeof message, "%s;%d;%ld;%s", scope, code, *id, *text);
    if (zmq_send(server, message, length, 0) < 0) return -1;
    length = zmq_recv(server, message, sizeof message - 1, 0);
    if (length < 0 || length >= (int)sizeof message) return -1;
    message[length] = 0;
    if (sscanf(message, "%*[^;];%d;%ld;%n", &state, id, &end) != 2 || state > 5) return -1;
    *text = message + end;
    return state;
}

static void base64(const char *text, char *out)
{
    const char *digits = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    for (size_t i = 0, length = strlen(text); i < length; i += 3, out += 4) {
        unsigned long group = 0;
        for (size_t j = i; j < i + 3; j++) group = group << 8 | (j < length ? (unsigned char)text[j] : 0);
        for (size_t j = 0; j < 4; j++) out[j] = i + j <= length ? digits[group >> (18 - 6 * j) & 63] : '=';
    }
}

int main(int count, char **args)
{
    if (count != 4 || strlen(args[3]) > sizeof task / 2) return 2;
    void *server = zmq_socket(zmq_ctx_new(), ZMQ_REQ);
    /* Do not queue requests for an absent server; do not take a late reply for the next one. */
    int on = 1, off = 0, limit = 2000;
    zmq_setsockopt(server, ZMQ_IMMEDIATE, &on, sizeof on);
    zmq_setsockopt(server, ZMQ_REQ_RELAXED, &on, sizeof on);
    zmq_setsockopt(server, ZMQ_REQ_CORRELATE, &on, sizeof on);
    zmq_setsockopt(server, ZMQ_LINGER, &off, sizeof off);
    zmq_setsockopt(server, ZMQ_SNDTIMEO, &limit, sizeof limit);
    zmq_setsockopt(server, ZMQ_RCVTIMEO, &limit, sizeof limit);
    if (zmq_connect(server, args[1]) < 0) return 2;

    long id = -1;
    char *text = task;
    base64(args[3], task);
    int state = ask(server, args[2], 1, &id, &text);
    if (state < 0) { /* Never resend: the first may have started the task. */
        puts("UNKNOWN: no answer, the task may run");
        return 1;
    }
    while (state <= 1) { /* No reply (-1) is not a final state. */
        nanosleep(&(struct timespec){.tv_nsec = 100000000}, NULL);
        text = "status update";
        state = ask(server, args[2], 2, &id, &text);
    }
    /* A restarted server does not know the outcome. */
    int lost = id > 0 && !strncmp(text, "Invalid ID", 10);
    printf("%s: %s\n", lost ? "UNKNOWN" : STATES[state], text);
    return state != 5;
}
