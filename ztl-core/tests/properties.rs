//! Properties that hold for any input: what is written reads back, and invalid input gives an error at a
//! position within it. [`proptest`] generates inputs, shrinks a failing one and stores it in
//! `properties.regressions`; commit that file. `PROPTEST_CASES=100000` tests harder.

#![expect(
    clippy::unwrap_used,
    clippy::indexing_slicing,
    clippy::panic,
    reason = "a test says what is wrong by panicking"
)]

use proptest::collection::vec;
use proptest::num::f32 as floats;
use proptest::prelude::*;
use proptest::test_runner::FileFailurePersistence;
use ztl_core::integer::{Integer, ParseIntegerError};
use ztl_core::link::{
    Body, BodyError, Busy, Decoder, Frame, FrameError, GoalShape, Hello, Ids, LinkId, Loss, Offer,
    Welcome, encode,
};
use ztl_core::message::ParseError;
use ztl_core::sink::Sink;
use ztl_core::{Message, State, TaskSpec, base64};

fn config() -> ProptestConfig {
    ProptestConfig {
        failure_persistence: Some(Box::new(FileFailurePersistence::WithSource("regressions"))),
        ..ProptestConfig::default()
    }
}

/// Any text, sometimes with the separators of fields and parts.
fn text() -> impl Strategy<Value = String> {
    prop_oneof![any::<String>(), "[;:= /a-z0-9üß\u{0}\u{feff}🤖]{0,40}"]
}

fn without(mark: char) -> impl Strategy<Value = String> {
    text().prop_map(move |text| text.replace(mark, ""))
}

/// An integer in plain decimal, and in another valid spelling.
fn number() -> impl Strategy<Value = (String, String)> {
    let digits = "0{0,3}[0-9](_?[0-9]){0,40}";
    let blanks = "[ \t\n\u{b}\u{c}\r]{0,3}";
    (blanks, "[+-]?", digits, blanks).prop_map(|(before, sign, digits, after)| {
        let plain = digits.replace('_', "");
        let plain = match (sign.as_str(), plain.trim_start_matches('0')) {
            (_, "") => "0".to_owned(),
            ("-", plain) => format!("-{plain}"),
            (_, plain) => plain.to_owned(),
        };
        (plain, format!("{before}{sign}{digits}{after}"))
    })
}

/// Building blocks for bodies of link messages; [`body`] picks what each tag needs.
#[derive(Debug, Clone)]
struct Parts {
    small: [u8; 5],
    middle: u16,
    numbers: [u32; 5],
    long: u64,
    texts: [String; 3],
    bytes: Vec<u8>,
    ids: Vec<LinkId>,
    range: Option<(f32, f32)>,
    state: State,
    busy: Busy,
    loss: Loss,
}

fn parts() -> impl Strategy<Value = Parts> {
    let number = || prop_oneof![0u32..300, any::<u32>()];
    let float = || floats::POSITIVE | floats::NEGATIVE | floats::ZERO | floats::INFINITE;
    let states = vec![
        State::Rejected,
        State::Failed,
        State::Aborted,
        State::Completed,
    ];
    let numbers = (
        any::<[u8; 5]>(),
        any::<u16>(),
        prop::array::uniform5(number()),
        any::<u64>(),
    );
    let longer = (
        [text(), text(), text()],
        vec(any::<u8>(), 0..300),
        vec(number().prop_map(LinkId), 0..20),
    );
    let busy = prop_oneof![
        Just(Busy::Refuse),
        any::<u8>().prop_map(Busy::Queue),
        Just(Busy::Replace),
    ];
    let chosen = (
        busy,
        prop::option::of((float(), float())),
        prop::sample::select(states),
        prop::sample::select(vec![Loss::Abort, Loss::Hold, Loss::CarryOn]),
    );
    (numbers, longer, chosen).prop_map(|((small, middle, numbers, long), longer, chosen)| {
        let ((texts, bytes, ids), (busy, range, state, loss)) = (longer, chosen);
        Parts {
            small,
            middle,
            numbers,
            long,
            texts,
            bytes,
            ids,
            range,
            state,
            busy,
            loss,
        }
    })
}

