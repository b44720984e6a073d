//! Hostile pickles, each with what is said about it.

/// A pickle, and a part of its error; nothing if it may be read.
pub(crate) struct Case {
    pub(crate) name: String,
    pub(crate) bytes: Vec<u8>,
    pub(crate) error: Option<String>,
}

/// What attackers name, as module and name.
const GADGETS: [(&str, &str); 52] = [
    ("os", "system"),
    ("os", "popen"),
    ("os", "execv"),
    ("os", "path.os.system"),
    ("os.path", "os.system"),
    ("posix", "system"),
    ("nt", "system"),
    ("pty", "spawn"),
    ("subprocess", "Popen"),
    ("subprocess", "check_output"),
    ("builtins", "eval"),
    ("builtins", "exec"),
    ("builtins", "compile"),
    ("builtins", "getattr"),
    ("builtins", "setattr"),
    ("builtins", "open"),
    ("builtins", "__import__"),
    ("builtins", "map"),
    ("builtins", "object"),
    ("builtins", "type"),
    ("builtins", "set.add"),
    ("__builtin__", "eval"),
    ("__builtin__", "execfile"),
    ("__builtin__", "apply"),
    ("__main__", "x"),
    ("operator", "attrgetter"),
    ("operator", "methodcaller"),
    ("functools", "partial"),
    ("functools", "reduce"),
    ("itertools", "starmap"),
    ("types", "FunctionType"),
    ("types", "CodeType"),
    ("marshal", "loads"),
    ("pickle", "loads"),
    ("_pickle", "loads"),
    ("importlib", "import_module"),
    ("runpy", "run_path"),
    ("sys", "modules"),
    ("socket", "socket"),
    ("shutil", "rmtree"),
    ("codecs", "encode"),
    ("codecs", "lookup"),
    ("_codecs", "decode"),
    ("_codecs", "register"),
    ("copy_reg", "_reconstructor"),
    ("copyreg", "__newobj__"),
    ("copyreg", "add_extension"),
    ("numpy", "load"),
    ("numpy.testing", "runstring"),
    ("numpy.core.multiarray", "fromfile"),
    ("numpy.core.multiarray", "_reconstruct.__globals__"),
    ("datetime", "datetime.strptime"),
];

/// Names that look like allowed ones, or would leave their line.
const LOOKALIKES: [(&str, &str); 12] = [
    ("builtins", "s\u{435}t"),
    ("\u{430}atetime", "date"),
    ("datetime\0", "date"),
    ("datetime\nos", "system"),
    ("datetime", "date\n"),
    ("datetime", "date\0"),
    (" datetime", "date"),
    ("Datetime", "date"),
    ("datetime", ""),
    ("", "date"),
    ("", ""),
    ("\x1b[2J", "\x1b]0;x\x07"),
];

/// Operations that make objects, of allowed names as well.
const OBJECTS: [(&[u8], &str); 18] = [
    (b"(ios\nsystem\n.", "refused: os.system"),
    (b"(S'reboot'\nios\nsystem\n.", "refused: os.system"),
    (
        b"(icollections\nOrderedDict\n.",
        "refused: collections.OrderedDict",
    ),
    (
        b"(ccollections\nOrderedDict\no.",
        "refused: collections.OrderedDict",
    ),
    (b"(]o.", "refused: an object"),
    (
        b"ccollections\nOrderedDict\n)\x81.",
        "refused: collections.OrderedDict",
    ),
    (
        b"ccollections\nOrderedDict\n)}\x92.",
        "refused: collections.OrderedDict",
    ),
    (b"])\x81.", "refused: an object"),
    (b"]}b.", "refused: the state of an object"),
    (
        b"ccollections\nOrderedDict\n)R}b.",
        "refused: the state of an object",
    ),
    (
        b"Pfile:///etc/passwd\n.",
        "refused: persistent id file:///etc/passwd",
    ),
    (b"P\x1b[2J\n.", "refused: persistent id \\x1b[2J"),
    (b"K\x01Q.", "refused: persistent id"),
    (b"\x82\x01.", "refused: extension code"),
    (b"\x83\x01\x01.", "refused: extension code"),
    (b"\x84\x01\x01\x01\x01.", "refused: extension code"),
    (b"\x97.", "refused: out-of-band buffer"),
    (b"C\x01a\x98.", "refused: out-of-band buffer"),
];

