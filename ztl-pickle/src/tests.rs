//! Values that tests of Python's pickles reach seldom: cycles, keys, limits, texts.

use super::*;

fn read(bytes: &[u8]) -> Pickle {
    Pickle::read(bytes).unwrap()
}

fn repr(bytes: &[u8]) -> String {
    read(bytes).value().repr().to_string()
}

fn error(bytes: &[u8]) -> String {
    Pickle::read(bytes).unwrap_err().to_string()
}

#[test]
fn a_value_within_itself_is_printed_as_in_python() {
    for (bytes, text) in [
        (&b"]q\0h\0a."[..], "[[...]]"),
        (b"}q\0X\x01\0\0\0ah\0s.", "{'a': {...}}"),
        (b"]q\0h\0\x85q\x01ah\x010h\x01.", "([(...)],)"),
        (
            b"ccollections\nOrderedDict\n)Rq\0K\x01h\0s.",
            "OrderedDict({1: ...})",
        ),
        // Shared, but not within itself.
        (b"(]q\0h\0h\0t.", "([], [], [])"),
    ] {
        let pickle = read(bytes);
        assert_eq!(pickle.value().repr().to_string(), text);
        let again = read(&pickle.to_bytes());
        assert_eq!(again, pickle);
        assert_eq!(again.value().repr().to_string(), text);
        assert_eq!(again.to_bytes(), pickle.to_bytes());
    }
    let cycle = read(b"]q\0h\0a.");
    assert_eq!(cycle.value().to_json(99), Err(JsonError::Recursive));
    // As deep as one looks, both are the same.
    assert_eq!(cycle, read(b"]q\0]q\x01h\0aa."));
    assert_ne!(cycle, read(b"]]a."));
}

#[test]
fn equal_keys_are_united_as_in_python() {
    for (bytes, text) in [
        (
            &b"}(K\x01X\x01\0\0\0a\x88X\x01\0\0\0bG\x3f\xf0\0\0\0\0\0\0X\x01\0\0\0cu."[..],
            "{1: 'c'}",
        ),
        (
            b"\x8f(\x88K\x01\x8a\x09\0\0\0\0\0\0\0\0\x01G\x43\xf0\0\0\0\0\0\0\x90.",
            "{True, 18446744073709551616}",
        ),
        (b"}(K\x01\x85N\x88\x85\x89u.", "{(1,): False}"),
        (b"(F0.0\nNI0\nI1\nI2\nI3\nF-0.0\nI4\nd.", "{0.0: 4, 2: 3}"),
        // Different `nan`, and the same one.
        (
            b"\x8f(G\x7f\xf8\0\0\0\0\0\0G\x7f\xf8\0\0\0\0\0\0\x90.",
            "{nan, nan}",
        ),
        (b"\x8f(G\x7f\xf8\0\0\0\0\0\0q\0h\0\x90.", "{nan}"),
        // Bytes are no text.
        (b"\x8f(C\x01aX\x01\0\0\0a\x90.", "{b'a', 'a'}"),
        (
            b"\x8f((K\x01K\x02\x91(K\x02K\x01K\x02\x91\x90.",
            "{frozenset({1, 2})}",
        ),
        (b"c__builtin__\nset\n](K\x01\x88K\x02e\x85R.", "{1, 2}"),
    ] {
        assert_eq!(repr(bytes), text);
    }
}

#[test]
fn what_python_cannot_hash_is_no_key() {
    for (bytes, name) in [
        (&b"}]Ns."[..], "list"),
        (b"}]\x85Ns.", "list"),
        (b"\x8f(}\x90.", "dict"),
        (b"\x8fq\0(h\0\x90.", "set"),
        (b"(]\x91.", "list"),
        (b"\x8f(\x8f\x90.", "set"),
        (b"}c__builtin__\nbytearray\n)RNs.", "bytearray"),
        (b"]q\0h\0\x85q\x01a}h\x01Ns.", "list"),
    ] {
        assert_eq!(error(bytes), format!("unhashable type: '{name}'"));
    }
    let list = Pickle::list(["a"]).unwrap();
    assert_eq!(Pickle::dict([(list, "b")]), Err(Error::Unhashable("list")));
}

#[test]
fn a_list_and_a_set_of_it_do_not_disturb_each_other() {
    // set(l), then l.append(3), and set.add(4).
    let bytes =
        b"(](K\x01K\x02eq\0c__builtin__\nset\nh\0\x85Rq\x010h\0K\x03ah\x01(K\x04\x90h\0K\x05at.";
    assert_eq!(
        repr(bytes),
        "([1, 2, 3, 5], [1, 2, 3, 5], {1, 2, 4}, [1, 2, 3, 5])"
    );
}

#[test]
fn each_limit_is_an_error() {
    let limits = Limits::default();
    for (limits, text) in [
        (
            Limits {
                bytes: 18,
                ..limits
            },
            "the pickle exceeds the limit on bytes, 18",
        ),
        (
            Limits {
                memory: 100,
                ..limits
            },
            "the pickle exceeds the limit on memory, 100",
        ),
        (
            Limits { nodes: 2, ..limits },
            "the pickle exceeds the limit on nodes, 2",
        ),
        (
            Limits { depth: 2, ..limits },
            "the pickle exceeds the limit on depth, 2",
        ),
        (
            Limits { memo: 1, ..limits },
            "the pickle exceeds the limit on memo, 1",
        ),
    ] {
        let bytes = b"]q\0]q\x01(](K\x01K\x02K\x03eea.";
        assert_eq!(repr(bytes), "[[[1, 2, 3]]]");
        let error = Pickle::read_with(bytes, limits).unwrap_err();
        assert_eq!(error.to_string(), text);
    }
}

