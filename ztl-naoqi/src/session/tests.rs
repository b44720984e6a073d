//! Sessions with a scripted robot, in virtual time: what libqi itself cannot be made to do.

use std::time::{Duration, Instant};

use super::*;
use crate::encode::encode;
use crate::message::{Address, Frames, Kind, Message};
use crate::signature::{Names, Signature};

mod hostile;

/// A robot that answers as it is told.
struct Robot {
    session: Session,
    now: Instant,
    frames: Frames,
    link: Option<LinkId>,
}

/// The text of a goal as a value.
fn value(goal: &str) -> Value {
    ztl_core::goal::from_str(goal).expect(goal)
}

/// A value in the types of a signature.
fn bytes(goal: &str, signature: &str) -> Vec<u8> {
    let signature = Signature::parse(signature, 32).expect(signature);
    let mut bytes = Vec::new();
    encode(&value(goal), &signature, &mut bytes).expect(goal);
    bytes
}

const META: &str = "({I(Issss[(ss)]s)}{I(Iss)}{I(Iss)}s)";
const INFO: &str = "(sIsI[s]s)";

/// The directory of NAOqi 2.1, whose services have no object id.
const DIRECTORY: &str = "[{2: [2, m, metaObject, '(I)', '', [], ''], \
    100: [100, '(sIsI[s]s)<ServiceInfo,name,serviceId,machineId,processId,endpoints,sessionId>', service, '(s)', '', [], ''], \
    101: [101, '[(sIsI[s]s)<ServiceInfo,name,serviceId,machineId,processId,endpoints,sessionId>]', services, '()', '', [], '']}, \
    {106: [106, serviceAdded, '(Is)'], 107: [107, serviceRemoved, '(Is)']}, {}, '']";

const SPEECH: &str = "[{100: [100, v, say, '(s)', '', [], ''], 101: [101, 'm<', odd, '()', '', [], ''], \
    102: [102, v, pointer, '(*)', '', [], '']}, {103: [103, word, '(s'], 104: [104, level, '(f)']}, {}, '']";

impl Robot {
    fn new(credentials: Option<Credentials>) -> Self {
        Self::with(credentials, Limits::default())
    }

    fn with(credentials: Option<Credentials>, limits: Limits) -> Self {
        let now = Instant::now();
        let directory = Endpoint::parse("tcp://10.0.0.7:9559").unwrap();
        let options = Options {
            directory,
            credentials,
            limits,
        };
        let mut robot = Self {
            session: Session::new(options, now),
            now,
            frames: Frames::new(1 << 20),
            link: None,
        };
        robot.connect("tcp://10.0.0.7:9559");
        robot
    }

    /// One that lists a service of its own process, which was described.
    fn ready() -> Self {
        let mut robot = Self::new(None);
        robot.authenticate();
        robot.list();
        assert_eq!(robot.session.poll_event(), Some(Event::Connected));
        robot
    }

    /// Accepts a connection that must be opened next.
    #[track_caller]
    fn connect(&mut self, endpoint: &str) {
        let link = self.opening(endpoint);
        let peer = [10, 0, 0, 7].into();
        self.session.handle_connected(link, peer, self.now);
        self.link = Some(link);
        self.frames = Frames::new(1 << 20);
    }

    #[track_caller]
    fn opening(&mut self, expected: &str) -> LinkId {
        match self.session.poll_action() {
            Some(Action::Connect(link, endpoint)) => {
                assert_eq!(endpoint.to_string(), expected);
                link
            }
            other => panic!("{other:?}"),
        }
    }

    /// The next message that the session sends.
    #[track_caller]
    fn hear(&mut self) -> Message {
        let heard = self.hear_more();
        heard.expect("a message")
    }

    fn hear_more(&mut self) -> Option<Message> {
        let output = self.session.output(self.link?)?;
        self.frames.push(&std::mem::take(output));
        self.frames.poll().expect("messages")
    }

    fn send(&mut self, kind: Kind, id: u32, address: Address, payload: Vec<u8>) {
        let mut bytes = Vec::new();
        let message = Message {
            id,
            kind,
            flags: 0,
            address,
            payload,
        };
        message.encode_into(&mut bytes);
        let link = self.link.expect("a connection");
        self.session.handle_bytes(link, &bytes, self.now);
    }

