"""Values, and what Python and its YAML make of them; or what they read from given texts.

    generate.py values SEED COUNT     a line of JSON for each of COUNT values
    generate.py read                  for each line on stdin, a JSON pair of "python" or "yaml" and
                                      a text, a line of JSON with the value or null
"""
import ast
import json
import random
import re
import sys
import unicodedata

import yaml

WORDS = """
left right a x hello,\\ world it's say\\ "hi" '"' None null ~ True true yes no on off y n inf -inf nan
.inf .nan 1 -1 1.5 1e3 1e5 1.0e16 0x1F 0o17 0X1F 0b1 010 08 1_000 1__0 1:30 2020-01-01 = << ... --- - ? :
# * & ! | > % @ ` { } [ ] , a:b a:\\ b :a a: a#b a\\ #b #a -a ?a -\\ a (a) :( f(x) (a,\\ b) b'x' b"x" 'a' "a"
'' "" \\\\ C:\\\\temp \\\\n \\\\x41 \\\\' a\\\\ a'b"c \\  \\ a a\\  a\\ \\ b
""".split("\n")


def words():
    """The list above, in which a backslash keeps the next character in the word."""
    word = ""
    for line in WORDS:
        rest = iter(line + " ")
        for c in rest:
            if c == "\\":
                word += next(rest)
            elif c == " ":
                if word:
                    yield word
                word = ""
            else:
                word += c


WORDS = list(words()) + ["", " ", "\n", "a\nb", "a\n\n b", "a \nb", "\ta", "a\tb", "\r", "a\r\nb", "\0", "\x1b", "\x7f"]
WORDS += ["\x85", "a\x85b", "\xa0", "\xad", "\u200b", "\u2028", "a\u2029b", "\ufeff", "\ue000", "\U000e0001"]
WORDS += ["é", "e\u0301", "Grüße 世界", "🤖", "👩‍🚀", "x" * 130, "word " * 40]
FLOATS = [0.0, -0.0, 0.1, 1.0, -1.5, 1e-4, 1e-5, 123456.789, 1e15, 1e16, 1e17, 1.2345678901234568e17]
FLOATS += [5e-324, 2.2250738585072014e-308, 1.7976931348623157e308, 2.0**-25, 2.0**-44, 2.0**63, float("inf")]
WILD = r"""[\\()]|^[bB]['"]|^[-+]?(None|inf|nan|0[oOXB].*|[\d._]+[eE].*)$"""
WILD_KEY = re.compile(WILD + r"|^$|[\n\x85\u2028\u2029]|.{100}")
WILD = re.compile(WILD)
INTS = [0, 1, -1, 7, 2**31, 2**53 + 1, 2**63 - 1, 2**63, -(2**63), 2**64 - 1]


class Generator:
    def __init__(self, seed):
        self.random = random.Random(seed)
        # Whether there may be texts that are read differently on purpose. If there always were,
        # few values would be left.
        self.wild = True

    def text(self, wild=WILD):
        while True:
            text = self.any_text()
            if self.wild or not wild.search(text):
                return text

    def any_text(self):
        random = self.random
        kind = random.random()
        if kind < 0.4:
            return random.choice(WORDS)
        if kind < 0.6:
            return "".join(random.choice("ab '\"\\,:#-[]{}()\n\t0e.") for _ in range(random.randrange(12)))
        if kind < 0.8:
            return "".join(chr(random.randrange(32, 127)) for _ in range(random.randrange(12)))
        return "".join(self.char() for _ in range(random.randrange(8)))

    def char(self):
        while True:
            c = chr(self.random.randrange(self.random.choice([0x100, 0x3000, 0x11_0000])))
            # Surrogates cannot be sent; what is not assigned yet is printable to a newer Unicode.
            if unicodedata.category(c) not in ("Cs", "Cn"):
                return c

    def integer(self):
        random = self.random
        if random.random() < 0.02:
            return random.choice([-1, 1]) * random.randrange(2**64, 2**200)
        if random.random() < 0.3:
            return random.choice(INTS)
        return random.randrange(-1000, 1000) if random.random() < 0.5 else random.randrange(-(2**63), 2**64)

    def float(self):
        random = self.random
        kind = random.random()
        if kind < 0.3:
            return random.choice(FLOATS) * random.choice([1, -1])
        if kind < 0.5:
            return round(random.uniform(-100, 100), random.randrange(6))
        if kind < 0.6:
            return 2.0 ** random.randrange(-1074, 1024)
        if kind < 0.62:
            return float("nan")
        return random.uniform(0.1, 10) * 10.0 ** random.randrange(-323, 308)

    def scalar(self):
        make = self.random.choice([self.text, self.text, self.text, self.integer, self.float, self.float, self.word])
        return make()

    def word(self):
        return self.random.choice([None, True, False])

    def key(self):
        random = self.random
        if random.random() < 0.85:
            return self.text(WILD_KEY)
        if random.random() < 0.1:
            return (random.randrange(9), self.text())
        key = self.scalar()
        return 0.5 if key != key else key

    def value(self, depth):
        random = self.random
        if depth == 0 or random.random() < 0.4:
            return self.scalar()
        count = random.choice([0, 1, 1, 2, 2, 3, 4])
        kind = random.random()
        if kind < 0.5:
            return [self.value(depth - 1) for _ in range(count)]
        if kind < 0.6:
            # An empty one is always the same object, for which YAML would write an alias.
            return tuple(self.value(depth - 1) for _ in range(max(count, 1)))
        return {self.key(): self.value(depth - 1) for _ in range(count)}


