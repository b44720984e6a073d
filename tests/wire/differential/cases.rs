//! The streams.

/// The longest frame that the servers take.
pub(super) const MOST: usize = 3000;

/// A stream of a client.
pub(super) struct Case {
    pub(super) name: &'static str,
    /// Up to `READY`, or what is in its place.
    pub(super) hello: Vec<u8>,
    /// What is sent once the server has answered that.
    pub(super) then: Vec<u8>,
    /// Whether the first part is the ordinary handshake, which is cut only once.
    pub(super) met: bool,
}

/// A STATUS, with its delimiter.
pub(super) const STATUS: &[u8] = b"\x01\0\0\x0C/test;2;99;x";

/// Replaced by a number of the connection: libzmq takes an identity once.
pub(super) const NUMBER: &[u8; 10] = b"@@@@@@@@@@";

/// A greeting of this version.
pub(super) fn greeting(major: u8, minor: u8) -> Vec<u8> {
    let mut bytes = b"\xFF\0\0\0\0\0\0\0\x01\x7F".to_vec();
    bytes.extend([major, minor]);
    bytes.extend(b"NULL");
    bytes.resize(64, 0);
    bytes
}

/// A frame in the short form.
fn frame(flags: u8, body: &[u8]) -> Vec<u8> {
    let length = u8::try_from(body.len()).expect("a short frame");
    [&[flags, length], body].concat()
}

/// A frame in the long form.
fn long(flags: u8, body: &[u8]) -> Vec<u8> {
    let length = (body.len() as u64).to_be_bytes();
    [&[flags | 2], &length[..], body].concat()
}

fn property(name: &str, value: &[u8]) -> Vec<u8> {
    let (name_length, length) = (name.len() as u8, value.len() as u32);
    [
        &[name_length],
        name.as_bytes(),
        &length.to_be_bytes(),
        value,
    ]
    .concat()
}

/// `READY` with these properties.
fn ready(properties: &[(&str, &[u8])]) -> Vec<u8> {
    let properties = properties
        .iter()
        .flat_map(|(name, value)| property(name, value));
    frame(
        4,
        &b"\x05READY"
            .iter()
            .copied()
            .chain(properties)
            .collect::<Vec<_>>(),
    )
}

fn is(socket_type: &str) -> Vec<u8> {
    ready(&[("Socket-Type", socket_type.as_bytes())])
}

/// The shortest good handshake.
fn handshake() -> Vec<u8> {
    [greeting(3, 0), is("REQ")].concat()
}

/// A message of these frames.
fn message(frames: &[&[u8]]) -> Vec<u8> {
    let last = frames.len() - 1;
    let frames = frames.iter().enumerate();
    let frames = frames.map(|(place, body)| match body.len() {
        0..256 => frame(u8::from(place < last), body),
        _ => long(u8::from(place < last), body),
    });
    frames.flatten().collect()
}

const BODY: &[u8] = b"/test;2;99;x";