/// Calls of allowed names with what they must not take, and classes as values.
const CALLS: [(&[u8], &str); 34] = [
    (b"c_codecs\nencode\nX\x01\0\0\0aX\x03\0\0\0bz2\x86R.", "refused: _codecs.encode.bz2"),
    (b"c_codecs\nencode\nX\x01\0\0\0aX\x05\0\0\0rot13\x86R.", "refused: _codecs.encode.rot13"),
    (b"c_codecs\nencode\nX\x02\0\0\0\xc4\x80X\x06\0\0\0latin1\x86R.", "arguments"),
    (b"c_codecs\nencode\n)R.", "arguments"),
    (b"cbuiltins\nbytearray\nJ\xff\xff\xff\x7f\x85R.", "arguments"),
    (b"cbuiltins\nbytes\nJ\xff\xff\xff\x7f\x85R.", "arguments"),
    (b"cbuiltins\nset\nX\x03\0\0\0abc\x85R.", "arguments"),
    (b"cbuiltins\nset\n]]\x86R.", "arguments"),
    (b"cnumpy\ndtype\nX\x02\0\0\0O8\x85R.", "refused: numpy.dtype.O8"),
    (b"cnumpy\ndtype\nX\x02\0\0\0V8\x85R.", "refused: numpy.dtype.V8"),
    (b"cnumpy\ndtype\nX\x02\0\0\0M8\x85R.", "refused: numpy.dtype.M8"),
    (b"cnumpy\ndtype\nX\x03\0\0\0f16\x85R.", "refused: numpy.dtype.f16"),
    (b"cnumpy\ndtype\nX\x0a\0\0\0S999999999\x85R.", "refused: numpy.dtype.S999999999"),
    (b"cnumpy\ndtype\nX\x05\0\0\0f8,O8\x85R.", "refused: numpy.dtype.f8,O8"),
    (b"cnumpy\nndarray\nK\x05\x85R.", "refused: numpy.ndarray"),
    (b"cnumpy\nndarray\n.", "refused: numpy.ndarray"),
    (b"]cdatetime\ndate\na.", "refused: datetime.date"),
    (b"}K\x01cbuiltins\nset\ns.", "refused: __builtin__.set"),
    (b"cnumpy.core.multiarray\n_reconstruct\ncbuiltins\nset\nK\0\x85C\x01b\x87R.", "arguments"),
    (b"cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x09\x85C\x01b\x87R.", "arguments"),
    (b"cnumpy.core.multiarray\nscalar\nN]\x86R.", "arguments"),
    (b"cnumpy.core.multiarray\nscalar\ncnumpy\ndtype\nX\x02\0\0\0f8\x85RC\x01a\x86R.", "arguments"),
    (b"cnumpy.core.numeric\n_frombuffer\n(C\0NK\0\x85X\x01\0\0\0CtR.", "array"),
    (b"cnumpy.core.numeric\n_frombuffer\n(C\0cnumpy\ndtype\nX\x02\0\0\0f8\x85RK\x09\x85X\x01\0\0\0CtR.", "array"),
    (b"cnumpy.core.numeric\n_frombuffer\n(C\0cnumpy\ndtype\nX\x02\0\0\0f8\x85RJ\xff\xff\xff\xff\x85X\x01\0\0\0CtR.", "array"),
    (b"cnumpy.core.numeric\n_frombuffer\n(C\0cnumpy\ndtype\nX\x02\0\0\0f8\x85R\x8a\x08\0\0\0\0\0\0\0\x40\x8a\x08\0\0\0\0\0\0\0\x40K\0\x87X\x01\0\0\0CtR.", "array"),
    (b"cdatetime\ndate\nC\x04\x07\xe8\x02\x1e\x85R.", "date"),
    (b"cdatetime\ndatetime\nC\x0a\x07\xe8\x02\x01\x18\0\0\0\0\0\x85R.", "date"),
    (b"cdatetime\ntime\nC\x06\0\0\0\xff\xff\xff\x85R.", "date"),
    (b"cdatetime\ntime\nC\x06\0\0\0\0\0\0]\x86R.", "date"),
    (b"cdatetime\ntimezone\ncdatetime\ntimedelta\nK\x01K\0K\0\x87R\x85R.", "date"),
    (b"cdatetime\ntimedelta\nK\0\x8a\x08\xff\xff\xff\xff\xff\xff\xff\x7fK\0\x87R.", "date"),
    (b"K\x01)R.", "call"),
    (b"ccollections\nOrderedDict\n]]K\x01\x85aa\x85R.", "arguments"),
];

