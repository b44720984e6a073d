/*
 * The node end of ZTL's link for firmware in C: components by callbacks, bytes in and out by calls, the time as an argument.
 * No allocator, no operating system, no float, no interrupt of its own. docs/c.md shows a first one. This file is made from
 * ztl-node-c/src; the tests compare the two.
 *
 * Rules for all of it: one context calls its functions, best the main loop. Texts end with a zero. A pointer that is NULL
 * where that is not allowed changes nothing, and nothing crashes. Nothing is ever freed. Whatever bytes arrive, no
 * function fails: what is damaged is dropped and counted.
 */
#ifndef ZTL_NODE_H
#define ZTL_NODE_H


#include <stddef.h>

#ifdef __cplusplus
extern "C" {
#endif

/**
 * The interface that this header describes. It changes when firmware would have to be compiled anew.
 */
#define ZTL_NODE_ABI 1

/**
 * How many tasks a node holds, those included that have ended and whose end is not acknowledged.
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
 * Longest text that a component reports, in bytes; a reason to refuse may have twice as many. What is longer is cut,
 * and marked.
 */
#define ZTL_NODE_TEXT 48

/**
 * It is done.
 */
#define ZTL_NODE_OK 0

/**
 * A pointer is NULL that must not be, or a callback is lacking.
 */
#define ZTL_NODE_E_NULL (-1)

/**
 * There is less RAM than ztl_node_size says.
 */
#define ZTL_NODE_E_RAM (-2)

/**
 * A text is no UTF-8, or too long: ZTL_NODE_NAME says how long name and version of the device may be; of a component each text
 * has at most 64 bytes, and all of them together fit into a frame, which they do with 101.
 */
#define ZTL_NODE_E_TEXT (-3)

/**
 * There is no component, or there are more than 255.
 */
#define ZTL_NODE_E_COUNT (-4)

/**
 * A component's `busy` or `loss` is none of the numbers below.
 */
#define ZTL_NODE_E_POLICY (-5)

/**
 * From `check` or `start`: the goal is taken.
 */
#define ZTL_NODE_TAKEN 0

/**
 * From `check` or `start`: it is not, and the report says why, and what would be right. Nothing has moved.
 */
#define ZTL_NODE_REFUSED 1

/**
 * From `poll`: under way; the report is where it is now.
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
 * From `poll`: stopped after `abort`; the report is where.
 */
#define ZTL_NODE_ABORTED 3

/**
 * A component's `busy`: a second task is refused. A number from 1 to 255 instead: it waits for its turn,
 * behind at most so many.
 */
#define ZTL_NODE_REFUSE 0

/**
 * A component's `busy`: a second task takes the place of the one that runs, which is aborted.
 */
#define ZTL_NODE_REPLACE (-1)

/**
 * A component's `loss`, what it does without its link, with or without a task: it is made safe, and a task fails.
 */
#define ZTL_NODE_LOSS_ABORT 0

/**
 * The same, but `make_safe` keeps its position under power.
 */
#define ZTL_NODE_LOSS_HOLD 1

/**
 * It goes on: it finishes its task, or stays as it is.
 */
#define ZTL_NODE_LOSS_CARRY_ON 2

/**
 * Bytes of RAM of a node without its components and pointers: see ZTL_NODE_RAM.
 */
#define ZTL_NODE_RAM_BYTES 807

/**
 * Its pointers: see ZTL_NODE_RAM.
 */
#define ZTL_NODE_RAM_POINTERS 24

/**
 * The node end of the link. One context calls its functions, best the main loop, and no interrupt: what an interrupt
 * receives goes through a queue. Callbacks must not call them.
 */
typedef struct ztl_node ztl_node;

/**
 * Where a callback writes progress, result, or the reason to refuse. Valid for that call.
 */
typedef struct ztl_report ztl_report;

/**
 * Who a node is. Its texts stay the firmware's, unchanged for as long as there is the node.
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
     * Differs from boot to boot: random, or counted where a reset does not clear it.
     */
    unsigned int boot;
    /**
     * After how many milliseconds without a new command the node acts by itself, 50 to 60000; 0 is 1000.
     */
    unsigned int link_timeout_ms;
} ztl_identity;