    /// Answers a call of this action, which must be next.
    #[track_caller]
    fn answer(&mut self, action: u32, kind: Kind, payload: Vec<u8>) {
        let call = self.hear();
        assert_eq!((call.kind, call.address.action), (Kind::Call, action));
        self.send(kind, call.id, call.address, payload);
    }

    #[track_caller]
    fn authenticate(&mut self) {
        let done = bytes("{__qi_auth_state: 3, RemoteCancelableCalls: true}", "{sm}");
        self.answer(8, Kind::Reply, done);
    }

    #[track_caller]
    fn list(&mut self) {
        self.answer(2, Kind::Reply, bytes(DIRECTORY, META));
        self.answer(0, Kind::Reply, bytes("1", "L"));
        self.answer(0, Kind::Reply, bytes("2", "L"));
        let services = "[[ServiceDirectory, 1, nao, 100, ['tcp://127.0.0.1:9559'], '0'], \
            [ALTextToSpeech, 2, nao, 100, ['tcp://127.0.0.1:9559', 'tcp://10.0.0.7:9559'], '1']]";
        self.answer(101, Kind::Reply, bytes(services, &format!("[{INFO}]")));
    }

    /// Tells where a service is, and what it says of itself.
    #[track_caller]
    fn resolve(&mut self, info: &str) {
        self.answer(100, Kind::Reply, bytes(info, INFO));
    }

    #[track_caller]
    fn resolve_speech(&mut self) {
        self.resolve("[ALTextToSpeech, 2, nao, 100, ['tcp://127.0.0.1:9559'], '1']");
        self.answer(2, Kind::Reply, bytes(SPEECH, META));
    }

    #[track_caller]
    fn remove_speech(&mut self) {
        let removed = Address {
            service: 1,
            object: 1,
            action: 107,
        };
        let about = bytes("[2, ALTextToSpeech]", "(Is)");
        self.send(Kind::Event, 0, removed, about);
        let event = Event::ServiceRemoved("ALTextToSpeech".to_owned());
        assert_eq!(self.session.poll_event(), Some(event));
    }

    fn call(&mut self, method: &str, arguments: Vec<Value>) -> CallId {
        let call = Call::new("ALTextToSpeech", method, arguments);
        let begun = self.session.call(call, Duration::from_secs(3), self.now);
        begun.expect("a call")
    }

    fn say(&mut self) -> CallId {
        self.call("say", vec![Value::Text("hello".to_owned())])
    }

    /// Lets time pass, with nothing from the robot.
    fn wait(&mut self, time: Duration) {
        let end = self.now + time;
        while let Some(next) = self.session.poll_timeout().filter(|next| *next <= end) {
            self.now = next.max(self.now);
            self.session.handle_timeout(self.now);
        }
        self.now = end;
    }

    #[track_caller]
    fn disconnected(&mut self) -> String {
        match self.session.poll_event() {
            Some(Event::Disconnected { reason }) => reason,
            other => panic!("{other:?}"),
        }
    }

    #[track_caller]
    fn ended(&mut self, expected: CallId) -> Result<Value, CallError> {
        match self.session.poll_event() {
            Some(Event::Ended { call, result }) if call == expected => result,
            other => panic!("{other:?}"),
        }
    }
}

fn nao() -> Option<Credentials> {
    Some(Credentials {
        user: "nao".to_owned(),
        token: "secret".to_owned(),
    })
}

#[test]
fn wrong_credentials_are_told() {
    let mut robot = Robot::new(nao());
    let call = robot.hear();
    let sent = crate::decode(
        &call.payload,
        &Signature::parse("{sm}", 32).unwrap(),
        &Limits::default(),
    );
    let sent = sent.unwrap().to_string();
    assert!(
        sent.contains("'auth_user': 'nao', 'auth_token': 'secret'"),
        "{sent}"
    );
    let text = bytes("'Authentication failed: wrong token [2.9]'", "m");
    robot.send(Kind::Error, call.id, call.address, text);
    assert_eq!(
        robot.disconnected(),
        "tcp://10.0.0.7:9559: the robot refused user and token: Authentication failed: wrong token [2.9]"
    );
    assert!(!format!("{:?}", nao()).contains("secret"));
}