#[test]
fn a_small_pickle_with_a_long_text_is_cut() {
    let mut bytes = b"]".to_vec();
    for _ in 0..60 {
        // t = (t, t)
        bytes.extend(b"2\x86");
    }
    bytes.push(b'.');
    let pickle = read(&bytes);
    let text = pickle.value().repr().to_string();
    assert_eq!(text.len(), (1 << 20) + 3);
    assert!(text.starts_with("((((((") && text.ends_with("..."));
    assert_eq!(pickle.value().repr().most(4).to_string(), "((((...");
    assert_eq!(
        pickle.value().to_json(1000),
        Err(JsonError::TooLong { most: 1000 })
    );
    assert!(pickle.to_bytes().len() < 1000);
    assert_eq!(read(&pickle.to_bytes()), pickle);
}

#[test]
fn forty_kilobytes_of_nested_lists_are_no_problem() {
    let deep = [vec![b']'; 40_000], vec![b'a'; 39_999], vec![b'.']].concat();
    assert_eq!(error(&deep), "the pickle exceeds the limit on depth, 1000");
    let limits = Limits {
        depth: 50_000,
        ..Limits::default()
    };
    let pickle = Pickle::read_with(&deep, limits).unwrap();
    assert_eq!(pickle.value().repr().to_string().len(), 80_000);
    assert_eq!(pickle.value().to_json(80_000).unwrap().len(), 80_000);
    assert_eq!(
        Pickle::read_with(&pickle.to_bytes(), limits).unwrap(),
        pickle.clone()
    );
    // As a key, too.
    let tuples = [&b"})"[..], &[0x85; 20_000], b"Ns."].concat();
    let pickle = Pickle::read_with(&tuples, limits).unwrap();
    assert_eq!(pickle.value().repr().to_string().len(), 2 + 20_000 * 3 + 8);
}

#[test]
fn json_tells_every_value() {
    let json = |bytes| read(bytes).value().to_json(1000).unwrap();
    for (bytes, text) in [
        (&b"N."[..], "null"),
        (b"(\x88K\x01J\xff\xff\xff\xff\x8a\x09\0\0\0\0\0\0\0\0\x01t.", "[true, 1, -1, 18446744073709551616]"),
        (b"(G\x3f\xb9\x99\x99\x99\x99\x99\x9aG\x7f\xf0\0\0\0\0\0\0G\xff\xf0\0\0\0\0\0\0G\x7f\xf8\0\0\0\0\0\0t.", "[0.1, \"Infinity\", \"-Infinity\", \"NaN\"]"),
        (b"X\x08\0\0\0a\"\\\n\0\xed\xa0\x80.", "\"a\\\"\\\\\\n\\u0000\\ud800\""),
        (b"C\x02hi.", "{\"base64\": \"aGk=\"}"),
        (b"}(K\x01NX\x01\0\0\0\x31\x88X\x01\0\0\0'\x85\x89u.", "{\"1\": null, \"1\": true, \"(\\\"'\\\",)\": false}"),
        (b"cdatetime\ndatetime\nC\x0a\x07\xe8\x02\x03\x04\x05\x06\0\0\x07cdatetime\ntimezone\ncdatetime\ntimedelta\nJ\xff\xff\xff\xffM\x10\x0eK\0\x87R\x85R\x86R.", "\"2024-02-03T04:05:06.000007-23:00\""),
        (b"cdatetime\ntimedelta\nK\x01K\x02K\x03\x87R.", "86402.000003"),
    ] {
        assert_eq!(json(bytes), text);
    }
    let long = [&b"\x8b\xd0\x07\0\0"[..], &[1; 2000], b"."].concat();
    assert!(
        read(&long)
            .value()
            .to_json(5000)
            .unwrap()
            .starts_with("\"0x101")
    );
}

#[test]
fn a_program_makes_values() {
    let array = Pickle::array(
        DType::new("u2").unwrap().big_endian(),
        &[2, 1],
        &[0, 1, 1, 0],
    )
    .unwrap();
    let values = [
        Pickle::none(),
        true.into(),
        1.into(),
        u64::MAX.into(),
        i64::MIN.into(),
        1.5.into(),
        "it's".into(),
        Pickle::bytes(b"\xff").unwrap(),
        array,
        Pickle::set([1.0, 1.0, 2.0]).unwrap(),
        Pickle::dict([(1, "a"), (2, "b"), (1, "c")]).unwrap(),
    ];
    let pickle = Pickle::tuple(values).unwrap();
    let text = "(None, True, 1, 18446744073709551615, -9223372036854775808, 1.5, \"it's\", b'\\xff', \
        array([[1], [256]], dtype='>u2'), {1.0, 2.0}, {1: 'c', 2: 'b'})";
    assert_eq!(pickle.value().repr().to_string(), text);
    assert_eq!(format!("{pickle:?}"), text);
    assert_eq!(read(&pickle.to_bytes()), pickle);
    let wrong = Pickle::array(DType::INT32, &[2], &[0; 7]);
    assert!(matches!(wrong, Err(Error::Malformed { .. })));
    assert!(Pickle::array(DType::INT32, &[usize::MAX, 4], &[]).is_err());
}