/// Greetings and handshakes.
pub(super) fn handshakes() -> Vec<Case> {
    let after = |hello: Vec<u8>| [hello, is("REQ")].concat();
    let changed = |place: usize, bytes: &[u8]| {
        let mut hello = greeting(3, 1);
        hello[place..place + bytes.len()].copy_from_slice(bytes);
        after(hello)
    };
    let met = |ready: Vec<u8>| [greeting(3, 1), ready].concat();
    let old = |revision: u8, rest: &[u8]| [&greeting(revision, 0)[..11], rest].concat();
    let with = |name: &str, value: &[u8]| met(ready(&[("Socket-Type", b"REQ"), (name, value)]));
    let raw = |properties: &[u8]| met(frame(4, &[b"\x05READY", properties].concat()));
    let cases: Vec<(&'static str, Vec<u8>)> = vec![
        ("nothing", Vec::new()),
        ("half a signature", greeting(3, 0)[..5].to_vec()),
        ("a signature", greeting(3, 0)[..10].to_vec()),
        ("a greeting without READY", greeting(3, 0)),
        ("version 3.0", after(greeting(3, 0))),
        ("version 3.1", after(greeting(3, 1))),
        ("version 3.9", after(greeting(3, 9))),
        ("version 4.0", after(greeting(4, 0))),
        ("version 255", after(greeting(255, 0))),
        ("as-server", changed(32, &[1])),
        ("as-server 255", changed(32, &[255])),
        ("a filler that is not zero", changed(33, &[7; 31])),
        ("padding that is not zero", changed(1, &[7; 8])),
        ("a first byte that is not FF", changed(0, &[0x7F])),
        ("HTTP", b"GET / HTTP/1.1\r\nHost: a\r\n\r\n".to_vec()),
        ("PLAIN", changed(12, b"PLAIN")),
        ("CURVE", changed(12, b"CURVE")),
        ("no mechanism", changed(12, &[0; 20])),
        ("null", changed(12, b"null")),
        ("NULLX", changed(12, b"NULLX")),
        ("NULL, then rubbish", changed(31, b"x")),
        ("revision 0", old(0, &[3, 1, 0])),
        ("2.0 by a REQ", old(1, b"\x03\0\0")),
        ("2.0 with an identity", old(1, b"\x05\0\x0A@@@@@@@@@@")),
        ("revision 2", old(2, b"\x03\0\0")),
        ("2.0 by a SUB", old(1, b"\x02\0\0")),
        (
            "2.0 with a long identity",
            old(
                1,
                &[&b"\x03"[..], &long(0, &[&NUMBER[..], &[7; 290]].concat())].concat(),
            ),
        ),
        (
            "2.0 with a command",
            old(1, b"\x03\0\0\x04\x07\x04PING\0\0"),
        ),
        ("1.0", b"\x01\0\x01\x01\x0D\0/test;2;99;x".to_vec()),
        ("REQ", met(is("REQ"))),
        ("DEALER", met(is("DEALER"))),
        ("ROUTER", met(is("ROUTER"))),
        ("REP", met(is("REP"))),
        ("SUB", met(is("SUB"))),
        ("XSUB", met(is("XSUB"))),
        ("PUB", met(is("PUB"))),
        ("XPUB", met(is("XPUB"))),
        ("PUSH", met(is("PUSH"))),
        ("PULL", met(is("PULL"))),
        ("PAIR", met(is("PAIR"))),
        ("an unknown type", met(is("req"))),
        ("an empty type", met(is(""))),
        ("a READY of 250 bytes", with("X-Much", &[b'x'; 200])),
        ("a name in capitals", met(ready(&[("SOCKET-TYPE", b"REQ")]))),
        (
            "a SUB's name in small letters",
            met(ready(&[("socket-type", b"SUB")])),
        ),
        ("no properties", met(ready(&[]))),
        ("only an identity", met(ready(&[("Identity", NUMBER)]))),
        ("an identity", with("Identity", NUMBER)),
        ("unknown properties", with("X-Colour", b"red")),
        ("a resource", with("Resource", b"/lamp")),
        ("the type twice", with("Socket-Type", b"REQ")),
        ("two types", with("Socket-Type", b"SUB")),
        ("a property without a name", with("", b"x")),
        (
            "a value that is too short",
            raw(b"\x0BSocket-Type\0\0\0\x04REQ"),
        ),
        (
            "a byte after the properties",
            raw(b"\x0BSocket-Type\0\0\0\x03REQ\x01"),
        ),
        (
            "a name that is cut",
            raw(b"\x0BSocket-Type\0\0\0\x03REQ\x05Iden"),
        ),
        (
            "a value that is cut",
            raw(b"\x0BSocket-Type\0\0\0\x03REQ\x08Identity\0\0\0\x05me"),
        ),
        (
            "a value of 4 GB",
            raw(b"\x0BSocket-Type\0\0\0\x03REQ\x08Identity\xFF\xFF\xFF\xFFme"),
        ),
        (
            "a length that is cut",
            raw(b"\x0BSocket-Type\0\0\0\x03REQ\x08Identity\0\0\0"),
        ),
        ("READY in the long form", { met(long(4, &is("REQ")[2..])) }),
        ("a READY of 990 bytes", {
            let mut body = is("REQ")[2..].to_vec();
            body.extend(property("X-Much", &[b'x'; 954]));
            met(long(4, &body))
        }),
        ("a READY of 2,000 bytes", {
            let mut body = is("REQ")[2..].to_vec();
            body.extend(property("X-Much", &[b'x'; 1960]));
            met(long(4, &body))
        }),
        (
            "a request together with READY",
            [handshake(), STATUS.to_vec()].concat(),
        ),
        ("READY as a message", met(frame(0, &is("REQ")[2..]))),
        ("READY with MORE", met(frame(5, &is("REQ")[2..]))),
        (
            "READY with a reserved flag",
            met(frame(0x44, &is("REQ")[2..])),
        ),
        ("small letters in READY", met(frame(4, b"\x05ready"))),
        ("READY twice", [handshake(), is("REQ")].concat()),
        (
            "a request before READY",
            [greeting(3, 0), frame(0, BODY)].concat(),
        ),
        ("PING before READY", met(frame(4, b"\x04PING\0\0"))),
        (
            "an unknown command before READY",
            met(frame(4, b"\x05HELLO")),
        ),
        ("an empty command before READY", met(frame(4, b""))),
        ("ERROR before READY", met(frame(4, b"\x05ERROR\x02no"))),
        ("ERROR without a reason", met(frame(4, b"\x05ERROR"))),
        (
            "ERROR with a broken length",
            met(frame(4, b"\x05ERROR\x09no")),
        ),
        ("a command of 2^63 bytes", {
            [greeting(3, 0), b"\x06\x80\0\0\0\0\0\0\0".to_vec()].concat()
        }),
    ];
    let cases = cases.into_iter();
    let case = |(name, hello): (_, Vec<u8>)| Case {
        name,
        // Not after a stream that is not ZMTP 2.0 or later, or that ends in the handshake.
        then: match hello.as_slice() {
            [0xFF, rest @ ..] if ![4, 9, 63].contains(&rest.len()) && rest[9] > 0 => {
                STATUS.to_vec()
            }
            _ => Vec::new(),
        },
        hello,
        met: false,
    };
    cases.map(case).collect()
}