/**
 * Something that carries out one task at a time. The firmware keeps it, and what it points to, unchanged for as long as
 * there is the node: best a `static const`. Its functions are called from within those of the node, and must
 * return soon: each is called between two bytes of the line.
 */
typedef struct {
    /**
     * As a client writes it. Not NULL.
     */
    const char *name;
    /**
     * Words that it takes as goals, with blanks between them; NULL when none. Only told to people.
     */
    const char *words;
    /**
     * Unit of the numbers that it takes; NULL when none. Only told to people.
     */
    const char *unit;
    /**
     * Names under which it publishes readings, with blanks between them; NULL when none.
     */
    const char *topics;
    /**
     * Smallest number that it takes; only told to people.
     */
    float least;
    /**
     * Greatest number that it takes; the same as `least` when it takes none.
     */
    float most;
    /**
     * What becomes of a second task: ZTL_NODE_REFUSE, ZTL_NODE_REPLACE, or how many may wait.
     */
    int busy;
    /**
     * What it does without its link: one of ZTL_NODE_LOSS_....
     */
    int loss;
    /**
     * How often `poll` is to be called, in milliseconds; 0 is 10.
     */
    unsigned int poll_ms;
    /**
     * Handed to each of the functions; the firmware's, may be NULL.
     */
    void *context;
    /**
     * Whether it takes a goal: ZTL_NODE_TAKEN or ZTL_NODE_REFUSED; moves nothing. NULL takes every goal, which `start` may
     * still refuse. The goal is the library's, and lasts for the call.
     */
    int (*check)(void *context, const char *goal, ztl_report *why);
    /**
     * Begins a task whose goal was checked, while none runs: ZTL_NODE_TAKEN or ZTL_NODE_REFUSED. Not NULL. The goal is the
     * library's, and lasts for the call.
     */
    int (*start)(void *context, unsigned int now_ms, const char *goal, ztl_report *why);
    /**
     * Moves the task on and reports: ZTL_NODE_RUNNING, or how it has ended. After `make_safe` also called without a task:
     * ZTL_NODE_RUNNING says that the safe state is not reached yet, anything else that it is; it may then be called some more
     * times, and must leave the component safe. Not NULL.
     */
    int (*poll)(void *context, unsigned int now_ms, ztl_report *report);
    /**
     * Stops the task as soon as it is safe; a later `poll` says ZTL_NODE_ABORTED. Not NULL.
     */
    void (*abort)(void *context, unsigned int now_ms);
    /**
     * Goes to the safe state, with or without a task: the link was lost, or an emergency stop. What cannot be done at once
     * goes on in `poll`, which is called until it says other than ZTL_NODE_RUNNING; a task ends then, whatever it says. Not
     * NULL.
     */
    void (*make_safe)(void *context, unsigned int now_ms);
    /**
     * Writes the next reading, if one is due and fits, and which of the topics it is, from 0; says how many bytes it
     * wrote, 0 for none. Asked for at most each 10 ms. The size is that of the longest reading that a frame holds: a longer one
     * can never be sent, so it is to be dropped. NULL when it publishes nothing.
     */
    size_t (*reading)(void *context,
                      unsigned int now_ms,
                      unsigned char *topic,
                      unsigned char *buffer,
                      size_t size);
} ztl_component;

/**
 * What a node has seen on its line since boot; the counts wrap.
 */
typedef struct {
    /**
     * Frames whose check was right.
     */
    unsigned int frames;
    /**
     * Frames dropped: damaged, of another session, too long.
     */
    unsigned int errors;
    /**
     * Commands answered again without being executed again.
     */
    unsigned int repeats;
    /**
     * Commands out of sequence, dropped.
     */
    unsigned int out_of_sequence;
} ztl_counters;

