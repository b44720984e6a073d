//! Plays example frames of `docs/link.md` to a real node, and compares them with the document.

use std::collections::BTreeSet;
use std::ops::RangeInclusive;

use ztl_core::Instant;
use ztl_core::link::{
    Body, Decoder, Frame, Hello, NO_SEQ, NO_SESSION, VERSION, encode, session_key,
};
use ztl_mcu::{Components, Identity, Node};

const HELLO: u32 = 0x1122_3344;
const BOOT: u32 = 0xcafe_0001;
const DOCUMENT: &str = include_str!("../../docs/link.md");

/// The frames of a section, in its order: name, seq, body.
pub(crate) type Frames = Vec<(&'static str, u8, Body<'static>)>;

/// A frame as sent over the line.
fn sent(session: u32, seq: u8, body: Body<'_>) -> Vec<u8> {
    let mut buffer = [0xA5; 300];
    let len = encode(session, &Frame { addr: 0, seq, body }, &mut buffer).expect("it fits");
    buffer[..len].to_vec()
}

/// A node with these components sends the frames that are not `from_gateway`. The document has all frames, behind names
/// of `width` characters, and they have all these tags.
pub(crate) fn are_played(
    components: impl Components,
    frames: Frames,
    from_gateway: impl Fn(&Body<'_>) -> bool,
    width: usize,
    all_tags: RangeInclusive<u8>,
) {
    let key = session_key(HELLO, BOOT);
    let mut node = Node::<_, 4, 256>::new(Identity::new("gripper", "1.0.0", BOOT), components);
    let now = Instant::from_millis(1500);
    let hello = Body::Hello(Hello {
        version: VERSION,
        session: HELLO,
        gateway: 7,
    });
    node.handle_bytes(now, &sent(NO_SESSION, NO_SEQ, hello));
    let mut said = [0; 300];
    node.poll_transmit(now, &mut said);
    let (mut document, mut tags) = (String::new(), BTreeSet::new());
    for (name, seq, body) in frames {
        let bytes = sent(key, seq, body);
        let hex: Vec<String> = bytes.iter().map(|byte| format!("{byte:02x}")).collect();
        document += &format!("{name:<width$}{}\n", hex.join(" "));
        let mut decoder = Decoder::<300>::new();
        for byte in &bytes {
            decoder.push(*byte).expect("a frame");
        }
        assert_eq!(decoder.frame(&[key]).expect("a frame").1.body, body);
        let mut first = None;
        body.put(&mut |bytes: &[u8]| first = first.or(bytes.first().copied()));
        tags.extend(first);
        if from_gateway(&body) {
            node.handle_bytes(now, &bytes);
        } else {
            let len = node.poll_transmit(now, &mut said);
            assert_eq!(said[..len], bytes, "{name}");
            node.handle_timeout(now);
        }
    }
    assert!(
        DOCUMENT.contains(&format!("```text\n{document}```\n")),
        "docs/link.md should have:\n{document}"
    );
    assert!(
        tags.is_superset(&all_tags.collect()),
        "each message has an example"
    );
}
