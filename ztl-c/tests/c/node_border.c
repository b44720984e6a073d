/* What firmware can do wrong with a node: nothing of it crashes. Then bytes that are no frames. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <ztl_node.h>

#define CHECK(condition) \
    do { \
        if (!(condition)) { \
            printf("%s:%d: not so: %s\n", __FILE__, __LINE__, #condition); \
            exit(1); \
        } \
    } while (0)

static int safe_calls;

static int taken(void *context, unsigned int now_ms, const char *goal, ztl_report *why)
{
    (void)context;
    (void)now_ms;
    (void)goal;
    (void)why;
    return ZTL_NODE_TAKEN;
}

static int done(void *context, unsigned int now_ms, ztl_report *report)
{
    (void)context;
    (void)now_ms;
    (void)report;
    return ZTL_NODE_COMPLETED;
}

static void safe(void *context, unsigned int now_ms)
{
    (void)now_ms;
    ++*(int *)context;
}

static ztl_component component(void)
{
    ztl_component it;

    memset(&it, 0, sizeof it);
    it.name = "lamp";
    it.context = &safe_calls;
    it.start = taken;
    it.poll = done;
    it.abort = safe;
    it.make_safe = safe;
    return it;
}

/* Memory of exactly the size that is needed, at any address: what looks at it sees each byte outside. */
static void init(void)
{
    ztl_identity identity = {"desk", "1.0.0", 7, 0};
    ztl_component parts[3];
    ztl_component other;
    ztl_node *node = NULL;
    size_t size = ztl_node_size(3), shift;
    unsigned char *ram = (unsigned char *)malloc(size);
    char text[80];

    parts[0] = parts[1] = parts[2] = component();
    CHECK(size <= ZTL_NODE_RAM(3) && ztl_node_size(1) < size);
    CHECK(size == ZTL_NODE_RAM(3) || sizeof(void *) < 8);
    CHECK(ztl_node_init(NULL, ram, size, &identity, parts, 3) == ZTL_NODE_E_NULL);
    CHECK(ztl_node_init(&node, NULL, size, &identity, parts, 3) == ZTL_NODE_E_NULL && node == NULL);
    CHECK(ztl_node_init(&node, ram, size, NULL, parts, 3) == ZTL_NODE_E_NULL);
    CHECK(ztl_node_init(&node, ram, size, &identity, NULL, 3) == ZTL_NODE_E_NULL);
    CHECK(ztl_node_init(&node, ram, size - 1, &identity, parts, 3) == ZTL_NODE_E_RAM);
    CHECK(ztl_node_init(&node, ram, size, &identity, parts, 0) == ZTL_NODE_E_COUNT);
    CHECK(ztl_node_init(&node, ram, size, &identity, parts, 256) == ZTL_NODE_E_COUNT);
    identity.name = NULL;
    CHECK(ztl_node_init(&node, ram, size, &identity, parts, 3) == ZTL_NODE_E_NULL);
    identity.name = "\xff";
    CHECK(ztl_node_init(&node, ram, size, &identity, parts, 3) == ZTL_NODE_E_TEXT);
    identity.name = "desk";
    other = component();
    other.poll = NULL;
    CHECK(ztl_node_init(&node, ram, size, &identity, &other, 1) == ZTL_NODE_E_NULL);
    other = component();
    other.name = NULL;
    CHECK(ztl_node_init(&node, ram, size, &identity, &other, 1) == ZTL_NODE_E_NULL);
    memset(text, 'x', sizeof text);
    text[79] = '\0';
    other.name = text;
    CHECK(ztl_node_init(&node, ram, size, &identity, &other, 1) == ZTL_NODE_E_TEXT);
    /* Each of them would do, and a frame has no room for both. */
    text[60] = '\0';
    other = component();
    other.words = other.unit = text;
    CHECK(ztl_node_init(&node, ram, size, &identity, &other, 1) == ZTL_NODE_E_TEXT);
    other.words = NULL;
    CHECK(ztl_node_init(&node, ram, size, &identity, &other, 1) == ZTL_NODE_OK);
    text[ZTL_NODE_NAME + 1] = '\0';
    identity.name = text;
    CHECK(ztl_node_init(&node, ram, size, &identity, parts, 3) == ZTL_NODE_E_TEXT);
    text[ZTL_NODE_NAME] = '\0';
    CHECK(ztl_node_init(&node, ram, size, &identity, parts, 3) == ZTL_NODE_OK);
    identity.name = "desk";
    other = component();
    other.busy = 256;
    CHECK(ztl_node_init(&node, ram, size, &identity, &other, 1) == ZTL_NODE_E_POLICY);
    other = component();
    other.loss = 3;
    CHECK(ztl_node_init(&node, ram, size, &identity, &other, 1) == ZTL_NODE_E_POLICY);
    free(ram);

    for (shift = 0; shift < 16; shift++) {
        ram = (unsigned char *)malloc(size + shift);
        CHECK(ztl_node_init(&node, ram + shift, size, &identity, parts, 3) == ZTL_NODE_OK && node != NULL);
        ztl_node_run(node, 0);
        free(ram);
    }
}