#[test]
fn a_server_that_asks_for_credentials_is_told_from_one_that_does_not() {
    let mut robot = Robot::new(None);
    let text = bytes("'Authentication failed'", "m");
    robot.answer(8, Kind::Error, text.clone());
    assert_eq!(robot.hear().kind, Kind::Capability);
    robot
        .session
        .handle_closed(robot.link.unwrap(), "the connection was closed", robot.now);
    assert_eq!(
        robot.disconnected(),
        "tcp://10.0.0.7:9559: the connection was closed after: Authentication failed"
    );

    let mut robot = Robot::new(None);
    robot.answer(8, Kind::Error, text);
    robot.hear();
    robot.list();
    assert_eq!(robot.session.poll_event(), Some(Event::Connected));
}

#[test]
fn a_new_token_is_used_and_told() {
    let mut robot = Robot::new(nao());
    let more = || bytes("{__qi_auth_state: 2, auth_newToken: fresh}", "{sm}");
    robot.answer(8, Kind::Reply, more());
    assert_eq!(
        robot.session.poll_event(),
        Some(Event::NewToken("fresh".to_owned()))
    );
    robot.authenticate();
    robot.list();
    assert_eq!(robot.session.poll_event(), Some(Event::Connected));

    robot
        .session
        .handle_closed(robot.link.unwrap(), "closed", robot.now);
    robot.wait(Duration::from_secs(1));
    robot.connect("tcp://10.0.0.7:9559");
    let sent = String::from_utf8_lossy(&robot.hear().payload).into_owned();
    assert!(sent.contains("fresh") && !sent.contains("secret"), "{sent}");

    let mut robot = Robot::new(nao());
    robot.answer(8, Kind::Reply, more());
    robot.answer(8, Kind::Reply, more());
    robot.session.poll_event();
    let reason = robot.disconnected();
    assert!(
        reason.ends_with("the robot asks for more than user and token"),
        "{reason}"
    );
}

#[test]
fn a_server_that_is_not_naoqi_is_told_and_tried_again() {
    let mut robot = Robot::new(None);
    let link = robot.link.unwrap();
    robot
        .session
        .handle_bytes(link, b"SSH-2.0-OpenSSH_5.8\r\n", robot.now);
    let reason = robot.disconnected();
    assert_eq!(
        reason,
        "tcp://10.0.0.7:9559: it does not speak NAOqi's protocol"
    );
    assert_eq!(robot.session.poll_action(), Some(Action::Close(link)));
    assert_eq!(robot.session.poll_action(), None);
    robot.wait(Duration::from_millis(250));
    robot.connect("tcp://10.0.0.7:9559");
    robot.authenticate();
    robot.list();
    assert_eq!(robot.session.poll_event(), Some(Event::Connected));
}

#[test]
fn a_silent_server_ends_calls_as_not_sent() {
    let mut robot = Robot::new(None);
    let call = robot.say();
    robot.wait(Duration::from_secs(5));
    let result = robot.ended(call);
    let expected = "not connected to tcp://10.0.0.7:9559".to_owned();
    assert_eq!(result, Err(CallError::NotSent(expected)));
    assert_eq!(
        robot.disconnected(),
        "tcp://10.0.0.7:9559: no answer in time"
    );
}

#[test]
fn a_robot_without_power_leaves_its_calls_unknown() {
    let mut robot = Robot::ready();
    let call = robot.say();
    robot.resolve_speech();
    assert_eq!(robot.hear().address.action, 100);
    // It answers as long as it is there, however long the call takes.
    for _ in 0..20 {
        robot.wait(Duration::from_secs(6));
        let probe = robot.hear();
        assert_eq!(probe.address.action, 7);
        robot.send(Kind::Reply, probe.id, probe.address, bytes("[]", "[s]"));
    }
    assert_eq!(robot.session.poll_event(), None);
    robot.wait(Duration::from_secs(11));
    let expected = "the connection was lost: tcp://10.0.0.7:9559: it does not answer".to_owned();
    assert_eq!(robot.ended(call), Err(CallError::Unknown(expected)));
    assert_eq!(
        robot.disconnected(),
        "tcp://10.0.0.7:9559: it does not answer"
    );
}

