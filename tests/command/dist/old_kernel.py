"""Runs a program as on an old Linux: system calls that it did not have fail with ENOSYS.

    python3 old_kernel.py 3.2 PROGRAM ARGUMENT...

It hides calls by their numbers; flags that are newer, and the bugs of old kernels, it does not.
"""
import ctypes
import os
import platform
import struct
import sys

# The highest number that a kernel had: on x86-64, and for 32-bit programs.
KERNELS = {"2.6.32": (298, 336), "3.2": (311, 348), "4.4": (325, 376)}

AUDIT_ARCH_X86_64, AUDIT_ARCH_I386 = 0xC000003E, 0x40000003
LOAD_WORD, IF_EQUAL, IF_GREATER, RETURN = 0x20, 0x15, 0x25, 0x06
ALLOW, ENOSYS = 0x7FFF0000, 0x00050000 | 38
NUMBER, ARCHITECTURE = 0, 4  # Their places in struct seccomp_data.
PR_SET_NO_NEW_PRIVS, PR_SET_SECCOMP, SECCOMP_MODE_FILTER = 38, 22, 2

if len(sys.argv) < 3 or sys.argv[1] not in KERNELS or platform.machine() != "x86_64":
    sys.exit("usage on x86-64: old_kernel.py %s PROGRAM..." % "|".join(KERNELS))
wide, narrow = KERNELS[sys.argv[1]]
program = [
    (LOAD_WORD, 0, 0, ARCHITECTURE),
    (IF_EQUAL, 0, 3, AUDIT_ARCH_X86_64),
    (LOAD_WORD, 0, 0, NUMBER),
    (IF_GREATER, 5, 0, wide),
    (RETURN, 0, 0, ALLOW),
    (IF_EQUAL, 0, 2, AUDIT_ARCH_I386),
    (LOAD_WORD, 0, 0, NUMBER),
    (IF_GREATER, 1, 0, narrow),
    (RETURN, 0, 0, ALLOW),
    (RETURN, 0, 0, ENOSYS),
]
code = b"".join(struct.pack("=HBBI", *step) for step in program)
steps = ctypes.create_string_buffer(code, len(code))


class Filter(ctypes.Structure):
    _fields_ = [("length", ctypes.c_ushort), ("steps", ctypes.c_void_p)]


libc = ctypes.CDLL(None, use_errno=True)
libc.prctl.argtypes = [ctypes.c_int] + [ctypes.c_ulong] * 4
chosen = Filter(len(program), ctypes.addressof(steps))
for request in (
    (PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0),
    (PR_SET_SECCOMP, SECCOMP_MODE_FILTER, ctypes.addressof(chosen), 0, 0),
):
    if libc.prctl(*request) != 0:
        sys.exit("prctl: " + os.strerror(ctypes.get_errno()))
try:
    # 334 on x86-64 came with Linux 4.18: without it, the filter is not there.
    libc.syscall(334, 0, 0, 0, 0)
    if ctypes.get_errno() != 38:
        sys.exit("the filter does not work")
    os.execvp(sys.argv[2], sys.argv[2:])
except OSError as error:
    sys.exit("%s: %s" % (sys.argv[2], error))
