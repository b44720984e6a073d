//! Scripts for each rule of the original's `ztl_run_script`, with keys: Enter, `r`, ….

/// What a key sends.
pub(crate) fn key(name: &str) -> &str {
    match name {
        "enter" => "\r",
        "linefeed" => "\n",
        "space" => " ",
        "up" => "\u{1b}",
        "ctrl-c" => "\u{3}",
        other => other,
    }
}

/// Name, text, keys; after the last of them `x` is pressed.
pub(crate) const SCRIPTS: &[(&str, &str, &str)] = &[
    ("the_worked_trace", "scene: {first step: {robot: {blink: test me, walk: 1}}, second step: {robot: {blink: another test}}}", "enter"),
    ("scene_delay", "s(delay=1): {a: {robot: {blink: 1}}}\nt(wait=no): {a: {lamp: {blink: 1}}}", "enter enter"),
    ("step_delays", "s: {a: {robot: {blink: 1}}, 'b(delay=1)': {robot: {blink: 2}}, 'c(delay=0)': {robot: {blink: 3}}, 'd(delay=-3)': {lamp: {blink: 4}}}", "enter"),
    ("component_delays_hold_up_what_follows", "s: {a: {robot: {blink: 1, 'wave(delay=1)': 2, blink b: 3}, lamp: {'blink(delay= 1 )': 4}}, b: {robot: {blink: 5}}}", "enter"),
    ("python_numbers_as_delays", "s: {'a(delay=+1)': {robot: {blink: 1}}, 'b(delay= 0_1 )': {robot: {blink: 2}}, 'c(delay=00)': {robot: {blink: 2}}}", "enter"),
    ("background_steps", "s: {'a(wait=no)': {robot: {walk: 1}}, 'b(wait=False, delay=1)': {lamp: {walk: 1}}, c: {robot: {blink: 1}}}", "enter"),
    ("background_components", "s: {a: {robot: {'walk(wait=off)': 1, wave: 2}}, b: {robot: {blink: 1}}}", "enter"),
    ("all_words_for_yes", "s: {a: {robot: {'wave(wait=true)': 1}}, b: {robot: {'wave(wait=1)': 1}}, c: {robot: {'wave(wait=T)': 1}}, d: {robot: {'wave(wait=y)': 1}}, e: {robot: {'wave(wait=YES)': 1}}, f: {robot: {'wave(wait=On)': 1}}, g: {robot: {blink: 1}}}", "enter"),
    ("a_typo_is_no", "s: {'a(wait=ture)': {robot: {walk: 1}}, b: {robot: {'walk(wait=)': 1}}, c: {robot: {'walk(wait=wait)': 1}}}", "enter"),
    ("names_are_not_trimmed", "s (delay=0): {st (wait=no): {'robot': {wa (wait=no): 1}}, ' x ': {robot: {' blink ': 1}}}", "enter"),
    ("what_follows_the_parentheses_is_dropped", "s(delay=0) of it: {a(wait=no)(wait=yes) x: {robot: {walk(delay=0)y: 1}}}", "enter"),
    ("parentheses_that_are_none", "'(s)': {'(a)(wait=no)': {robot: {'blink)wait=no(': 1}}, 'b(wait=no': {robot: {'wave': 1}}, 'c wait=no)': {robot: {'wave': 1}}}", "enter"),
    ("pieces_that_do_not_count", "s: {'a(wait)': {robot: {wave: 1}}, 'b(wait=no=no)': {robot: {wave: 1}}, 'c(=no, ,x=y)': {robot: {wave: 1}}, 'd(Wait=no)': {robot: {wave: 1}}, 'e()': {robot: {blink: 1}}}", "enter"),
    ("the_last_of_a_parameter_wins", "s: {'a(wait=no, wait=yes)': {robot: {wave: 1}}, 'b(delay=1,delay=0)': {robot: {blink: 1}}}", "enter"),
    ("remotes", "s: {a: {'arm(remote=robot)': {blink: 1}, 'head (x=1, remote = lamp )': {wave: 2}}, b: {'Grüße': {blink: 3}}}", "enter"),
    ("no_remote_when_there_was_a_reply", "s: {a: {robot: {blink: 1}, nobody: {'blink(delay=1)': 2, walk: 3}, 'robot(delay=1)': {blink: 4}, lamp: {blink: 5}}, b: {robot: {blink: 6}}}", "enter"),
    ("refused_and_failed", "s: {a: {robot: {refuse: 1, blink: 2}, lamp: {fail: 3, gone: 4}}, b: {robot: {refuse: 1}}, c: {robot: {blink: 3}}}", "enter"),
    ("skipping_all", "s: {a: {robot: {blink: 1}}}\nt: {a: {robot: {blink: 1}}}", "space x a up linefeed x"),
    ("replay", "s: {a: {robot: {wave: 1}}}\nt: {a: {robot: {blink: 2}}}\nu: {a: {lamp: {blink: 3}}}", "enter r R enter x r R x"),
    ("r_without_a_last_scene_skips", "s: {a: {robot: {blink: 1}}}\nt: {a: {robot: {blink: 2}}}", "r enter r x"),
    ("restart", "s: {a: {robot: {blink: 1}}}\nt: {a: {robot: {blink: 2}}}", "enter x a r enter A x x q"),
    ("empty_levels", "s: {}\nt: {a: {}, b: {robot: {}}, c: {robot: {blink: 1}}}", "enter enter r"),
    ("readings", "
on: {yes: {robot: {blink: no, 10: 12:30, 010: 010, 0x10: 0x1F, 1:30: 1:30.5}}}
2020-01-01: {~: {robot: {null: ~, 1.50: 1.50, 1e3: 1e3, .5: [1e3, .5, -.5, 1.0e+3, .inf]}}}
'no': {2020-01-01 12:00:00 +2: {robot: {y: y, '': '', 0b11: 2020-01-01 12:00:00.5}}}
", "enter enter enter"),
    ("goals", "
s:
  a:
    robot:
      a: {a: 1, b: [x, \"it's\", 'say \"hi\"']}
      b: [\"it's\", \"\\\"\", \"'\\\"\"]
      c: [&a [1], *a]
      d: |
        two
        lines
      e: >-
        folded
        text
      f: !!binary aGk=
      g: [2020-01-01, 2020-01-01 12:00:00 -05:30, !!binary aGk=]
      h: !!omap [a: 1, b: [2]]
      i: !!str 010
      j: {1: a, 1.0: b, true: c, x: d}
      k: \"é\\u200b\\x07\"
      l: [\"é\\u200b\\x07\\U0001F916\", 'ü']
      m: 123456789012345678901234567890
      n: a:b:c; d
", "enter"),
    ("merged_keys", "
s: {a: &a {robot: &r {blink: 3}, lamp: {blink: 4}}, b: {<<: *a, lamp: {blink: 5}}, c: {robot: {<<: [*r, {blink: 6, blink b: 7}], blink c: 8}}}
", "enter"),
    ("the_last_of_a_key_wins_in_the_place_of_the_first", "s: {a: {robot: {blink: 1}}, b: {robot: {blink: 2}}, a: {lamp: {blink: 3, blink b: 4, blink: 5}}}", "enter"),
    ("odd_names", "1: {~: {robot: {~: , 3: 4, 5.0: 6, 0x7: 8}}, ' ': {robot: {blink: 1}}}\n!!binary aGk=: {2020-01-02: {robot: {.inf: -0.0, !!binary aGk=: 1e3}}, \"c\\nd\": {robot: {\"e\\nf\": \"g\\nh\"}}}\n'': {'': {robot: {'': ''}}}", "enter enter enter r"),
    ("equal_names_of_different_kinds", "1: {a: {robot: {blink: 1, ~: 2, null: 3, '': 4}}}\ntrue: {a: {robot: {blink: 2}}}\n1.0: {a: {robot: {blink: 3}}}", "enter enter"),
    ("the_same_scene_by_an_alias", "s: &s {a: {robot: {blink: 1}}}\nt: *s", "enter enter r"),
    ("no_scenes_at_all", "{}", "a A x"),
    ("the_order_is_that_of_the_file", "z: {z: {robot: {blink z: 1, blink a: 2}}, a: {robot: {blink: 3}}}\na: {b: {lamp: {blink: 4}}}", "enter enter"),
];

/// Scripts that end with exit code 1; ours before anything is played, since all of it is looked at first.
pub(crate) const WRONG: &[(&str, &str, &str)] = &[
    ("no_yaml", "s: {a", "enter"),
    ("a_tab", "s:\n\ta: 1\n", "enter"),
    ("nothing", "", "enter"),
    ("an_empty_scene", "s:\n", "enter"),
    ("a_list", "s: [a]", "enter"),
    ("a_text", "s: {a: b}", "enter"),
    ("a_number", "s: {a: {robot: 5}}", "enter"),
    (
        "a_delay",
        "s: {a: {robot: {'blink(delay=soon)': 1}}}",
        "enter",
    ),
    ("a_list_of_scenes", "[a]", "enter"),
    (
        "scenes_in_order",
        "!!omap [s: {a: {robot: {blink: 1}}}]",
        "enter",
    ),
    ("a_set_of_steps", "s: !!set {a, b}", "enter"),
    (
        "nothing_behind_a_step",
        "s: {a: , b: {robot: {blink: 1}}}",
        "enter",
    ),
    ("nothing_behind_a_handler", "s: {a: {robot: }}", "enter"),
    ("a_step_within_itself", "s: &s {a: *s}", "enter"),
    ("two_documents", "s: {}\n---\nt: {}\n", "enter"),
    ("a_tag", "s: {a: {robot: {blink: !x 1}}}", "enter"),
    ("a_key", "s: {[a]: {}}", "enter"),
    ("a_day", "s: {a: {robot: {blink: 2020-02-30}}}", "enter"),
    ("a_value", "s: {a: {robot: {blink: =}}}", "enter"),
    ("a_character", "s: {a: {robot: {blink: '\u{7}'}}}", "enter"),
    ("ctrl_c", "s: {a: {robot: {blink: 1}}}", "ctrl-c"),
];