#[test]
fn signatures_that_cannot_be_read_harm_only_what_has_them() {
    let mut robot = Robot::ready();
    let pointer = robot.call("pointer", vec![Value::Integer(1)]);
    robot.resolve_speech();
    let error = robot.ended(pointer).unwrap_err().to_string();
    let expected =
        "the signature of ALTextToSpeech.pointer cannot be read: \"(*)\", byte 1: expected a type";
    assert_eq!(error, expected);

    let odd = robot.call("odd", Vec::new());
    robot.answer(101, Kind::Reply, bytes("1", "m"));
    let error = robot.ended(odd).unwrap_err();
    let expected = "its signature \"m<\" cannot be read: byte 2: expected '>'";
    assert_eq!(error, CallError::Unreadable(expected.to_owned()));

    let id = robot
        .session
        .subscribe(SignalOf::service("ALTextToSpeech", "word"));
    robot.answer(0, Kind::Reply, bytes("9", "L"));
    assert_eq!(robot.session.poll_event(), Some(Event::Subscribed(id)));
    let address = Address {
        service: 2,
        object: 1,
        action: 103,
    };
    robot.send(Kind::Event, 0, address, bytes("hello", "s"));
    match robot.session.poll_event() {
        Some(Event::Signal {
            values: Err(reason),
            ..
        }) => {
            assert!(
                reason.starts_with("its signature \"(s\" cannot be read"),
                "{reason}"
            );
        }
        other => panic!("{other:?}"),
    }

    let said = robot.say();
    robot.answer(100, Kind::Reply, b"garbage".to_vec());
    let unreadable = "it cannot be read: 7 bytes follow the value".to_owned();
    assert_eq!(robot.ended(said), Err(CallError::Unreadable(unreadable)));
    let said = robot.say();
    robot.answer(100, Kind::Reply, Vec::new());
    assert_eq!(robot.ended(said), Ok(Value::Nothing));
}

#[test]
fn endpoints_of_another_process_are_tried_in_turn() {
    let mut robot = Robot::ready();
    let call = robot.say();
    let endpoints = "['tcp://127.0.0.1:4000', 'tcp://10.0.0.7:4000', 'tcp://10.9.9.9:4000']";
    robot.resolve(&format!("[ALTextToSpeech, 2, nao, 222, {endpoints}, '1']"));
    let first = robot.opening("tcp://10.0.0.7:4000");
    robot.session.handle_closed(first, "refused", robot.now);
    let second = robot.opening("tcp://10.9.9.9:4000");
    robot.wait(Duration::from_millis(3500));
    // The call's own time is over.
    assert!(matches!(robot.ended(call), Err(CallError::NotSent(_))));
    let call = robot.say();
    robot.wait(Duration::from_millis(1000));
    let expected =
        "tcp://10.0.0.7:4000: refused; tcp://10.9.9.9:4000: no answer in time".to_owned();
    assert_eq!(robot.ended(call), Err(CallError::NotSent(expected)));
    assert_eq!(robot.session.poll_action(), Some(Action::Close(second)));

    let call = robot.say();
    robot.resolve("[ALTextToSpeech, 2, nao, 222, ['tcp://127.0.0.1:4000'], '1']");
    let expected = "ALTextToSpeech cannot be reached from here: it listens at tcp://127.0.0.1:4000";
    assert_eq!(
        robot.ended(call),
        Err(CallError::NotSent(expected.to_owned()))
    );
}

#[test]
fn an_answer_that_overtakes_the_removal_of_its_service_counts() {
    let mut robot = Robot::ready();
    let call = robot.say();
    robot.resolve_speech();
    let said = robot.hear();
    robot.remove_speech();
    robot.wait(Duration::from_millis(400));
    robot.send(Kind::Reply, said.id, said.address, Vec::new());
    assert_eq!(robot.ended(call), Ok(Value::Nothing));
}

