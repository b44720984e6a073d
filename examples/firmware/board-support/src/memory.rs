//! `memcpy` and `memset`, small.
//!
//! Those of the compiler are optimised for speed and take 1 KiB of flash on a Cortex-M0. This firmware copies only a few
//! dozen bytes at a time; a byte takes 8 cycles here.

use core::arch::global_asm;

// The linker uses the compiler's versions only if the program defines none. `__aeabi_memset` has its last two arguments
// swapped.
global_asm!(
    ".macro function name",
    ".global \\name",
    ".type \\name, %function",
    ".thumb_func",
    "\\name:",
    ".endm",
    ".section .text.memory, \"ax\", %progbits",
    "function __aeabi_memcpy",
    "function __aeabi_memcpy4",
    "function __aeabi_memcpy8",
    "function memcpy",
    "push {{r0, r4, lr}}",
    "movs r3, #0",
    "b 2f",
    "1: ldrb r4, [r1, r3]",
    "strb r4, [r0, r3]",
    "adds r3, #1",
    "2: cmp r3, r2",
    "bne 1b",
    "pop {{r0, r4, pc}}",
    ".size memcpy, . - memcpy",
    "function __aeabi_memclr",
    "function __aeabi_memclr4",
    "function __aeabi_memclr8",
    "movs r2, #0",
    "function __aeabi_memset",
    "function __aeabi_memset4",
    "function __aeabi_memset8",
    "mov r3, r1",
    "mov r1, r2",
    "mov r2, r3",
    "function memset",
    "push {{r0, lr}}",
    "b 2f",
    "1: subs r2, #1",
    "strb r1, [r0, r2]",
    "2: cmp r2, #0",
    "bne 1b",
    "pop {{r0, pc}}",
    ".size memset, . - memset",
    ".purgem function",
);
