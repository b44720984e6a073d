"""Makes up YAML values and prints what PyYAML makes of each: [text, plain form, quoted form], or
[text, null, the error]. argv: a seed, how many."""
import datetime, json, random, sys
import oyaml as yaml

dice = random.Random(int(sys.argv[1]))
WORDS = '''yes Yes YES yEs no No NO nO true True TRUE tRue false False FALSE on On ON oN off Off OFF oFF y n Y N ~ null Null NULL nULL
None 0 00 -0 +0 010 08 09 0o10 0x1F 0X1f 0xg 0b101 0b2 0b_ 0x_ 0_ 1_000 _1 1__0 1_ -1 +1 --1 1e3 1.0e3 1.0e+3 1.5E-7 1e+3 .5 -.5 +.5 5. 5.e+1
.e+1 1.2.3 .inf -.inf +.inf .Inf .INF .iNF inf -inf nan .nan .NaN .NAN -.nan 1:30 1:60 01:30 1:5:30 12:30:45 -1:30 1:30.5 -1:30.25 0:30 190:20:30
1:30. 1:2:3.5 2020-01-01 2020-1-1 2020-13-01 2020-02-30 0000-01-01 2020-01-01T12:00:00 2020-01-01t1:02:03Z 2020-1-1\x2012:00:00.5
2020-01-01\x2012:00:00+2 2020-01-01\x2012:00:00\x20-05:30 2020-01-01\x2012:00:00\x20+00:00 2020-01-01\x2025:00:00 2001-12-14t21:59:43.10-05:00
2020-01-01\x2012:00:00.1234567 2020-01-01\x2012:00:00+24:00 2020-01-01\x2012:00 = << <<< == a=b 12e03 6.8523015e+5 685.230_15e+03 190:20:30.15 0.0 -0.0 1e-5
0.0001 0.00001 123456789012345678 12345678901234567890123 1.0e+16 1.0e+15 9007199254740993.0 0.1 1.0e-5 1.7976931348623157e+308 1.0e+400 5.0e-324
99999999999999999999999999999999999.0 3.14 -3.14e-10 1.10 007 0777 -010 +0x1f -0b11 0b0 1_2:3_0 1:3_0 é Grüße 世界 🤖 a\x20b it's say\x20"hi" a#b a\x20#b a: a:b'''.split()
WORDS = [word.replace('\\x20', ' ') for word in WORDS]
PIECES = list('0123456789_:.-+eExXobTZ ') + ['00', '1:3', '20', '-0', 'inf', '.5', 'e+', '0x', '0b', '2020-01-01']
TAGS = {
    'str': WORDS, 'null': WORDS, 'bool': ['yes', 'no', 'oN', 'TRUE', 'y', '1', ''], 'binary': ['aGk=', 'aGkn', 'IiI=', 'a', 'AAEC/w=='],
    'int': ['12', '-7', '+7', '0x1F', '010', '1_000', '1:30', '0b11', 'x', '1.5', '08', ''],
    'float': ['1', '-1.5', '1e3', '1.5e-7', '.inf', '.NaN', '1:30.5', '1_0.5', 'x', '0x1F', ''],
    'timestamp': ['2020-01-01', '2020-1-1 1:02:03Z', '2020-02-30'],
}


def quoted(text):
    double = json.dumps(text, ensure_ascii=max(text or ' ') <= '\uffff')
    return dice.choice([double, "'%s'" % text.replace("'", "''")])


def scalar(depth):
    kind = dice.random()
    if kind < .45:
        return dice.choice(WORDS)
    if kind < .75:
        return ''.join(dice.choice(PIECES) for _ in range(dice.randint(1, 9))).strip()
    if kind < .80:
        word = dice.choice(WORDS)
        place = dice.randrange(len(word) + 1)
        return word[:place] + dice.choice(PIECES) + word[place:]
    if kind < .86:
        return quoted(dice.choice(WORDS + ['\u00a0', '\u200b\u2028', '\x7f', 'a\\b', '\t', "'\"", 'l1\nl2', '\U000e0001', '']))
    if kind < .90:
        tag = dice.choice(list(TAGS))
        return '!!%s %s' % (tag, dice.choice(TAGS[tag]))
    if depth > 1:
        return dice.choice(WORDS)
    if kind < .95:
        return '[%s]' % ', '.join(flow(depth) for _ in range(dice.randint(0, 4)))
    return '{%s}' % ', '.join('%s: %s' % (flow(2), flow(depth)) for _ in range(dice.randint(0, 4)))


def flow(depth):
    """What stands within brackets: nothing that ends it."""
    text = scalar(depth + 1)
    while text[:1] not in '[{"\'' and any(c in text for c in ',[]{}#:?') or text[:1] in ('', '-', '?') or ' -' in text or text.startswith('!!'):
        text = scalar(depth + 1)
    return text


# What was once different.
KNOWN = ['{.nan: 1, x: 2, .NaN: 3}', '{1: a, 1.0: b, true: c}']

for number in range(int(sys.argv[2])):
    text = KNOWN[number] if number < len(KNOWN) else scalar(0)
    try:
        value = yaml.safe_load('k: %s\n' % text)
        print(json.dumps([text, str(value['k']), str(value)]))
    except Exception as error:
        print(json.dumps([text, None, str(error)]))
