"""Makes random values with their pickles, and loads pickles, under Python 2.7 and 3.

`make SEED COUNT`: a line for each value: its canonical text, its repr in hexadecimal (empty if ours differs), and its
pickles in hexadecimal.
`large`: a line for each of some large values, with its pickles in hexadecimal.
`load`: for each line on stdin, a pickle and its JSON (which may be missing), the canonical text of the value.
"""

import collections
import datetime
import json
import math
import pickle
import pickletools
import random
import struct
import sys
from binascii import hexlify, unhexlify

import numpy

OLD = sys.version_info[0] < 3
if OLD:
    text_type, integers, to_char, as_bytes = unicode, (int, long), unichr, str  # noqa: F821
else:
    text_type, integers, to_char, as_bytes = str, (int,), chr, bytes


def hexed(data):
    return hexlify(data).decode("ascii")


def utf8(text):
    return text.encode("utf-8") if OLD else text.encode("utf-8", "surrogatepass")


# Canonical text: types, order and identity of what may change.


def canon(value, made, seen=None):
    """`made` if this Python made it: its own strings are then text or bytes as our reader sees them.

    What was loaded has lost the byte order, which numpy changes to its own now and then.
    """
    seen = {} if seen is None else seen
    if isinstance(value, (list, dict, set, bytearray)):
        if id(value) in seen:
            return "@%d" % seen[id(value)]
        seen[id(value)] = len(seen)

    def each(items):
        return ",".join(canon(item, made, seen) for item in items)

    if value is None:
        return "N"
    if isinstance(value, numpy.generic):
        # An empty text has a byte too many here.
        data = value.tobytes()[: value.dtype.itemsize]
        return "n(%s %s)" % (order(value.dtype), hexed(data))
    if isinstance(value, bool):
        return str(value)
    if isinstance(value, integers):
        return "i%d" % value
    if isinstance(value, float):
        return "f" + ("nan" if value != value else hexed(struct.pack(">d", value)))
    if isinstance(value, text_type):
        return "s" + hexed(utf8(value))
    if isinstance(value, bytearray):
        return "a" + hexed(bytes(value))
    if isinstance(value, as_bytes):
        is_text = OLD and made and all(ord(c) < 128 for c in value)
        return ("s" if is_text else "b") + hexed(value)
    if isinstance(value, list):
        return "[" + each(value) + "]"
    if isinstance(value, tuple):
        return "(" + each(value) + ")"
    if isinstance(value, (set, frozenset)):
        items = sorted(canon(item, made, seen) for item in value)
        return ("S" if isinstance(value, set) else "F") + "{" + ",".join(items) + "}"
    if isinstance(value, dict):
        is_ordered = isinstance(value, collections.OrderedDict)
        entries = [(canon(key, made, seen), item) for key, item in value.items()]
        if OLD and not made and not is_ordered:
            entries.sort(key=lambda entry: entry[0])
        text = ",".join(key + ":" + canon(item, made, seen) for key, item in entries)
        return ("O{" if is_ordered else "D{") + text + "}"
    if isinstance(value, numpy.ndarray):
        if not made and value.dtype.str.startswith(">"):
            value = value.byteswap().view(value.dtype.newbyteorder("<"))
        fortran = value.flags.f_contiguous and not value.flags.c_contiguous
        data = hexed(value.tobytes("F" if fortran else "C"))
        return "A(%s %s %s %s)" % (order(value.dtype), list(value.shape), int(fortran), data)
    if isinstance(value, numpy.dtype):
        return "t" + (order(value) if made else order(value).replace(">", "<"))
    if isinstance(value, datetime.datetime):
        return "d(%s %s)" % (day(value), clock(value))
    if isinstance(value, datetime.date):
        return "d(%s)" % day(value)
    if isinstance(value, datetime.time):
        return "d(%s)" % clock(value)
    if isinstance(value, datetime.timedelta):
        return delta(value)
    return zone(value)


def order(dtype):
    return dtype.str


def day(value):
    return "%d-%d-%d" % (value.year, value.month, value.day)


def clock(value):
    fields = (value.hour, value.minute, value.second, value.microsecond, getattr(value, "fold", 0))
    return "%d:%d:%d.%d/%d" % fields + (zone(value.tzinfo) if value.tzinfo else "")


