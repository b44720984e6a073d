/*
 * The desk robot: a moving stage and a lamp, independent of board and link. The same file runs on a Cortex-M3 (lm3s6965evb.c)
 * and in a program on the host (desk.c).
 */
#include "robot.h"

/* Tenths of a millimetre per second. */
#define SPEED 200
#define LONGEST 1000

/* Positions are in tenths of a millimetre. */
struct stage {
    int place;
    int goal;
    unsigned int last_ms;
    int stopped;
};

static struct stage stage;

static int same(const char *a, const char *b)
{
    while (*a != '\0' && *a == *b) {
        a++;
        b++;
    }
    return *a == *b;
}

static void tell(const struct stage *it, ztl_report *report)
{
    ztl_report_number(report, it->place, 1);
    ztl_report_text(report, " mm");
}

static int stage_check(void *context, const char *goal, ztl_report *why)
{
    int place;

    (void)context;
    if (ztl_goal_number(goal, 1, &place) && place >= 0 && place <= LONGEST)
        return ZTL_NODE_TAKEN;
    ztl_report_text(why, "stage takes 0 to 100 mm");
    return ZTL_NODE_REFUSED;
}

static int stage_start(void *context, unsigned int now_ms, const char *goal, ztl_report *why)
{
    struct stage *it = (struct stage *)context;

    (void)why;
    ztl_goal_number(goal, 1, &it->goal);
    it->last_ms = now_ms;
    it->stopped = 0;
    return ZTL_NODE_TAKEN;
}

static int stage_poll(void *context, unsigned int now_ms, ztl_report *report)
{
    struct stage *it = (struct stage *)context;
    int way = it->goal - it->place;
    int most = way != 0 ? (int)(now_ms - it->last_ms) * SPEED / 1000 : 0;

    if (most > 0) {
        it->last_ms = now_ms;
        it->place += way > most ? most : way < -most ? -most : way;
        board_place(it->place);
    }
    tell(it, report);
    if (it->stopped)
        return ZTL_NODE_ABORTED;
    return it->place == it->goal ? ZTL_NODE_COMPLETED : ZTL_NODE_RUNNING;
}

static void stage_stop(void *context, unsigned int now_ms)
{
    struct stage *it = (struct stage *)context;

    (void)now_ms;
    it->goal = it->place;
    it->stopped = 1;
}

static int lamp_check(void *context, const char *goal, ztl_report *why)
{
    (void)context;
    if (same(goal, "on") || same(goal, "off"))
        return ZTL_NODE_TAKEN;
    ztl_report_text(why, "lamp takes on or off");
    return ZTL_NODE_REFUSED;
}

static int lit;

static int lamp_start(void *context, unsigned int now_ms, const char *goal, ztl_report *why)
{
    (void)now_ms;
    (void)why;
    *(int *)context = same(goal, "on");
    board_lamp(*(int *)context);
    return ZTL_NODE_TAKEN;
}

static int lamp_poll(void *context, unsigned int now_ms, ztl_report *report)
{
    (void)now_ms;
    ztl_report_text(report, *(int *)context ? "on" : "off");
    return ZTL_NODE_COMPLETED;
}

static void lamp_abort(void *context, unsigned int now_ms)
{
    (void)context;
    (void)now_ms;
}

static void lamp_off(void *context, unsigned int now_ms)
{
    (void)now_ms;
    *(int *)context = 0;
    board_lamp(0);
}

const ztl_component robot_components[ROBOT_COMPONENTS] = {
    {"stage", NULL, "mm", NULL, 0, 100, ZTL_NODE_REFUSE, ZTL_NODE_LOSS_ABORT, 10, &stage,
     stage_check, stage_start, stage_poll, stage_stop, stage_stop, NULL},
    {"lamp", "on off", NULL, NULL, 0, 0, ZTL_NODE_REFUSE, ZTL_NODE_LOSS_CARRY_ON, 0, &lit,
     lamp_check, lamp_start, lamp_poll, lamp_abort, lamp_off, NULL}
};