def told(value):
    """The value with all types told, for JSON."""
    if isinstance(value, str) and any("\ud800" <= c <= "\udfff" for c in value):
        return {"other": repr(value)}
    if isinstance(value, (bool, str)) or value is None:
        return value
    if isinstance(value, int):
        return {"int": str(value)}
    if isinstance(value, float):
        return {"float": repr(value)}
    if isinstance(value, tuple):
        return {"tuple": [told(item) for item in value]}
    if isinstance(value, list):
        return [told(item) for item in value]
    if isinstance(value, dict):
        return {"dict": [[told(key), told(item)] for key, item in value.items()]}
    return {"other": repr(value)}


def lists(value):
    """The value with lists in place of tuples, as YAML and serde know it; keys stay."""
    if isinstance(value, (list, tuple)):
        return [lists(item) for item in value]
    if isinstance(value, dict):
        return {key: lists(item) for key, item in value.items()}
    return value


def has_tuple_key(value):
    if isinstance(value, dict):
        return any(isinstance(key, tuple) or has_tuple_key(item) for key, item in value.items())
    return isinstance(value, (list, tuple)) and any(has_tuple_key(item) for item in value)


def literal(text):
    try:
        return ast.literal_eval(text)
    except ValueError:
        # `repr` writes these, but `literal_eval` does not know them.
        return eval(text, {"__builtins__": {}, "inf": float("inf"), "nan": float("nan")})


def dump(value, unicode):
    text = yaml.safe_dump(value, default_flow_style=True, width=1e9, allow_unicode=unicode, sort_keys=False)
    # Written as they are, these are line breaks to YAML, and get lost.
    return dump(value, False) if unicode and any(c in text for c in "\x85\u2028\u2029") else text


def check(what, value, read):
    if told(read) != told(value):
        raise SystemExit(f"{what} reads {read!r} for {value!r}")


def values(seed, count):
    generator = Generator(seed)
    for _ in range(count):
        generator.wild = generator.random.random() < 0.3
        value = generator.value(4)
        line = {"value": told(value), "repr": repr(value), "str": None, "yaml": None}
        check("Python", value, literal(line["repr"]))
        if not has_tuple_key(value):
            line["yaml"] = dump(value, generator.random.random() < 0.5)
            check("YAML", lists(value), yaml.safe_load(line["yaml"]))
            line["str"] = str(lists(value))
        print(json.dumps(line))


def read():
    for line in sys.stdin:
        reader, text = json.loads(line)
        try:
            value = told(ast.literal_eval(text) if reader == "python" else yaml.safe_load(text))
        except Exception:
            value = {"error": None}
        print(json.dumps(value))


if sys.argv[1] == "values":
    values(int(sys.argv[2]), int(sys.argv[3]))
else:
    read()