def delta(value):
    return "d(%d,%d,%d)" % (value.days, value.seconds, value.microseconds)


def zone(value):
    name = value.__reduce__()[1][1:]
    return "z(%s%s)" % (delta(value.utcoffset(None)), "".join(" " + hexed(utf8(part)) for part in name))


# What JSON means, unless the value is ambiguous.


def plain(value):
    if value is None or isinstance(value, bool):
        return value
    if isinstance(value, str):
        # Pairs of surrogates are characters.
        return value.encode("utf-16", "surrogatepass").decode("utf-16", "surrogatepass")
    if isinstance(value, numpy.generic):
        return plain(numpy.asarray(value))
    if isinstance(value, int):
        return value
    if isinstance(value, float):
        names = {math.inf: "Infinity", -math.inf: "-Infinity"}
        return "NaN" if value != value else names.get(value, value)
    if isinstance(value, complex):
        return [plain(value.real), plain(value.imag)]
    if isinstance(value, (bytes, bytearray)):
        import base64

        return {"base64": base64.b64encode(value).decode()}
    if isinstance(value, (list, tuple, set, frozenset)):
        return [plain(item) for item in value]
    if isinstance(value, dict):
        return {plain(key): plain(item) for key, item in value.items()}
    if isinstance(value, numpy.ndarray):
        return plain(value.tolist())
    if isinstance(value, numpy.dtype):
        return value.name if value.isnative and value.kind not in "SU" else value.str
    if isinstance(value, datetime.timedelta):
        return value.total_seconds()
    if isinstance(value, datetime.timezone):
        return value.utcoffset(None).total_seconds()
    return value.isoformat()


def is_ambiguous(value):
    """Whether it has keys that are no strings, which JSON has as text, or sets, whose order changes."""
    if isinstance(value, dict):
        return any(not isinstance(key, str) or is_ambiguous(item) for key, item in value.items())
    if isinstance(value, (set, frozenset)):
        return len(value) > 1 or any(map(is_ambiguous, value))
    return isinstance(value, (list, tuple)) and any(map(is_ambiguous, value))


# Random values.


def a_text(r):
    pools = ["abc xyz", "'\"\\\n\r\t\0\x7f", u"\xe4\xff\xa0\xad\u20ac\u2028\u200b\ufeff\U0001f916\U000e0001"]
    if not OLD:
        pools.append("\ud800\udc00\udfffa'\"\\")
    pool = r.choice(pools)
    length = r.choice([0, 1, 2, 5, 20]) if r.random() < 0.997 else r.choice([255, 256, 70000])
    return text_type("").join(r.choice(pool) for _ in range(length))


def an_int(r):
    bits = r.choice([1, 4, 8, 9, 15, 16, 17, 29, 30, 31, 32, 33, 62, 63, 64, 65, 100, 500, 2040, 2100])
    edge = r.choice([-1, 0, 1]) + (1 << bits)
    return r.choice([1, -1]) * (edge if r.random() < 0.3 else r.getrandbits(bits))


def a_float(r):
    special = [0.0, -0.0, 1.0, 1e16, 1e15, 1e-5, 1e-4, 0.1, float("inf"), -float("inf"), float("nan"), 5e-324, 1.8e308]
    if r.random() < 0.4:
        return r.choice(special)
    return struct.unpack(">d", struct.pack(">Q", r.getrandbits(64)))[0] if r.random() < 0.5 else r.uniform(-1000, 1000)


def some_bytes(r):
    length = r.choice([0, 1, 2, 9, 30]) if r.random() < 0.997 else r.choice([255, 256, 70000])
    return bytes(bytearray(r.getrandbits(8) if r.random() < 0.5 else r.choice(b"ab'") and 98 for _ in range(length)))


DTYPES = "b1 i1 i2 i4 i8 u1 u2 u4 u8 f2 f4 f8 c8 c16 S5 U3 S0".split()


def a_dtype(r):
    return numpy.dtype(r.choice("<>") + r.choice(DTYPES))