/// Number of message types; their tags count from 0.
const MESSAGES: u8 = 18;

fn body(tag: u8, parts: &Parts) -> Body<'_> {
    let Parts {
        numbers,
        texts,
        range,
        state,
        busy,
        loss,
        bytes,
        ids,
        long,
        middle,
        ..
    } = parts;
    let [version, index, component, held, topic] = parts.small;
    let [a, b, c] = texts;
    let task = LinkId(numbers[0]);
    match tag {
        0 => Body::Hello(Hello {
            version,
            session: numbers[0],
            gateway: *long,
        }),
        1 => Body::Describe { index },
        2 => Body::Start {
            task,
            component,
            goal: a,
            before_ms: *long,
        },
        3 => Body::Abort { task },
        4 => Body::Ping,
        5 => Body::Ack { task },
        6 => Body::Welcome(Welcome {
            version,
            name: a,
            firmware: b,
            boot: numbers[0],
            replaces: numbers[1],
            clock_ms: *long,
            capacity: held,
            max_body: *middle,
            components: component,
            link_timeout_ms: numbers[2],
            highest: numbers[3],
            held: Ids::new(ids),
        }),
        7 => {
            let goal = GoalShape {
                range: *range,
                unit: b,
                words: c,
            };
            let offer = Offer {
                name: a,
                goal,
                busy: *busy,
                loss: *loss,
                topics: a,
            };
            Body::Component { index, offer }
        }
        8 => Body::Started { task },
        9 => Body::Refused { reason: a },
        10 => Body::Aborting { task },
        11 => Body::Pong {
            clock_ms: *long,
            held,
        },
        12 => Body::Ended {
            task,
            state: *state,
            result: a,
        },
        13 => Body::Progress { task, text: a },
        14 => Body::Publish { topic, bytes },
        15 => Body::Log {
            lost: numbers[4],
            bytes,
        },
        16 => Body::Awake {
            version,
            boot: numbers[0],
        },
        17 => Body::Description {
            index,
            component,
            bytes,
        },
        _ => panic!("there is no message {tag}"),
    }
}

fn grown(put: impl FnOnce(&mut dyn Sink)) -> Vec<u8> {
    let mut out = Vec::new();
    put(&mut |bytes: &[u8]| out.extend_from_slice(bytes));
    out
}

fn wire(session: u32, frame: &Frame<'_>) -> Vec<u8> {
    let mut buffer = [0xA5; 2000];
    let len = encode(session, frame, &mut buffer).unwrap();
    buffer[..len].to_vec()
}