/**
 * How many bytes of RAM a node with so many components needs. ZTL_NODE_RAM says it to the compiler.
 */
size_t ztl_node_size(size_t components);

/**
 * Makes a node in RAM of the firmware's, which is the library's from now on, for as long as the node is used: there is
 * nothing to free. The RAM may have any alignment. What else is given stays the firmware's, and unchanged; see there.
 * Writes where the node is, NULL with any error: ZTL_NODE_E_NULL, _RAM, _TEXT, _COUNT, _POLICY.
 */
int ztl_node_init(ztl_node **node,
                  void *ram,
                  size_t size,
                  const ztl_identity *identity,
                  const ztl_component *components,
                  size_t count);

/**
 * Bytes have arrived, in pieces of any length, at a time in milliseconds by any clock: one that starts anywhere and
 * wraps, as HAL_GetTick(), will do. The bytes are not kept. Nothing happens when the node or they are NULL; so it is
 * with NULL everywhere below.
 */
void ztl_node_receive(ztl_node *node,
                      unsigned int now_ms,
                      const unsigned char *bytes,
                      size_t count);

/**
 * Time has passed: moves the components on, and acts when the link is lost. In every turn of the main loop.
 */
void ztl_node_run(ztl_node *node,
                  unsigned int now_ms);

/**
 * Writes the next bytes to be sent into a buffer, and says how many: it is full, or nothing more is to be sent now. After
 * each ztl_node_receive and ztl_node_run. Where components always have readings there is always something: a main loop
 * must not wait for the end of it.
 */
size_t ztl_node_send(ztl_node *node,
                     unsigned int now_ms,
                     unsigned char *buffer,
                     size_t size);

/**
 * After how many milliseconds ztl_node_run is to be called even if no byte arrives, and then ztl_node_send; 0 is at
 * once, 1000 the most (also for NULL).
 */
unsigned int ztl_node_wait(ztl_node *node,
                           unsigned int now_ms);

/**
 * Emergency stop: every component is made safe, every task ends as aborted, and no other starts until
 * ztl_node_clear_stop.
 */
void ztl_node_stop(ztl_node *node,
                   unsigned int now_ms);

/**
 * Ends the emergency stop. Only the firmware may: the link has no command for it.
 */
void ztl_node_clear_stop(ztl_node *node);

/**
 * 1 when there was an emergency stop that is not cleared, else 0.
 */
int ztl_node_is_stopped(const ztl_node *node);

/**
 * Writes what the line has brought.
 */
void ztl_node_counters(const ztl_node *node, ztl_counters *counters);

/**
 * Adds a text, which is copied; what does not fit is cut, and marked. Nothing happens when either is NULL, or
 * the text is no UTF-8.
 */
void ztl_report_text(ztl_report *report,
                     const char *add);

/**
 * Adds a whole number with the point before its last `decimals` digits (at most 9): 455 with one is 45.5.
 * Nothing happens when the report is NULL.
 */
void ztl_report_number(ztl_report *report,
                       int value,
                       unsigned int decimals);

/**
 * Reads a number, as "45.5", times 10 for each of `decimals` (at most 9): 455 with one. 1 when it is a number
 * that fits; else 0, and `value` is left as it is. Neither may be NULL, which is 0 too.
 */
int ztl_goal_number(const char *goal,
                    unsigned int decimals,
                    int *value);

/**
 * Bytes of RAM that are enough for a node with so many components, for `static unsigned char ram[ZTL_NODE_RAM(2)];`.
 */
#define ZTL_NODE_RAM(components) \
    (ZTL_NODE_RAM_BYTES + (ZTL_NODE_RAM_POINTERS + (components)) * sizeof(void *))

#ifdef __cplusplus
}
#endif

#endif