def an_array(r):
    shape = r.choice([(), (0,), (1,), (3,), (2, 3), (3, 0, 2), (2, 2, 2), (4, 1), (1, 1, 3)])
    dtype = a_dtype(r)
    count = int(numpy.prod(shape))
    if dtype.kind == "U":
        array = numpy.array([text_type(r.choice(["", "a", u"\xe4\u20ac", "xyz"])) for _ in range(count)], dtype)
    elif dtype.kind == "b":
        array = numpy.array([r.random() < 0.5 for _ in range(count)], dtype)
    else:
        array = numpy.frombuffer(bytes(bytearray(r.getrandbits(8) for _ in range(count * dtype.itemsize))), dtype) \
            if dtype.itemsize else numpy.zeros(count, dtype)
    array = array.reshape(shape)
    kind = r.randrange(4)
    if kind == 0:
        return numpy.asfortranarray(array)
    if kind == 1:
        return array[::-1] if shape else array.copy()
    return array.copy() if kind == 2 else array


def a_zone(r):
    offset = datetime.timedelta(minutes=r.randrange(-1439, 1440))
    if r.random() < 0.3:
        offset = datetime.timedelta(r.choice([0, -1]), r.randrange(1, 86400), r.choice([0, r.randrange(10 ** 6)]))
    name = [r.choice(["UTC", "it's", u"\xe4"])] if r.random() < 0.3 else []
    return r.choice([datetime.timezone.utc, datetime.timezone(offset, *name)])


def a_time(r):
    kind = r.randrange(4 if OLD else 5)
    if kind == 0:
        return datetime.timedelta(r.choice([0, 1, -1, 999999999, -999999999]), r.choice([0, 1, 86399]), r.choice([0, 1, 999999]))
    date = datetime.date(r.choice([1, 1970, 2024, 9999]), r.choice([1, 2, 12]), r.randrange(1, 29))
    if kind == 1:
        return date
    if kind == 4:
        return a_zone(r)
    fields = [r.randrange(24), r.randrange(60), r.choice([0, 59]), r.choice([0, 1, 999999])]
    zones = [] if OLD or r.random() < 0.5 else [a_zone(r)]
    time = datetime.time(*(fields + zones))
    if kind == 2:
        time = datetime.datetime.combine(date, time)
    return time if OLD or r.random() < 0.9 else time.replace(fold=1)


def a_key(r, depth):
    kind = r.randrange(12)
    if kind < 4:
        return a_text(r)[:300]
    if kind < 6:
        return r.choice([0, 1, True, False, 1.0, 2, 2.0, -1, 10 ** 20, 1e20, numpy.int64(2), numpy.float32(1)])
    if kind == 6:
        return tuple(a_key(r, depth - 1) for _ in range(r.randrange(3))) if depth > 0 else ()
    if kind == 7:
        return frozenset(a_key(r, depth - 1) for _ in range(r.randrange(4))) if depth > 0 else frozenset()
    # To Python 2, ASCII bytes and text are equal.
    makers = [lambda: None, lambda: b"\xff" + some_bytes(r)[:300], lambda: an_int(r), lambda: a_float(r), lambda: a_time(r)]
    return r.choice(makers)()


def a_value(r, depth, known):
    kind = r.randrange(30)
    if depth <= 0 or kind < 11:
        makers = [lambda: None, lambda: r.random() < 0.5, lambda: an_int(r), lambda: a_float(r), lambda: a_text(r),
                  lambda: some_bytes(r), lambda: bytearray(some_bytes(r)), lambda: a_time(r)]
        return r.choice(makers)()
    if kind == 11:
        return an_array(r)
    if kind == 12:
        array = an_array(r)
        return array.flat[0] if array.size else a_dtype(r)
    if kind in (13, 14) and known:
        # Shared, or itself.
        return r.choice(known)
    count = r.choice([0, 1, 2, 3, 4, 6]) if r.random() < 0.998 else 1500
    deeper = depth - 1 if count < 100 else 0
    if kind < 20:
        value = []
        known.append(value)
        value.extend(a_value(r, deeper, known) for _ in range(count))
    elif kind < 23:
        value = tuple(a_value(r, deeper, known) for _ in range(count))
        known.append(value)
    elif kind == 23:
        value = set(a_key(r, 1) for _ in range(count))
        known.append(value)
    elif kind == 24:
        value = frozenset(a_key(r, 1) for _ in range(count))
    else:
        value = collections.OrderedDict() if kind == 25 else {}
        known.append(value)
        for _ in range(count):
            value[a_key(r, 2)] = a_value(r, deeper, known)
    return value


