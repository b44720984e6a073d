"""Prints what genpy knows of each installed type, one JSON object a line: md5 sum, full text, and random messages with
their bytes. The argument is the seed."""

import glob
import importlib
import io
import json
import os
import random
import struct
import sys

import genpy

RANGES = {
    "int8": (-128, 127), "byte": (-128, 127), "uint8": (0, 255), "char": (0, 255),
    "int16": (-(2**15), 2**15 - 1), "uint16": (0, 2**16 - 1),
    "int32": (-(2**31), 2**31 - 1), "uint32": (0, 2**32 - 1),
    "int64": (-(2**63), 2**63 - 1), "uint64": (0, 2**64 - 1),
}
TEXTS = ["", "a", "é€😀", "shoulder_pan_joint", "x" * 300, "line\nbreak\x00"]


def whole(name):
    low, high = RANGES[name]
    return random.choice([low, high, 0, random.randint(low, high)])


def scalar(name):
    """A value for genpy, and the same for JSON."""
    if name in RANGES:
        value = whole(name)
    elif name == "bool":
        value = random.random() < 0.5
    elif name == "string":
        value = random.choice(TEXTS)
    elif name in ("float32", "float64"):
        value = random.choice([0.0, -1.5, 1e30, random.uniform(-1e3, 1e3)])
        if name == "float32":
            value = struct.unpack("<f", struct.pack("<f", value))[0]
    elif name == "time":
        secs, nsecs = whole("uint32"), random.randrange(10**9)
        return genpy.Time(secs, nsecs), {"secs": secs, "nsecs": nsecs}
    elif name == "duration":
        # Without what genpy normalizes.
        secs, nsecs = random.randint(-(2**30), 2**30), random.randrange(10**9)
        return genpy.Duration(secs, nsecs), {"secs": secs, "nsecs": nsecs}
    else:
        return message(genpy.message.get_message_class(name))
    return value, value


def field(name):
    if "[" not in name:
        return scalar(name)
    base, length = name[:-1].split("[")
    count = int(length) if length else random.choice([0, 1, 3])
    pairs = [scalar(base) for _ in range(count)]
    values = [value for value, _ in pairs]
    if base in ("uint8", "char"):
        values = bytes(values)
    return values, [plain for _, plain in pairs]


def message(of):
    made, plain = of(), {}
    for name, kind in zip(of.__slots__, of._slot_types):
        value, plain[name] = field(kind)
        setattr(made, name, value)
    return made, plain


def samples(of):
    for _ in range(8):
        made, plain = message(of)
        buffer = io.BytesIO()
        made.serialize(buffer)
        yield {"bytes": buffer.getvalue().hex(), "value": plain}


def tell(kind, of, **more):
    told = {"kind": kind, "name": of._type, "md5": of._md5sum, **more}
    print(json.dumps(told))


def main():
    random.seed(int(sys.argv[1]))
    packages = {
        os.path.basename(os.path.dirname(directory))
        for path in sys.path
        for kind in ("msg", "srv")
        for directory in glob.glob(os.path.join(path, "*", kind))
    }
    for package in sorted(packages):
        for kind in ("msg", "srv"):
            try:
                module = importlib.import_module(f"{package}.{kind}")
            except ImportError:
                continue
            for name in sorted(vars(module)):
                of = getattr(module, name)
                if not isinstance(of, type):
                    continue
                if issubclass(of, genpy.Message) and kind == "msg":
                    tell("msg", of, text=of._full_text, samples=list(samples(of)))
                elif hasattr(of, "_request_class"):
                    halves = (of._request_class, of._response_class)
                    tell("srv", of, halves=[
                        {"name": half._type, "text": half._full_text, "samples": list(samples(half))} for half in halves
                    ])


main()