/// Broken machines, and lengths that promise too much.
const BROKEN: [(&[u8], &str); 46] = [
    (b"", "cut off"),
    (b".", "stack"),
    (b"0.", "stack"),
    (b"1.", "mark"),
    (b"2.", "stack"),
    (b"(.", "stack"),
    (b"(2.", "stack"),
    (b"N(2.", "stack"),
    (b"]a.", "stack"),
    (b"](a.", "stack"),
    (b"]N(a.", "stack"),
    (b"N(e.", "collection"),
    (b"(e.", "stack"),
    (b"]Na(]Nu.", "collection"),
    (b"}(NNNu.", "collection"),
    (b"}Ns.", "stack"),
    (b")Na.", "collection"),
    (b"](NNa.", "collection"),
    (b"(Nd.", "key"),
    (b"t.", "mark"),
    (b"N\x86.", "stack"),
    (b"\x94.", "stack"),
    (b"q\0.", "stack"),
    (b"h\0.", "memo"),
    (b"g0\n.", "memo"),
    (b"g-1\n.", "memo"),
    (b"gx\n.", "memo"),
    (b"j\xff\xff\xff\xff.", "memo"),
    (b"g99999999999999999999\n.", "memo"),
    (b"\x80\x06N.", "protocol"),
    (b"\xff.", "operation"),
    (b"\x95\xff\xff\xff\xff\xff\xff\xff\x7fN.", "cut off"),
    (b"\x8b\xff\xff\xff\x7f.", "cut off"),
    (b"\x8b\xff\xff\xff\xff.", "length"),
    (b"\x8a\xff.", "cut off"),
    (b"T\xff\xff\xff\xff.", "length"),
    (b"B\xff\xff\xff\xff.", "cut off"),
    (b"X\xff\xff\xff\xff.", "cut off"),
    (b"\x96\0\0\0\0\0\0\0\x10.", "cut off"),
    (b"\x8d\xff\xff\xff\xff\xff\xff\xff\xff.", "cut off"),
    (b"\x8e\0\0\0\0\0\0\0\x10.", "cut off"),
    (b"X\x02\0\0\0\xc3\x28.", "UTF-8"),
    (b"S'a\n.", "literal"),
    (b"V\\u00\n.", "escape"),
    (b"F1.5x\n.", "float"),
    (b"NK\x01\x93.", "name"),
];