static void nulls(void)
{
    unsigned char byte = 0;
    int number = 7;

    ztl_node_receive(NULL, 0, &byte, 1);
    ztl_node_run(NULL, 0);
    CHECK(ztl_node_send(NULL, 0, &byte, 1) == 0);
    CHECK(ztl_node_wait(NULL, 0) == 1000);
    ztl_node_stop(NULL, 0);
    ztl_node_clear_stop(NULL);
    CHECK(ztl_node_is_stopped(NULL) == 0);
    ztl_node_counters(NULL, NULL);
    ztl_report_text(NULL, "x");
    ztl_report_number(NULL, 1, 1);
    CHECK(ztl_goal_number(NULL, 1, &number) == 0 && ztl_goal_number("1", 1, NULL) == 0);
    CHECK(ztl_goal_number("-45.26", 1, &number) == 1 && number == -453);
    CHECK(ztl_goal_number("1e3", 0, &number) == 1 && number == 1000);
    CHECK(ztl_goal_number("up", 0, &number) == 0 && ztl_goal_number("99999999999", 0, &number) == 0);
    CHECK(number == 1000);
}

static void bytes(void)
{
    static unsigned char ram[ZTL_NODE_RAM(1)];
    ztl_identity identity = {"desk", "1.0.0", 7, 100};
    ztl_component part = component();
    ztl_counters counters = {0, 0, 0, 0};
    unsigned char buffer[200];
    unsigned int now = 0xFFFFFF00u, i, j;
    size_t sent = 0;
    ztl_node *node;

    CHECK(ztl_node_init(&node, ram, sizeof ram, &identity, &part, 1) == ZTL_NODE_OK);
    ztl_node_receive(node, now, NULL, 5);
    CHECK(ztl_node_send(node, now, NULL, 5) == 0);
    ztl_node_counters(node, NULL);
    CHECK(ztl_node_send(node, now, buffer, 0) == 0);
    /* It announces itself each 250 ms, also when the clock wraps, and stands still when that goes back. */
    srand(1);
    for (i = 0; i < 5000; i++) {
        for (j = 0; j < sizeof buffer; j++)
            buffer[j] = (unsigned char)(rand() % 8 ? rand() : 0);
        ztl_node_receive(node, now, buffer, sizeof buffer);
        ztl_node_run(node, now);
        sent += ztl_node_send(node, now, buffer, sizeof buffer) > 0;
        CHECK(ztl_node_wait(node, now) <= 250);
        now++;
        CHECK(ztl_node_wait(node, now - 100) <= 250);
    }
    CHECK(sent == 20);
    ztl_node_counters(node, &counters);
    CHECK(counters.frames == 0 && counters.errors > 5000);
    CHECK(safe_calls == 0);
    ztl_node_stop(node, now);
    CHECK(safe_calls == 1 && ztl_node_is_stopped(node) == 1);
    ztl_node_clear_stop(node);
    CHECK(ztl_node_is_stopped(node) == 0);
}

int main(void)
{
    nulls();
    init();
    bytes();
    printf("all is said\n");
    return 0;
}
