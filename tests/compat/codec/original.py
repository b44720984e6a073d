"""Does with the original's codecs what the lines of stdin say, and answers each in JSON.

A line is a verb and its arguments in hexadecimal. Everything is read before anything is written,
so that nobody waits for anybody.
"""

import json
import sys
import unicodedata

from ztl.core.protocol import Message, Task


def number(field):
    """What `int` makes of a field, as the original's server does with `state` and `id`."""
    try:
        value = str(int(field))
    except ValueError:
        value = None
    foreign_digit = lambda c: not c.isascii() and unicodedata.decimal(c, None) is not None
    foreign_blank = lambda c: not c.isascii() and c.isspace()
    ascii = lambda c: (
        str(unicodedata.decimal(c)) if foreign_digit(c) else " " if foreign_blank(c) else c
    )
    kinds = {
        "digits of other alphabets": any(map(foreign_digit, field)),
        "blanks beyond ASCII": any(map(foreign_blank, field)),
    }
    return {
        "int": value,
        # The same field in ASCII, as far as such characters are concerned, and which they are.
        "ascii": "".join(map(ascii, field)),
        "kinds": [kind for kind, has in kinds.items() if has],
    }


def failure(error):
    return {"error": type(error).__name__, "text": str(error), "at": getattr(error, "start", None)}


def message_decode(wire):
    fields = Message.decode(wire)
    numbers = {name: number(fields[name]) for name in ("state", "id") if name in fields}
    return {"fields": fields, "numbers": numbers}


def message_encode(*fields):
    return {"bytes": Message.encode(*(field.decode() for field in fields)).hex()}


def task_decode(text):
    return {"fields": Task.decode(text.decode())}


def task_encode(*fields):
    return {"text": Task.encode(*(field.decode() for field in fields))}


def a_number(field):
    return {"numbers": {"field": number(field.decode())}}


VERBS = {
    verb.__name__: verb
    for verb in (message_decode, message_encode, task_decode, task_encode, a_number)
}


answers = []
for line in sys.stdin.read().splitlines():
    verb, *words = line.split(" ")
    try:
        answer = VERBS[verb](*map(bytes.fromhex, words))
    except ValueError as error:  # UnicodeDecodeError and binascii.Error are ValueErrors.
        answer = failure(error)
    answers.append(json.dumps(answer))
print("\n".join(answers))