/// Pickles that grow, with `count` repetitions.
pub(crate) fn bombs(count: usize) -> Vec<Case> {
    let bomb = |name: &str, parts: &[(&[u8], usize)]| Case {
        name: format!("bomb: {name}"),
        bytes: parts
            .iter()
            .flat_map(|(part, times)| part.repeat(*times))
            .collect(),
        error: None,
    };
    let text = [&b"X\0\x10\0\0"[..], &[b'a'; 4096], b"q\0"].concat();
    let bytes = [
        &b"X\0\x10\0\0"[..],
        "\u{e9}".repeat(2048).as_bytes(),
        b"q\0",
    ]
    .concat();
    vec![
        bomb("empty lists", &[(b"(", 1), (b"]", count), (b"l.", 1)]),
        bomb(
            "empty dicts and sets",
            &[(b"(", 1), (b"}\x8f", count), (b"l.", 1)],
        ),
        bomb(
            "nested lists",
            &[(b"]", count), (b"a", count - 1), (b".", 1)],
        ),
        bomb("nested tuples", &[(b")", 1), (b"\x85", count), (b".", 1)]),
        bomb(
            "nested tuples as key",
            &[(b"})", 1), (b"\x85", count), (b"Ns.", 1)],
        ),
        bomb("nested dicts", &[(b"}", count), (b"K\x012", 0), (b".", 1)]),
        bomb("doubled tuples", &[(b")", 1), (b"2\x86", count), (b".", 1)]),
        bomb(
            "doubled tuples as key",
            &[(b"})", 1), (b"2\x86", count), (b"Ns.", 1)],
        ),
        bomb("doubled lists", &[(b"]", 1), (b"2\x86", count), (b".", 1)]),
        bomb("duplicates", &[(b"(]", 1), (b"2", count), (b"l.", 1)]),
        bomb("constants", &[(b"(", 1), (b"N", count), (b"l.", 1)]),
        bomb(
            "equal elements",
            &[(b"\x8f(", 1), (b"N", count), (b"\x90.", 1)],
        ),
        bomb("equal keys", &[(b"}(", 1), (b"NN", count), (b"u.", 1)]),
        bomb("marks", &[(b"(", count), (b".", 1)]),
        bomb(
            "marks and lists",
            &[(b"(", count), (b"l", count), (b".", 1)],
        ),
        bomb("memo", &[(b"N", 1), (b"\x94", count), (b".", 1)]),
        bomb(
            "lists in the memo",
            &[(b"(", 1), (b"]\x94", count), (b"l.", 1)],
        ),
        bomb(
            "long memo index",
            &[(b"N", 1), (b"r\xff\xff\xff\xff", count), (b".", 1)],
        ),
        bomb(
            "memo again and again",
            &[(b"(]q\0", 1), (b"h\0", count), (b"l.", 1)],
        ),
        bomb(
            "one text as many keys",
            &[
                (b"}", 1),
                (&text, 1),
                (b"N", 1),
                (b"s", 1),
                (b"(", 1),
                (b"h\0N", count),
                (b"u.", 1),
            ],
        ),
        bomb(
            "bytes of one text",
            &[
                (b"(", 1),
                (&bytes, 1),
                (b"X\x06\0\0\0latin1q\x01c_codecs\nencode\nq\x02", 1),
                (b"h\x02h\0h\x01\x86R", count),
                (b"l.", 1),
            ],
        ),
        bomb(
            "sets of one list",
            &[
                (b"(](", 1),
                (b"N", 1000),
                (b"eq\0cbuiltins\nset\nq\x01", 1),
                (b"h\x01h\0\x85R(N\x90", count),
                (b"l.", 1),
            ],
        ),
        bomb(
            "ordered dicts",
            &[
                (b"(](", 1),
                (b"]NaNa", 100),
                (b"eq\0ccollections\nOrderedDict\nq\x01", 1),
                (b"h\x01h\0\x85R", count),
                (b"l.", 1),
            ],
        ),
        bomb(
            "frozensets",
            &[(b"\x8f(", 1), (b"(\x91", count), (b"\x90.", 1)],
        ),
        bomb(
            "nested frozensets",
            &[(b"(\x91", 1), (b"0((\x91\x91", count), (b".", 1)],
        ),
        bomb(
            "names",
            &[(b"(", 1), (b"cdatetime\ndate\n", count), (b"l.", 1)],
        ),
        bomb("digits", &[(b"L", 1), (b"9", count), (b"L\n.", 1)]),
        bomb("escapes", &[(b"V", 1), (b"\xff", count), (b"\n.", 1)]),
        bomb("literal", &[(b"S'", 1), (b"\xff", count), (b"'\n.", 1)]),
        bomb("frames", &[(b"\x95\0\0\0\0\0\0\0\0", count), (b"N.", 1)]),
        bomb(
            "a long integer",
            &[(b"\x8b\0\0\x01\0", 1), (b"\x55", 65536), (b".", 1)],
        ),
        bomb(
            "lists within themselves",
            &[(b"(", 1), (b"]q\0h\0a", count), (b"l.", 1)],
        ),
    ]
}

/// All but the bombs.
pub(crate) fn cases() -> Vec<Case> {
    let short = |text: &str| [&[0x8c, text.len() as u8], text.as_bytes()].concat();
    let case = |name: String, bytes: Vec<u8>, error: String| Case {
        name,
        bytes,
        error: Some(error),
    };
    let mut cases = Vec::new();
    for (module, name) in GADGETS.iter().chain(&LOOKALIKES) {
        let dot = if module.is_empty() { "" } else { "." };
        let escaped = |text: &str| text.as_bytes().escape_ascii().to_string();
        let error = format!("refused: {}{dot}{}", escaped(module), escaped(name));
        let mut add = |form: &str, bytes: Vec<u8>| {
            let name = format!("{form} {}.{}", escaped(module), escaped(name));
            cases.push(case(name, bytes, error.clone()));
        };
        let (module_text, name_text) = (short(module), short(name));
        let stack = [&module_text[..], &name_text, b"\x93)R."].concat();
        add("STACK_GLOBAL", stack);
        let memo = [
            &b"\x80\x04"[..],
            &name_text,
            b"\x940",
            &module_text,
            b"\x94h\0\x93C\0\x85R.",
        ]
        .concat();
        add("STACK_GLOBAL by memo", memo);
        if !format!("{module}{name}").contains('\n') {
            let global = format!("c{module}\n{name}\n(S'id'\ntR.").into_bytes();
            add("GLOBAL", global);
            let unused = format!("c{module}\n{name}\n0N.").into_bytes();
            add("unused GLOBAL", unused);
            let inst = format!("(S'id'\ni{module}\n{name}\n.").into_bytes();
            add("INST", inst);
        }
    }
    let tables = OBJECTS.iter().chain(&CALLS).chain(&BROKEN);
    for (bytes, error) in tables {
        let name = bytes.escape_ascii().to_string();
        cases.push(case(name, bytes.to_vec(), (*error).to_owned()));
    }
    cases
}
