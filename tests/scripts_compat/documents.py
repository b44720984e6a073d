"""Makes up YAML documents and prints what PyYAML makes of each: [text, quoted form], or [text, null, the
error]. argv: a seed, how many."""
import json, random, sys
import oyaml as yaml

dice = random.Random(int(sys.argv[1]))

# What stands in documents: indicators, blanks, line breaks, and what looks like them.
PIECES = '''a b say hello 1 010 no ~ it's x:y a#b -a ?a :a <<'''.split() + [
    ':', ': ', ': ', ': ', ', ', ',', '-', '- ', '- ', '?', '? ', '[', ']', '[', ']', '{', '}', '{', '}', '#', ' # c', '|', '>',
    '|\n', '>-\n', '|+\n', '|2\n', '>1-\n', '"', "'", '""', "''", '"a"', "'b'", '"\\', '\\', '"\\x41"', '"\\u00e9\\\n b"', '"a\n\n  b"', "'a\n b'",
    '&x ', '*x', '*x ', '&y', '!', '! ', '!!str ', '!!int ', '!!map ', '!!seq ', '!!omap ', '!!pairs ', '!!float', '!<tag:yaml.org,2002:str> ', '!a!b ',
    '<<: *x', '%', '%YAML 1.1\n', '%TAG !a! tag:yaml.org,2002:\n', '---\n', '--- ', '...\n', '...', '@', '`',
    ' ', '  ', '   ', '\t', '\n', '\n', '\n', '\n ', '\n  ', '\n  ', '\n   ', '\n    ', '\n- ', '\n  - ', '\n\t', '\n\n', '\r\n', '\r',
    '\u0085', '\u2028', '\u2029', '\ufeff', 'ä', '\u00a0', '🤖', '=', '\n---\n', '\n...\n', '\n# c\n', 'x' * 300, 'y' * 1030,
]

# Mistakes are more interesting in what is nearly right.
WHOLE = ['''s(delay=1):
  a b (wait=no):
    robot: {blink: test me, walk: [1, 2.5, [x, 'y']], "q": {}}
    lamp: &l
      say: |
        two
         lines

      on: >-
        folded
        text
  c: *l
''', '''- &x {a: 1, b: [2]}
- <<: *x
  b: 3
- {<<: [*x, {a: 5, z: 6}], q: 7}
-
  - "é\\u200b\\x07 \\
     more"
  - 'it''s
    long'
- plain
  text

  over lines # c
''', '''? complex
: value
? - list
k: !!str 12
[a, b]: c
''', '''remotes:
- a: {x: 1,
y: 2,
}
  b: [
1
]
- {a, b: , ? c, ? d : e}
- [a: 1, ? b, : c, ]
''', 'k: %s\n']


def spoiled(text):
    """With some places written over."""
    for _ in range(dice.choice([0, 1, 1, 2, 3])):
        start = dice.randrange(len(text) + 1)
        kind = dice.random()
        if kind < .4:
            text = text[:start] + dice.choice(PIECES) + text[start:]
        elif kind < .7:
            text = text[:start] + text[start + dice.randint(1, 3):]
        else:
            lines = text.split('\n')
            line = dice.randrange(len(lines))
            lines[line] = dice.choice(['', ' ', '  ', '\t']) + lines[line].lstrip(' ')
            text = '\n'.join(lines)
    return text


def made_up():
    soup = ''.join(dice.choice(PIECES) for _ in range(dice.randint(1, 12)))
    if dice.random() < .5:
        return soup
    text = dice.choice(WHOLE)
    if '%s' in text:
        text = text % dice.choice([soup, '[%s]' % soup, '{%s}' % soup, '\n  ' + soup])
    return spoiled(text)


# What was once different.
KNOWN = ['\ufeff\ufeffa', 'k: [-]', 'k: {a: -}', 'k: !!int |\n  12', 'k: a\ufeffb', 'k: [?a, b]', 'k: a\tb', 'k:\tb', 'k: a\t', 'k: a\u0085b', 'k: a\u2028b', 'k: {a: [\n1\n]}',
         'k: {\na: 1\n}', '%s: 1' % ('x' * 1025), '{%s: 1}' % ('x' * 1025), '%s: 1' % ('x' * 1023), '[[%s]]' % ('x' * 1025), 'a: "b\nc"', 'a: &x 1\nb: &x 2',
         '? a\n- b', '- a\n-\tb', '"a"#b', 'k: "x"y', 'k: |1\n a', 'k: >\n\n a\n\n  b\n c\n', '&a [*a]', '&a {x: *a}', '{a, b}', '[a: b, c]', '{a b: c: d}', '...', '---', '', '{! "<<": {a: 1}}', '{! =: 1, ! "=": 2}', '{!!int =: 1}', '{!!str =: 1}', '{!!str <<: {a: 1}}']

for number in range(int(sys.argv[2])):
    text = KNOWN[number] if number < len(KNOWN) else made_up()
    try:
        print(json.dumps([text, str([yaml.safe_load(text)])]))
    except Exception as error:
        print(json.dumps([text, None, str(error)]))
