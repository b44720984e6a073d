"""As much of pyzmq as the original needs, over the shared object that ZTL_OLD_LIBZMQ names.

So that the original runs over a libzmq as old as a robot's, under the Python of today.
"""
import ctypes
import os
from ctypes import POINTER, byref, c_char_p, c_int, c_size_t, c_void_p

from . import error
from .error import ZMQError

_lib = ctypes.CDLL(os.environ["ZTL_OLD_LIBZMQ"], use_errno=True)
for _name, _result, _arguments in (
    ("zmq_version", None, [POINTER(c_int)] * 3),
    ("zmq_errno", c_int, []),
    ("zmq_strerror", c_char_p, [c_int]),
    ("zmq_ctx_new", c_void_p, []),
    ("zmq_socket", c_void_p, [c_void_p, c_int]),
    ("zmq_close", c_int, [c_void_p]),
    ("zmq_bind", c_int, [c_void_p, c_char_p]),
    ("zmq_connect", c_int, [c_void_p, c_char_p]),
    ("zmq_setsockopt", c_int, [c_void_p, c_int, c_void_p, c_size_t]),
    ("zmq_send", c_int, [c_void_p, c_char_p, c_size_t, c_int]),
    ("zmq_msg_init", c_int, [c_void_p]),
    ("zmq_msg_recv", c_int, [c_void_p, c_void_p, c_int]),
    ("zmq_msg_data", c_void_p, [c_void_p]),
    ("zmq_msg_size", c_size_t, [c_void_p]),
    ("zmq_msg_close", c_int, [c_void_p]),
):
    _function = getattr(_lib, _name)
    _function.restype, _function.argtypes = _result, _arguments

PUB, SUB, REQ, REP = 1, 2, 3, 4
LINGER, RCVTIMEO, SNDTIMEO = 17, 27, 28
SNDMORE = 2
EVENT_ACCEPTED, EVENT_DISCONNECTED = 0x20, 0x200


def zmq_version():
    parts = [c_int(), c_int(), c_int()]
    _lib.zmq_version(*map(byref, parts))
    return ".".join(str(part.value) for part in parts)


def _checked(result):
    if result is None or result == -1:
        number = _lib.zmq_errno()
        raise ZMQError(number, _lib.zmq_strerror(number).decode())
    return result


class Socket(object):
    def __init__(self, handle):
        self._handle = handle

    def bind(self, address):
        _checked(_lib.zmq_bind(self._handle, address.encode()))

    def connect(self, address):
        _checked(_lib.zmq_connect(self._handle, address.encode()))

    def setsockopt(self, option, value):
        value = c_int(value)
        _checked(_lib.zmq_setsockopt(self._handle, option, byref(value), ctypes.sizeof(value)))

    def send(self, data, flags=0):
        _checked(_lib.zmq_send(self._handle, data, len(data), flags))

    def recv(self):
        message = ctypes.create_string_buffer(64)
        _checked(_lib.zmq_msg_init(message))
        try:
            _checked(_lib.zmq_msg_recv(message, self._handle, 0))
            data, size = _lib.zmq_msg_data(message), _lib.zmq_msg_size(message)
            return ctypes.string_at(data, size)
        finally:
            _lib.zmq_msg_close(message)

    def close(self):
        _checked(_lib.zmq_close(self._handle))


class Context(object):
    def __init__(self):
        self._handle = _checked(_lib.zmq_ctx_new())

    def socket(self, kind):
        return Socket(_checked(_lib.zmq_socket(self._handle, kind)))