# Our repr of arrays is on one line; before Python 3.12, that of an OrderedDict differed.
OTHER_REPR = ("array(", "np.", "OrderedDict(", "dtype(")


def is_within_itself(value, outer=()):
    """Whether an OrderedDict contains itself."""
    if id(value) in outer:
        return isinstance(value, collections.OrderedDict)
    if isinstance(value, dict):
        parts = list(value.keys()) + list(value.values())
    elif isinstance(value, (list, tuple, set, frozenset)):
        parts = value
    else:
        return False
    return any(is_within_itself(part, outer + (id(value),)) for part in parts)


def pickles(value):
    # Older ones lose it.
    has_fold = not OLD and "fold=1" in repr(value)
    protocols = range(3) if OLD else range(4 if has_fold else 0, 6)
    yield pickle.dumps(value, max(protocols))
    for protocol in protocols:
        if OLD:
            import cPickle

            yield cPickle.dumps(value, protocol)
            yield pickle.dumps(value, protocol)
        else:
            data = pickle.dumps(value, protocol)
            yield data
            yield pickletools.optimize(data)
            # In protocol 5, it forgets to keep what it remembers of arrays.
            if protocol < 5:
                yield pickle._dumps(value, protocol)


def make(seed, count):
    r = random.Random(seed)
    for _ in range(count):
        value = a_value(r, r.randrange(5), [])
        text = "" if OLD else repr(value)
        shown = "" if any(other in text for other in OTHER_REPR) else hexed(utf8(text))
        # Python 2 cannot write it: the recursion ends with an error, or with a crash if NumPy meets that.
        if OLD and is_within_itself(value):
            continue
        found = list(pickles(value))
        # All protocols of small values, one of large ones.
        if len(found[0]) > 5000:
            found = [r.choice(found)]
        print("\t".join([canon(value, True), shown] + [hexed(data) for data in found]))


def large():
    """Values that take much memory for their length, in every protocol."""
    n = 40000
    values = [
        list(range(n)),
        [[] for _ in range(n)],
        [[1] for _ in range(n)],
        [(1,) for _ in range(n)],
        [{} for _ in range(n)],
        [(i, i) for i in range(n)],
        {i: None for i in range(n)},
        {i: i for i in range(n)},
        {str(i): 1.5 for i in range(n)},
        {(i, i + 1): i for i in range(n)},
        {(str(i),): [] for i in range(n)},
        set(range(n)),
        set(range(200)) | {str(i) for i in range(n)},
        [{"x": 1, "y": 2} for _ in range(n)],
        ["" for _ in range(n)] + [str(i) for i in range(n)],
        [True, None] * n,
        [numpy.float64(i) for i in range(n // 10)],
        [frozenset([i]) for i in range(n)],
        {frozenset([i]): i for i in range(n)},
        collections.OrderedDict((i, i) for i in range(n)),
        [bytes([i % 256]) for i in range(n)],
        [datetime.date.fromordinal(i + 1) for i in range(n)],
        numpy.zeros(n),
    ]
    for value in values:
        print("\t".join(hexed(pickle.dumps(value, protocol)) for protocol in range(6)))


def load():
    for line in sys.stdin.read().splitlines():
        data, found = [unhexlify(part) for part in line.split("\t")]
        value = pickle.loads(data)
        if found:
            found = json.loads(found.decode("utf-8"))
            if not is_ambiguous(value):
                assert same(found, plain(value)), (value, found)
        print(canon(value, False))


def same(one, other):
    if type(one) is not type(other):
        return False
    if isinstance(one, list):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, dict):
        return list(one) == list(other) and all(map(same, one.values(), other.values()))
    return one == other


# Numbers of any size.
getattr(sys, "set_int_max_str_digits", lambda digits: None)(0)
if sys.argv[1] == "make":
    make(int(sys.argv[2]), int(sys.argv[3]))
elif sys.argv[1] == "large":
    large()
else:
    load()