#[test]
fn a_call_that_does_not_wait_is_sent_at_once_or_never() {
    let mut robot = Robot::ready();
    let first = robot.say();
    robot.resolve_speech();
    robot.hear();
    let at_once = |robot: &mut Robot| {
        let call = Call::new("ALTextToSpeech", "say", vec![Value::Text("x".to_owned())]);
        let call = robot.session.call(call, Duration::ZERO, robot.now);
        robot.wait(Duration::ZERO);
        call.expect("a call")
    };
    let second = at_once(&mut robot);
    let said = robot.hear();
    robot.send(Kind::Reply, said.id, said.address, Vec::new());
    assert_eq!(robot.ended(second), Ok(Value::Nothing));
    robot.remove_speech();
    let third = at_once(&mut robot);
    assert!(matches!(robot.ended(third), Err(CallError::NotSent(_))));
    assert_ne!(third, first);
}

#[test]
fn calls_signals_and_output_are_bounded() {
    let limits = Limits {
        calls: 3,
        signals: 2,
        output: 1000,
        ..Limits::default()
    };
    let mut robot = Robot::with(None, limits);
    robot.authenticate();
    robot.list();
    robot.session.poll_event();
    let long = robot.call("say", vec![Value::Text("x".repeat(2000))]);
    let (_, second) = (robot.say(), robot.say());
    let call = Call::new("ALTextToSpeech", "say", Vec::new());
    let refused = robot
        .session
        .call(call, Duration::ZERO, robot.now)
        .unwrap_err();
    assert_eq!(refused.to_string(), "too many calls are under way");
    robot.resolve_speech();
    let full = CallError::NotSent("too much waits to be sent".to_owned());
    assert_eq!(robot.ended(long), Err(full));
    assert_eq!(robot.session.cancel(second), Cancel::Asked);

    let subscription = robot
        .session
        .subscribe(SignalOf::service("ALTextToSpeech", "level"));
    let address = Address {
        service: 2,
        object: 1,
        action: 104,
    };
    for level in 0..5 {
        robot.send(Kind::Event, 0, address, bytes(&format!("[{level}]"), "(f)"));
    }
    for (level, lost) in [(3.0, 3), (4.0, 0)] {
        let values = Value::Tuple(Names::default(), [Value::Float(level)].into());
        let signal = Event::Signal {
            subscription,
            values: Ok(values),
            dropped: lost,
        };
        assert_eq!(robot.session.poll_event(), Some(signal));
    }
    assert_eq!(robot.session.poll_event(), None);
}

#[test]
fn objects_in_results_are_released() {
    let mut robot = Robot::ready();
    let call = robot.call("odd", Vec::new());
    robot.resolve("[ALTextToSpeech, 2, nao, 100, ['tcp://127.0.0.1:9559'], '1']");
    let speech = SPEECH.replace("'m<'", "m");
    robot.answer(2, Kind::Reply, bytes(&speech, META));
    let mut object = b"\x01\0\0\0o".to_vec();
    object.extend(bytes("[{}, {}, {}, '']", META));
    object.extend([2_u32.to_le_bytes(), 77_u32.to_le_bytes()].concat());
    robot.answer(101, Kind::Reply, object);
    assert_eq!(robot.ended(call).unwrap().to_string(), "<object>");
    let release = robot.hear();
    assert_eq!(
        (release.kind, release.address.object, release.address.action),
        (Kind::Post, 77, 3)
    );
}

#[test]
fn a_service_is_looked_for_at_the_address_that_the_robots_name_has() {
    let now = Instant::now();
    let mut session = Session::new(
        Options {
            directory: Endpoint::parse("tcp://nao.local:9559").unwrap(),
            credentials: None,
            limits: Limits::default(),
        },
        now,
    );
    let Some(Action::Connect(link, _)) = session.poll_action() else {
        panic!("it does not connect");
    };
    session.handle_connected(link, "::ffff:10.0.0.7".parse().unwrap(), now);
    let mut robot = Robot {
        session,
        now,
        frames: Frames::new(1 << 20),
        link: Some(link),
    };
    robot.authenticate();
    robot.list();
    robot.session.poll_event();
    robot.say();
    let endpoints = "['tcp://198.18.0.1:4000', 'tcp://10.0.0.7:4000']";
    robot.resolve(&format!("[ALTextToSpeech, 2, nao, 222, {endpoints}, '1']"));
    robot.opening("tcp://10.0.0.7:4000");
}
