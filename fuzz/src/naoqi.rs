//! NAOqi's protocol (`ztl_naoqi`): any value of any signature, and any bytes that a robot sends.
//!
//! The first byte chooses what is tried. `v`: up to a NUL, a signature; then a value of it. Anything else: the bytes of a
//! connection, after its handshake and the directory's description; a call and a subscription are under way.

use std::time::{Duration, Instant};

use peak_alloc::PeakAlloc;
use ztl_naoqi::{
    Action, Address, Call, Endpoint, Event, Frames, Kind, Limits, Message, Options, Session,
    SignalOf, Signature, Value, decode,
};

/// What a value may take besides 128 times its length.
const BESIDES: usize = 64 << 10;

/// Any input. The allocator is that of the program.
pub fn check(bytes: &[u8], allocator: &PeakAlloc) {
    match bytes.split_first() {
        Some((b'v', rest)) => value(rest, allocator),
        Some((_, rest)) => connection(rest),
        None => {}
    }
}

fn value(bytes: &[u8], allocator: &PeakAlloc) {
    let end = bytes
        .iter()
        .position(|byte| *byte == 0)
        .unwrap_or(bytes.len());
    let (signature, rest) = bytes.split_at(end);
    let limits = Limits::default();
    let text = String::from_utf8_lossy(signature);
    let signature = match Signature::parse(&text, limits.depth) {
        Ok(signature) => signature,
        Err(error) => {
            assert!(error.at <= text.len());
            return;
        }
    };
    assert!(!signature.to_string().is_empty());
    let rest = rest.get(1..).unwrap_or_default();
    let before = allocator.current_usage();
    allocator.reset_peak_usage();
    let decoded = decode(rest, &signature, &limits);
    let peak = allocator.peak_usage().saturating_sub(before);
    assert!(
        peak <= 128 * rest.len() + BESIDES,
        "{peak} bytes for {}",
        rest.len()
    );
    match decoded {
        Ok(value) => printable(&value),
        Err(error) => assert!(!error.to_string().is_empty()),
    }
}

/// It is shown, and compared.
fn printable(value: &Value) {
    assert!(value.to_string().len() < 16 << 20);
    let _ = value == &value.clone();
}

/// The handshake's answer, and those to what the directory is asked first.
fn introduction() -> Vec<u8> {
    let answer = |id, payload: &[u8]| {
        let address = Address {
            service: 1,
            object: 1,
            action: 2,
        };
        let mut bytes = Vec::new();
        let payload = payload.to_vec();
        Message {
            id,
            kind: Kind::Reply,
            flags: 0,
            address,
            payload,
        }
        .encode_into(&mut bytes);
        bytes
    };
    let text = |text: &str| [&(text.len() as u32).to_le_bytes(), text.as_bytes()].concat();
    let number = |number: u32| number.to_le_bytes().to_vec();
    let state = [number(1), text("__qi_auth_state"), text("I"), number(3)].concat();
    let method = |id, name, parameters, returns| {
        let texts = [text(returns), text(name), text(parameters), text("")].concat();
        [number(id), number(id), texts, number(0), text("")].concat()
    };
    let signal = |id, name| [number(id), number(id), text(name), text("(Is)")].concat();
    let info = "(sIsI[s]s)";
    let meta = [
        number(2),
        method(100, "service", "(s)", info),
        method(101, "services", "()", &format!("[{info}]")),
        number(2),
        signal(106, "serviceAdded"),
        signal(107, "serviceRemoved"),
        number(0),
        text(""),
    ];
    let names = [text("ServiceDirectory"), number(1), text("nao"), number(1)].concat();
    let list = [number(1), names, number(0), text("0")].concat();
    [
        answer(1, &state),
        answer(2, &meta.concat()),
        answer(5, &list),
    ]
    .concat()
}

fn connection(bytes: &[u8]) {
    let mut now = Instant::now();
    let limits = Limits {
        payload: 4096,
        signals: 8,
        output: 4096,
        ..Limits::default()
    };
    let directory = Endpoint::parse("tcp://10.0.0.7:9559").expect("an endpoint");
    let options = Options {
        directory,
        credentials: None,
        limits,
    };
    let mut session = Session::new(options, now);
    let Some(Action::Connect(link, _)) = session.poll_action() else {
        panic!("it does not connect");
    };
    session.handle_connected(link, [10, 0, 0, 7].into(), now);
    session.handle_bytes(link, &introduction(), now);
    assert_eq!(session.poll_event(), Some(Event::Connected));
    let call = Call::new("ALMotion", "moveTo", vec![Value::Double(1.0)]);
    let call = session
        .call(call, Duration::from_secs(5), now)
        .expect("a call");
    session.subscribe(SignalOf::memory("FrontTactilTouched"));
    let mut ended = 0;
    for (index, part) in bytes.chunks(64).enumerate() {
        session.handle_bytes(link, part, now);
        // Others listen nowhere.
        while let Some(action) = session.poll_action() {
            if let Action::Connect(link, _) = action {
                session.handle_closed(link, "refused", now);
            }
        }
        if index % 4 == 0 {
            while let Some(event) = session.poll_event() {
                ended +=
                    u32::from(matches!(event, Event::Ended { call: other, .. } if other == call));
            }
        }
        let mut frames = Frames::new(4096);
        if let Some(output) = session.output(link) {
            assert!(output.len() <= 3 * 4096, "{} bytes wait", output.len());
            // What we send can be read.
            frames.push(&std::mem::take(output));
            while frames.poll().expect("messages").is_some() {}
        }
    }
    for _ in 0..60 {
        now += Duration::from_secs(1);
        session.handle_timeout(now);
        while let Some(action) = session.poll_action() {
            if let Action::Connect(link, _) = action {
                session.handle_closed(link, "refused", now);
            }
        }
        while let Some(event) = session.poll_event() {
            ended += u32::from(matches!(event, Event::Ended { call: other, .. } if other == call));
        }
        assert!(
            session.poll_timeout().is_some_and(|next| next >= now),
            "it is due at once again"
        );
    }
    assert_eq!(ended, 1, "the call has not ended once");
}