proptest! {
    #![proptest_config(config())]

    #[test]
    fn messages_round_trip(
        scope in without(';'), state in without(';'), id in without(';'), payload in text(),
    ) {
        let message = Message { scope: &scope, state: &state, id: &id, payload: &payload };
        let written = grown(|sink| message.put(sink));
        prop_assert_eq!(written.len(), message.encoded_len());
        prop_assert_eq!(Message::parse(&written), Ok(message));
    }

    #[test]
    fn any_bytes_give_a_message_or_an_error_within_them(
        bytes in prop_oneof![vec(any::<u8>(), 0..60), text().prop_map(String::into_bytes)],
    ) {
        match Message::parse(&bytes) {
            Ok(message) => prop_assert_eq!(grown(|sink| message.put(sink)), bytes),
            Err(ParseError::NotUtf8 { at, .. }) => {
                prop_assert_eq!(std::str::from_utf8(&bytes).map_err(|e| e.valid_up_to()), Err(at));
            }
            Err(ParseError::MissingFields { found, scope }) => {
                prop_assert!((1..4).contains(&found) && bytes.starts_with(scope.as_bytes()));
            }
            Err(other) => panic!("{other}"),
        }
    }

    #[test]
    fn integers_are_read_in_every_spelling((plain, written) in number()) {
        let number = Integer::parse(&written).unwrap();
        prop_assert_eq!(grown(|sink| number.put(sink)), plain.as_bytes());
        prop_assert_eq!(number.value(), plain.parse().ok());
    }

    #[test]
    fn any_text_gives_an_integer_or_an_error_within_it(
        text in prop_oneof![text(), "[ +_0-9x٣-]{0,12}"],
    ) {
        if let Err(ParseIntegerError::Unexpected { at }) = Integer::parse(&text) {
            prop_assert!(at < text.len() && text.is_char_boundary(at), "{}", at);
        }
    }

    #[test]
    fn task_specs_round_trip(
        handler in without(':'), component in without(':'), goal in text(),
    ) {
        let spec = TaskSpec { handler: &handler, component: &component, goal: &goal };
        let written = String::from_utf8(grown(|sink| spec.put(sink))).unwrap();
        prop_assert_eq!(written.len(), spec.encoded_len());
        let mut buffer = vec![0xA5; written.len() * 3 / 4];
        prop_assert_eq!(TaskSpec::decode(&written, &mut buffer), Ok(spec));
        let plain = spec.to_string();
        prop_assert_eq!(TaskSpec::split(&plain), Ok(spec));
    }

    #[test]
    fn base64_round_trips_when_fed_in_pieces(
        pieces in vec(vec(any::<u8>(), 0..9), 0..9),
    ) {
        let encoded = grown(|sink| {
            let mut encoder = base64::Encoder::new(sink);
            pieces.iter().for_each(|piece| encoder.put(piece));
            encoder.finish();
        });
        let mut buffer = vec![0xA5; encoded.len() * 3 / 4];
        prop_assert_eq!(base64::decode(&encoded, &mut buffer), Ok(&pieces.concat()[..]));
    }

    #[test]
    fn bodies_round_trip(parts in parts(), more in vec(any::<u8>(), 1..5)) {
        for tag in 0..MESSAGES {
            let body = body(tag, &parts);
            let mut written = grown(|sink| body.put(sink));
            prop_assert_eq!(written[0], tag);
            prop_assert_eq!(Body::parse(&written), Ok(body));
            let cut = Body::parse(&written[..written.len() - 1]);
            prop_assert!(cut.is_err(), "{:?}", cut);
            written.extend(&more);
            let extra = more.len();
            prop_assert_eq!(Body::parse(&written), Err(BodyError::Trailing { extra }));
        }
    }

    #[test]
    fn frames_round_trip_within_their_session_only(
        parts in parts(), addr: u8, seq: u8, session: u32, other: u32, noise in vec(1u8.., 0..9),
    ) {
        prop_assume!(session != other);
        for tag in 0..MESSAGES {
            let frame = Frame { addr, seq, body: body(tag, &parts) };
            let mut stream = noise.clone();
            stream.push(0);
            let good = wire(session, &frame);
            prop_assert_eq!(good.iter().position(|byte| *byte == 0), Some(good.len() - 1));
            let mut decoder = Decoder::<2000>::new();
            for byte in stream {
                let _ = decoder.push(byte);
            }
            let (last, before) = good.split_last().unwrap();
            for byte in before {
                prop_assert_eq!(decoder.push(*byte), Ok(false));
            }
            prop_assert_eq!(decoder.push(*last), Ok(true));
            prop_assert_eq!(decoder.frame(&[other, session]), Ok((1, frame)));
            prop_assert_eq!(decoder.frame(&[other]), Err(FrameError::Check));
        }
    }

    #[test]
    fn any_bytes_give_a_body_or_an_error_within_them(bytes in vec(any::<u8>(), 0..40)) {
        match Body::parse(&bytes) {
            Err(BodyError::Trailing { extra }) => {
                prop_assert!(extra > 0 && extra < bytes.len());
            }
            Err(BodyError::UnknownTag { tag }) => prop_assert!(tag >= u32::from(MESSAGES)),
            Err(_) => {}
            Ok(body) => {
                // Compared as bytes, because NaN does not equal itself.
                let written = grown(|sink| body.put(sink));
                prop_assert!(written.len() <= bytes.len());
                let again = Body::parse(&written).unwrap();
                prop_assert_eq!(grown(|sink| again.put(sink)), written);
            }
        }
    }
}