/// What follows a good handshake.
pub(super) fn traffic() -> Vec<Case> {
    let then = |bytes: &[u8]| [bytes, STATUS].concat();
    let command = |body: &[u8]| then(&frame(4, body));
    let within = |command: &[u8]| {
        let (delimiter, body) = STATUS.split_at(2);
        then(&[delimiter, command, body].concat())
    };
    let body = |length: usize| then(&message(&[b"", &vec![b'x'; length]]));
    let ping = |context: &[u8]| [b"\x04PING\0\x00", context].concat();
    let cases: Vec<(&'static str, Vec<u8>)> = vec![
        ("one request", STATUS.to_vec()),
        ("20 requests at once", STATUS.repeat(20)),
        ("one address", message(&[b"me", b"", BODY])),
        (
            "three addresses",
            message(&[b"me", b"\0\x01\xFF", &[7; 255], b"", BODY]),
        ),
        ("an address of 300 bytes", message(&[&[7; 300], b"", BODY])),
        (
            "30 addresses",
            message(&[&[&b"me"[..]; 30][..], &[b"", BODY]].concat()),
        ),
        (
            "our client's envelope",
            message(&[b"ztl1abcdefghijklmnop", &[0; 8], b"", BODY]),
        ),
        ("no delimiter", then(&message(&[BODY]))),
        ("no delimiter in two frames", then(&message(&[b"me", BODY]))),
        ("the delimiter alone", then(&message(&[b""]))),
        (
            "an address and the delimiter",
            then(&message(&[b"me", b""])),
        ),
        ("two delimiters", then(&message(&[b"", b"", BODY]))),
        ("two bodies", then(&message(&[b"", BODY, BODY]))),
        (
            "a body and an empty frame",
            then(&message(&[b"me", b"", BODY, b""])),
        ),
        (
            "100 bodies",
            then(&message(&[&[&b""[..]][..], &[&b"x"[..]; 100]].concat())),
        ),
        (
            "a delimiter in the long form",
            [long(1, b""), frame(0, BODY)].concat(),
        ),
        (
            "a body in the long form",
            [frame(1, b""), long(0, BODY)].concat(),
        ),
        (
            "an address in the long form",
            [long(1, b"me"), STATUS.to_vec()].concat(),
        ),
        ("a body of 255 bytes", body(255)),
        ("a body of 256 bytes", body(256)),
        ("a body at the limit", body(MOST)),
        ("a body above the limit", body(MOST + 1)),
        (
            "an address above the limit",
            then(&message(&[&[7; MOST + 1], b"", BODY])),
        ),
        (
            "many addresses",
            message(&[&[&[7; 100][..]; 40][..], &[b"", BODY]].concat()),
        ),
        ("2^63 bytes", then(b"\x01\0\x02\x80\0\0\0\0\0\0\0")),
        (
            "2^64 - 1 bytes",
            then(b"\x01\0\x02\xFF\xFF\xFF\xFF\xFF\xFF\xFF\xFF"),
        ),
        ("flag 8", then(&frame(8, b"x"))),
        ("flag 16", then(&frame(16, b"x"))),
        ("flag 32", then(&frame(32, b"x"))),
        ("flag 64", then(&frame(64, b"x"))),
        ("flag 128", then(&frame(128, b"x"))),
        ("a command with MORE", then(&frame(5, b"\x05HELLO"))),
        ("PING", command(&ping(b""))),
        ("PING with a context", command(&ping(b"beat"))),
        ("PING with 16 bytes", command(&ping(b"0123456789abcdef"))),
        ("PING with 17 bytes", command(&ping(b"0123456789abcdefg"))),
        ("PING with 200 bytes", command(&ping(&[b'x'; 200]))),
        ("PING in the long form", then(&long(4, &ping(b"beat")))),
        ("PING with a time to live", command(b"\x04PING\xFF\xFFbeat")),
        ("PING within a message", within(&frame(4, &ping(b"beat")))),
        ("PONG", command(b"\x04PONGbeat")),
        ("PONG within a message", within(&frame(4, b"\x04PONG"))),
        ("an unknown command", command(b"\x05HELLO")),
        (
            "an unknown command within a message",
            within(&frame(4, b"\x05HELLO")),
        ),
        ("an empty command", command(b"")),
        ("a command that is cut", command(b"\x09PING")),
        ("a command at the limit", then(&long(4, &[5; MOST]))),
        ("a command above the limit", then(&long(4, &[5; MOST + 1]))),
        ("ping", command(b"\x04ping\0\0beat")),
        ("SUBSCRIBE", command(b"\x09SUBSCRIBEab")),
        ("CANCEL", command(b"\x06CANCELab")),
        (
            "SUBSCRIBE within a message",
            within(&frame(4, b"\x09SUBSCRIBEab")),
        ),
        ("a subscription as a message", then(&frame(0, b"\x01ab"))),
        ("READY after the handshake", then(&is("REQ"))),
        ("ERROR after the handshake", command(b"\x05ERROR\x02no")),
        ("an unfinished frame", STATUS[..9].to_vec()),
        ("an unfinished message", STATUS[..2].to_vec()),
    ];
    let cases = cases.into_iter().map(|(name, then)| Case {
        name,
        hello: handshake(),
        then,
        met: true,
    });
    cases.collect()
}

/// A client that says who it is, and a request.
pub(super) fn named() -> Case {
    let ready = ready(&[("Socket-Type", b"REQ"), ("Identity", b"twin")]);
    Case {
        name: "two connections with the same identity",
        hello: [greeting(3, 1), ready].concat(),
        then: STATUS.to_vec(),
        met: true,
    }
}

/// A client that wants to be closed when it is silent for 0.1 s, and is.
pub(super) fn silent() -> Case {
    Case {
        name: "a time to live, and a request",
        hello: handshake(),
        then: [&frame(4, b"\x04PING\0\x01"), STATUS].concat(),
        met: true,
    }
}
