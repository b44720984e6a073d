/*
 * The node end of ZTL's link for firmware in C. Components are callbacks, calls pass bytes in and out, and the time is an
 * argument. No allocator, no operating system, no floating point, no interrupts of its own. docs/c.md has a first example.
 * This file is generated from ztl-node-c/src; the tests compare the two.
 *
 * Rules: call all functions from one context, preferably the main loop. Texts end with a zero. A NULL pointer where none is
 * allowed has no effect and crashes nothing. Nothing is ever freed. No function fails because of received bytes: damaged
 * data is dropped and counted.
 */
#ifndef ZTL_NODE_H
#define ZTL_NODE_H


#include <stddef.h>

#ifdef __cplusplus
extern "C" {
#endif

/**
 * Version of the interface that this header describes. It changes when firmware must be recompiled.
 */
#define ZTL_NODE_ABI 1

/**
 * How many tasks a node holds, including ended tasks whose outcome is not acknowledged yet.
 */
#define ZTL_NODE_TASKS 4

/**
 * Longest frame on the line, in bytes.
 */
#define ZTL_NODE_FRAME 128

/**
 * Longest name of the device, and longest version of its firmware, in bytes.
 */
#define ZTL_NODE_NAME 28

/**
 * Longest text that a component reports, in bytes; a reason to refuse may have twice as many. Longer texts are cut
 * and marked.
 */
#define ZTL_NODE_TEXT 48

/**
 * Success.
 */
#define ZTL_NODE_OK 0

/**
 * A required pointer is NULL, or a callback is missing.
 */
#define ZTL_NODE_E_NULL (-1)

/**
 * There is less RAM than ztl_node_size returns.
 */
#define ZTL_NODE_E_RAM (-2)

/**
 * A text is not UTF-8, or too long. ZTL_NODE_NAME limits the device's name and version. Each text of a component has at
 * most 64 bytes, and all of them together must fit into a frame; 101 bytes always do.
 */
#define ZTL_NODE_E_TEXT (-3)

/**
 * There are no components, or more than 255.
 */
#define ZTL_NODE_E_COUNT (-4)

/**
 * A component's `busy` or `loss` is not one of the values below.
 */
#define ZTL_NODE_E_POLICY (-5)

/**
 * From `check` or `start`: the goal is accepted.
 */
#define ZTL_NODE_TAKEN 0

/**
 * From `check` or `start`: the goal is refused. The report says what is wrong and what would be right;
 * nothing has moved.
 */
#define ZTL_NODE_REFUSED 1

/**
 * From `poll`: the task is running; the report is its progress.
 */
#define ZTL_NODE_RUNNING 0

/**
 * From `poll`: the goal is reached; the report is the result.
 */
#define ZTL_NODE_COMPLETED 1

/**
 * From `poll`: the goal will not be reached; the report says why.
 */
#define ZTL_NODE_FAILED 2

/**
 * From `poll`: the task has stopped after `abort`; the report says where.
 */
#define ZTL_NODE_ABORTED 3

/**
 * A component's `busy`: refuse a second task. A number from 1 to 255 instead: queue it, with at most that
 * many tasks waiting.
 */
#define ZTL_NODE_REFUSE 0

/**
 * A component's `busy`: a second task replaces the running one, which is aborted.
 */
#define ZTL_NODE_REPLACE (-1)

/**
 * A component's `loss`, what it does without its link, with or without a task: it is made safe, and a task fails.
 */
#define ZTL_NODE_LOSS_ABORT 0

/**
 * A component's `loss`: the same, but `make_safe` holds the position under power.
 */
#define ZTL_NODE_LOSS_HOLD 1

/**
 * A component's `loss`: it carries on: it finishes its task, or stays as it is.
 */
#define ZTL_NODE_LOSS_CARRY_ON 2

/**
 * Bytes of RAM of a node without its components and pointers: see ZTL_NODE_RAM.
 */
#define ZTL_NODE_RAM_BYTES 863

/**
 * Its pointers: see ZTL_NODE_RAM.
 */
#define ZTL_NODE_RAM_POINTERS 20

/**
 * The node end of the link. Call its functions from one context, preferably the main loop, and not from an
 * interrupt: pass received bytes through a queue. Callbacks must not call them.
 */
typedef struct ztl_node ztl_node;

/**
 * Receives a callback's progress, result, or reason to refuse. Valid during that call.
 */
typedef struct ztl_report ztl_report;

/**
 * Identity of a node. The firmware keeps its texts unchanged while the node exists.
 */
typedef struct {
    /**
     * What the device is called, ZTL_NODE_NAME bytes at most. Not NULL.
     */
    const char *name;
    /**
     * Version of its firmware, ZTL_NODE_NAME bytes at most. Not NULL.
     */
    const char *firmware;
    /**
     * Changes with each boot: random, or a counter that a reset does not clear.
     */
    unsigned int boot;
    /**
     * The link is lost after this many milliseconds without a new command, 50 to 60000; 0 means 1000.
     */
    unsigned int link_timeout_ms;
} ztl_identity;

/**
 * A part of the device that executes one task at a time. The firmware keeps it and everything it points to
 * unchanged while the node exists; a `static const` is best. The node calls its functions from within its
 * own. They must return quickly, because each is called between two bytes of the line.
 */
typedef struct {
    /**
     * Name that clients use. Not NULL.
     */
    const char *name;
    /**
     * Words that it accepts as goals, separated by spaces, or NULL. For information only.
     */
    const char *words;
    /**
     * Unit of the numbers that it accepts, or NULL. For information only.
     */
    const char *unit;
    /**
     * Names under which it publishes readings, separated by spaces, or NULL.
     */
    const char *topics;
    /**
     * Smallest number that it accepts; for information only.
     */
    float least;
    /**
     * Largest number that it accepts; equal to `least` if it accepts no numbers.
     */
    float most;
    /**
     * What happens to a second task: ZTL_NODE_REFUSE, ZTL_NODE_REPLACE, or how many may wait.
     */
    int busy;
    /**
     * What it does when the link is lost: one of ZTL_NODE_LOSS_....
     */
    int loss;
    /**
     * Interval between calls of `poll`, in milliseconds; 0 means 10.
     */
    unsigned int poll_ms;
    /**
     * Passed to each function; owned by the firmware, may be NULL.
     */
    void *context;
    /**
     * Checks a goal without moving anything: ZTL_NODE_TAKEN or ZTL_NODE_REFUSED. NULL accepts every goal,
     * which `start` may still refuse. The goal belongs to the library and is valid during the call.
     */
    int (*check)(void *context, const char *goal, ztl_report *why);
    /**
     * Starts a task whose goal was checked, while none is running: ZTL_NODE_TAKEN or ZTL_NODE_REFUSED. Not
     * NULL. The goal belongs to the library and is valid during the call.
     */
    int (*start)(void *context, unsigned int now_ms, const char *goal, ztl_report *why);
    /**
     * Advances the task and reports: ZTL_NODE_RUNNING, or its final state. After `make_safe` it is also called without a
     * task: ZTL_NODE_RUNNING then means that the safe state is not reached yet, ZTL_NODE_FAILED that it needs another
     * `make_safe`, any other value that it is reached. Further calls may follow and must leave the component safe. Not NULL.
     */
    int (*poll)(void *context, unsigned int now_ms, ztl_report *report);
    /**
     * Stops the task as soon as it is safe; a later `poll` returns ZTL_NODE_ABORTED. Not NULL.
     */
    void (*abort)(void *context, unsigned int now_ms);
    /**
     * Goes to the safe state, with or without a task, after a lost link or an emergency stop. If that takes time, `poll`
     * continues it: the node calls `poll` until it returns ZTL_NODE_ABORTED or ZTL_NODE_COMPLETED, which ends a task. If it
     * returns ZTL_NODE_FAILED, because a pin failed, the node calls `make_safe` again, every 50 ms. Not NULL.
     */
    void (*make_safe)(void *context, unsigned int now_ms);
    /**
     * Writes the next reading and the index of its topic, if one is due and fits. Returns the number of bytes, 0 for no
     * reading. The node calls it at most every 10 ms. `size` is the longest reading that a frame holds: drop a longer one,
     * because it can never be sent. NULL if it publishes nothing.
     */
    size_t (*reading)(void *context,
                      unsigned int now_ms,
                      unsigned char *topic,
                      unsigned char *buffer,
                      size_t size);
} ztl_component;

/**
 * Statistics of a node's line since boot; the counters wrap around.
 */
typedef struct {
    /**
     * Frames with a correct checksum.
     */
    unsigned int frames;
    /**
     * Frames dropped: damaged, of another session, or too long.
     */
    unsigned int errors;
    /**
     * Commands that were repeated: answered again, not executed again.
     */
    unsigned int repeats;
    /**
     * Commands dropped because they were out of sequence.
     */
    unsigned int out_of_sequence;
} ztl_counters;

/**
 * Bytes of RAM that a node with this many components needs. ZTL_NODE_RAM is the same at compile time.
 */
size_t ztl_node_size(size_t components);

/**
 * Creates a node in RAM that the firmware provides, with any alignment. The library owns this RAM while the
 * node is in use; there is nothing to free. All other arguments stay the firmware's and must stay unchanged.
 * Writes the node's address, or NULL on error: ZTL_NODE_E_NULL, _RAM, _TEXT, _COUNT, _POLICY.
 */
int ztl_node_init(ztl_node **node,
                  void *ram,
                  size_t size,
                  const ztl_identity *identity,
                  const ztl_component *components,
                  size_t count);

/**
 * Handles received bytes, in pieces of any length. The time is in milliseconds on any clock that may start
 * anywhere and wrap around, such as HAL_GetTick(). The bytes are not kept. Does nothing if the node or the
 * bytes are NULL; the same holds for all functions below.
 */
void ztl_node_receive(ztl_node *node,
                      unsigned int now_ms,
                      const unsigned char *bytes,
                      size_t count);

/**
 * Advances the components, and acts when the link is lost. Call it in every turn of the main loop.
 */
void ztl_node_run(ztl_node *node, unsigned int now_ms);

/**
 * Writes the next bytes to send into a buffer and returns their number. Call it after each ztl_node_receive
 * and ztl_node_run. It fills the buffer as long as there is data. If components always have readings, there
 * is always more; a main loop must not wait for the end.
 */
size_t ztl_node_send(ztl_node *node,
                     unsigned int now_ms,
                     unsigned char *buffer,
                     size_t size);

/**
 * Milliseconds until ztl_node_run, and then ztl_node_send, must be called if no byte arrives; 0 means now,
 * 1000 is the maximum (also for NULL).
 */
unsigned int ztl_node_wait(ztl_node *node,
                           unsigned int now_ms);

/**
 * Emergency stop: makes every component safe and aborts every task. No task starts until
 * ztl_node_clear_stop.
 */
void ztl_node_stop(ztl_node *node, unsigned int now_ms);

/**
 * Ends the emergency stop. Only the firmware can do this; the link has no command for it.
 */
void ztl_node_clear_stop(ztl_node *node);

/**
 * 1 if an emergency stop is in effect, else 0.
 */
int ztl_node_is_stopped(const ztl_node *node);

/**
 * Copies the statistics of the line.
 */
void ztl_node_counters(const ztl_node *node, ztl_counters *counters);

/**
 * Appends a copy of a text. What does not fit is cut, and the cut is marked. Does nothing if either is NULL
 * or the text is not UTF-8.
 */
void ztl_report_text(ztl_report *report,
                     const char *add);

/**
 * Appends an integer with a decimal point before its last `decimals` digits (at most 9): 455 with 1 gives
 * 45.5. Does nothing if the report is NULL.
 */
void ztl_report_number(ztl_report *report,
                       int value,
                       unsigned int decimals);

/**
 * Parses a number such as "45.5" and multiplies it by 10 to the power of `decimals` (at most 9): 455 with 1.
 * Returns 1 if it is a number that fits, else 0 and leaves `value` unchanged. Neither pointer may be NULL;
 * that also returns 0.
 */
int ztl_goal_number(const char *goal,
                    unsigned int decimals,
                    int *value);

/**
 * Bytes of RAM that suffice for a node with this many components: `static unsigned char ram[ZTL_NODE_RAM(2)];`.
 */
#define ZTL_NODE_RAM(components) \
    (ZTL_NODE_RAM_BYTES + (ZTL_NODE_RAM_POINTERS + (components)) * sizeof(void *))

#ifdef __cplusplus
}
#endif

#endif
