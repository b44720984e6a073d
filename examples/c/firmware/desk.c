/*
 * The desk robot as a program on the host, with a TCP port instead of the serial line: to test firmware without a board.
 *
 *   cargo xtask c
 *   cc desk.c robot.c -I../../../target/c/include ../../../target/c/lib/libztl_node.a -o desk && ./desk
 *   ztl gateway -d desk=tcp:127.0.0.1:PORT -p 12345 -s /lab
 */
#define _POSIX_C_SOURCE 200112L
#include "robot.h"

#include <arpa/inet.h>
#include <netinet/in.h>
#include <signal.h>
#include <stdio.h>
#include <string.h>
#include <sys/select.h>
#include <sys/socket.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>

static volatile sig_atomic_t ended = 0;

static void end(int signal)
{
    (void)signal;
    ended = 1;
}

static unsigned int now_ms(void)
{
    struct timespec now;

    clock_gettime(CLOCK_MONOTONIC, &now);
    return (unsigned int)now.tv_sec * 1000u + (unsigned int)now.tv_nsec / 1000000u;
}

void board_place(int tenths)
{
    printf("stage at %d\n", tenths);
    fflush(stdout);
}

void board_lamp(int on)
{
    printf("lamp %s\n", on ? "on" : "off");
    fflush(stdout);
}

/* Waits until the line is readable or the node is due; returns whether the line is readable. */
static int readable(int line, unsigned int wait_ms)
{
    fd_set lines;
    struct timeval wait;

    FD_ZERO(&lines);
    FD_SET(line, &lines);
    wait.tv_sec = wait_ms / 1000;
    wait.tv_usec = (long)(wait_ms % 1000) * 1000;
    return select(line + 1, &lines, NULL, NULL, &wait) > 0;
}

static unsigned char ram[ZTL_NODE_RAM(ROBOT_COMPONENTS)];

int main(void)
{
    ztl_identity identity = {"desk", "1.0.0", 0, 0};
    struct sockaddr_in address;
    socklen_t length = sizeof address;
    unsigned char bytes[256];
    ztl_node *node;
    long count;
    int port, line = -1;

    signal(SIGTERM, end);
    signal(SIGINT, end);
    signal(SIGPIPE, SIG_IGN);
    memset(&address, 0, sizeof address);
    address.sin_family = AF_INET;
    address.sin_addr.s_addr = inet_addr("127.0.0.1");
    port = socket(AF_INET, SOCK_STREAM, 0);
    if (bind(port, (struct sockaddr *)&address, sizeof address) != 0 || listen(port, 1) != 0
        || getsockname(port, (struct sockaddr *)&address, &length) != 0) {
        perror("desk");
        return 1;
    }
    identity.boot = (unsigned int)time(NULL) ^ (unsigned int)getpid() << 16;
    if (ztl_node_init(&node, ram, sizeof ram, &identity, robot_components, ROBOT_COMPONENTS) != ZTL_NODE_OK) {
        fprintf(stderr, "desk: no node\n");
        return 1;
    }
    printf("desk at 127.0.0.1:%u\n", (unsigned int)ntohs(address.sin_port));
    fflush(stdout);

    while (!ended) {
        if (readable(line < 0 ? port : line, ztl_node_wait(node, now_ms()))) {
            if (line < 0) {
                line = accept(port, NULL, NULL);
            } else if ((count = (long)read(line, bytes, sizeof bytes)) > 0) {
                ztl_node_receive(node, now_ms(), bytes, (size_t)count);
            } else {
                close(line);
                line = -1;
            }
        }
        ztl_node_run(node, now_ms());
        count = (long)ztl_node_send(node, now_ms(), bytes, sizeof bytes);
        /* Without a line the bytes are lost, as on an unplugged cable. */
        if (line >= 0 && count > 0 && write(line, bytes, (size_t)count) != count) {
            close(line);
            line = -1;
        }
    }
    if (line >= 0)
        close(line);
    close(port);
    return 0;
}
