/*
 * The desk robot on a Stellaris LM3S6965 board (Cortex-M3), with no library but ZTL. In QEMU:
 *
 *   cargo xtask c thumbv7m-none-eabi
 *   arm-none-eabi-gcc -mcpu=cortex-m3 -mthumb -Os -ffreestanding -nostdlib -T lm3s6965evb.ld lm3s6965evb.c robot.c \
 *       -I../../../target/c/thumbv7m-none-eabi/include ../../../target/c/thumbv7m-none-eabi/lib/libztl_node.a -lgcc -o robot.elf
 *   qemu-system-arm -M lm3s6965evb -nographic -monitor none -serial tcp:127.0.0.1:5555,server=on,wait=off,nodelay=on \
 *       -kernel robot.elf
 *   ztl gateway -d desk=tcp:127.0.0.1:5555 -p 12345 -s /lab
 *   ztl task-client -r localhost -p 12345 -s /lab desk:stage:12.5
 */
#include "robot.h"

#define REGISTER(address) (*(volatile unsigned int *)(address))

/* The first UART, a PL011. */
#define UART_DATA REGISTER(0x4000C000)
#define UART_FLAGS REGISTER(0x4000C018)
#define UART_BAUD_WHOLE REGISTER(0x4000C024)
#define UART_BAUD_PART REGISTER(0x4000C028)
#define UART_LINE REGISTER(0x4000C02C)
#define UART_CONTROL REGISTER(0x4000C030)
#define UART_INTERRUPTS REGISTER(0x4000C038)
#define UART_CLEAR REGISTER(0x4000C044)
#define NOTHING_RECEIVED (1u << 4)
#define NO_ROOM (1u << 5)
#define ON_RECEIVED (1u << 4 | 1u << 6)
#define UART_INTERRUPT 5

#define TICK_CONTROL REGISTER(0xE000E010)
#define TICK_RELOAD REGISTER(0xE000E014)
#define TICK_NOW REGISTER(0xE000E018)
#define INTERRUPTS_ON REGISTER(0xE000E100)

/* Cycles per millisecond after a reset, in QEMU. */
#define CYCLES 12500u

#ifdef __cplusplus
extern "C" {
#endif

/* The board's pins. A test sets and reads them from outside and relies on their order. */
volatile unsigned int PANEL[6];
#define STOP_PRESSED PANEL[1]
#define RESUME_PRESSED PANEL[2]
#define PLACE PANEL[4]
#define LAMP PANEL[5]

void board_place(int tenths)
{
    PLACE = (unsigned int)tenths;
}

void board_lamp(int on)
{
    LAMP = (unsigned int)on;
}

static volatile unsigned int millis;

static void on_tick(void)
{
    millis++;
}

/* A queue from the interrupt to the main loop; each of the two counters has one writer. */
#define ROOM 256u
static volatile unsigned char received[ROOM];
static volatile unsigned int put, taken;

static void on_uart(void)
{
    UART_CLEAR = ON_RECEIVED;
    while (!(UART_FLAGS & NOTHING_RECEIVED)) {
        unsigned char byte = (unsigned char)UART_DATA;
        /* Bytes that do not fit are lost; the link detects this and resends. */
        if (put - taken < ROOM) {
            received[put % ROOM] = byte;
            put++;
        }
    }
}

static void start_board(void)
{
    UART_BAUD_WHOLE = 6;
    UART_BAUD_PART = 50;
    UART_LINE = 3u << 5 | 1u << 4;
    UART_CONTROL = 1u | 1u << 8 | 1u << 9;
    UART_INTERRUPTS = ON_RECEIVED;
    INTERRUPTS_ON = 1u << UART_INTERRUPT;
    TICK_RELOAD = CYCLES - 1;
    TICK_NOW = 0;
    TICK_CONTROL = 7;
}

/* Survives a reset and changes with each boot. */
static unsigned int boots __attribute__((section(".noinit")));

static unsigned char ram[ZTL_NODE_RAM(ROBOT_COMPONENTS)];

static void run(void)
{
    ztl_identity identity = {"desk", "1.0.0", 0, 0};
    unsigned char byte, out[64];
    size_t count = 0, sent = 0;
    ztl_node *node;

    identity.boot = ++boots;
    start_board();
    if (ztl_node_init(&node, ram, sizeof ram, &identity, robot_components, ROBOT_COMPONENTS) != ZTL_NODE_OK)
        return;
    for (;;) {
        if (STOP_PRESSED)
            ztl_node_stop(node, millis);
        else if (RESUME_PRESSED)
            ztl_node_clear_stop(node);
        while (taken != put) {
            byte = received[taken % ROOM];
            taken++;
            ztl_node_receive(node, millis, &byte, 1);
        }
        ztl_node_run(node, millis);
        if (sent == count) {
            count = ztl_node_send(node, millis, out, sizeof out);
            sent = 0;
        }
        while (sent < count && !(UART_FLAGS & NO_ROOM))
            UART_DATA = out[sent++];
        /* Sleep until a byte arrives or the next millisecond begins. */
        if (sent == count)
            __asm__ volatile("wfi");
    }
}

/* Defined in lm3s6965evb.ld. */
extern unsigned int data_begin, data_end, data_kept, bss_begin, bss_end;
extern void _stack_start(void);

static void on_reset(void)
{
    volatile unsigned int *to, *from;

    for (to = &data_begin, from = &data_kept; to < &data_end;)
        *to++ = *from++;
    for (to = &bss_begin; to < &bss_end;)
        *to++ = 0;
    run();
    for (;;)
        continue;
}

static void on_fault(void)
{
    /* Reset: the gateway then reports the tasks that were running. */
    REGISTER(0xE000ED0C) = 0x05FA0004;
    for (;;)
        continue;
}

typedef void (*vector)(void);
extern const vector vectors[16 + UART_INTERRUPT + 1];
const vector vectors[16 + UART_INTERRUPT + 1] __attribute__((section(".vectors"), used)) = {
    _stack_start, on_reset, on_fault, on_fault, on_fault, on_fault, on_fault, 0, 0, 0, 0, on_fault, on_fault, 0, on_fault, on_tick,
    on_fault, on_fault, on_fault, on_fault, on_fault, on_uart
};

#ifdef __cplusplus
}
#endif
